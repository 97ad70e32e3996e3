"""Commands for an arm, and its measured state."""

from dataclasses import dataclass

from robust_instant_policy.geometry import FloatArray

GRIP_LOAD = 0.5  # share of its force limit from which a gripper holds something
OPEN = 0.9  # share of its travel from which a gripper is open


@dataclass(frozen=True, eq=False)
class Command:
    """A command for an arm: ``joints (J,)`` rad and the travel of each finger from closed (0), metres."""

    joints: FloatArray
    finger_travel: float


@dataclass(frozen=True, eq=False)
class ArmState:
    """What an arm measured.

    ``joints (J,)`` rad, ``speeds (J,)`` rad/s; ``finger_travel`` of each finger from closed (0), metres;
    ``grip_load`` is the share of the gripper's force or current limit in use, 0 to 1; ``clock`` is the device's own
    time in seconds, which must advance (a state whose clock stands still is stale); ``faults`` are errors that the
    arm reports, one line each, empty while it is well. The state may be that of a command which was sent up to
    ``latency_s`` seconds before the last one.
    """

    joints: FloatArray
    speeds: FloatArray
    finger_travel: float
    grip_load: float
    clock: float
    faults: tuple[str, ...] = ()
    latency_s: float = 0.0


def is_open(state: ArmState, travel: float) -> bool:
    """Whether fingers with the full ``travel``, metres, are open."""
    return state.finger_travel > OPEN * travel


def is_gripping(state: ArmState, travel: float) -> bool:
    """Whether fingers with the full ``travel``, metres, press on something between them."""
    return state.grip_load >= GRIP_LOAD and not is_open(state, travel)
