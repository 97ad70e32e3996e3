"""The protocol of an arm that executes commands."""

from typing import Protocol

from robust_instant_policy.motion.state import ArmState, Command
from robust_instant_policy.robots.device import Device


class Follower(Device, Protocol):
    """An arm with a gripper that follows joint commands.

    The methods raise `RobotError` within 100 ms when the device does not answer. Tool poses become joint commands
    through `motion.kinematics`; see `robots.models.arm_of`.
    """

    def connect(self) -> None:
        """Open the device, check that it is the configured one, and hold the present position. Nothing moves."""
        ...

    def state(self) -> ArmState:
        """The present state, read from the device."""
        ...

    def command(self, command: Command) -> None:
        """Move to ``command``, one control step ahead. Returns without waiting for the motion."""
        ...

    def stop(self) -> None:
        """Come to rest at once and hold the position; the torque stays on. Never raises, may be called twice."""
        ...

    def disconnect(self) -> None:
        """Close the device. The arm holds its position: it must not fall onto the table."""
        ...
