"""What an arm is told and what it measures."""

from __future__ import annotations

from dataclasses import dataclass

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
