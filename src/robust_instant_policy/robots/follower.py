"""The protocol of an arm that executes commands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from robust_instant_policy.geometry import FloatArray


@dataclass(frozen=True, eq=False)
class Command:
    """What an arm is told: ``joints (J,)`` rad and the travel of each finger from closed (0), metres."""

    joints: FloatArray
    finger_travel: float


@dataclass(frozen=True, eq=False)
class ArmState:
    """What an arm measured.

    ``joints (J,)`` rad, ``speeds (J,)`` rad/s; ``finger_travel`` of each finger from closed (0), metres;
    ``grip_load`` is the share of the gripper's force or current limit in use, 0 to 1; ``clock`` is the device's own
    time in seconds, which must advance (a state whose clock stands still is stale); ``faults`` are errors that the
    arm reports, one line each, empty while it is well.
    """

    joints: FloatArray
    speeds: FloatArray
    finger_travel: float
    grip_load: float
    clock: float
    faults: tuple[str, ...] = ()


class Follower(Protocol):
    """An arm with a gripper that follows joint commands.

    The methods raise `RobotError` within 100 ms when the device does not answer. Tool poses become joint commands
    through `motion.kinematics`; see `robots.models.arm_of`.
    """

    name: str

    def connect(self) -> None:
        """Open the device, check that it is the configured one, and hold the present position. Nothing moves."""
        ...

    def state(self) -> ArmState:
        """The present state, read from the device."""
        ...

    def command(self, command: Command) -> None:
        """Go on to ``command``, one control step ahead. Returns without waiting for the motion."""
        ...

    def stop(self) -> None:
        """Come to rest at once and hold the position; the torque stays on. Never raises, may be called twice."""
        ...

    def disconnect(self) -> None:
        """Close the device. The arm holds its position: it must not fall onto the table."""
        ...
