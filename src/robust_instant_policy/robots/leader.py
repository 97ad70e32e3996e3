"""The protocol of a device that a person moves to command a follower."""

from typing import Protocol

from robust_instant_policy.motion.state import ArmState, Command
from robust_instant_policy.robots.device import Device


class Leader(Device, Protocol):
    """Commands one follower."""

    def start(self) -> None:
        """Called before leading begins: forget earlier readings."""
        ...

    def read(self, follower: ArmState) -> Command:
        """The command for the follower now.

        A leader arm returns its own joints; a keyboard or gamepad continues from its last command, the first time from
        the state of the ``follower``.
        """
        ...
