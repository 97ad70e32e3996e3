"""The limits of a cell, and the message of a limit that is exceeded."""

from dataclasses import dataclass

import numpy as np

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.checks import TABLE_TOLERANCE_M

# In the demonstrations of twelve simulated tasks, at both levels, a tool turns by up to 32 degrees and moves by up to
# 0.24 m between two of 30 waypoints.
TURN_PER_STEP_RAD = np.deg2rad(60)
STEP_M = 0.35
ARM_DISTANCE_M = 0.02
LINK_DISTANCE_M = 0.0  # capsules that enclose links exceed them already
FOLLOWING_ERROR_RAD = 0.35


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits that all arms of a cell share; those of one arm's joints and tool are in `Arm`.

    ``workspace (2, 3)``: lower and upper corner, metres, of the box in which fingertips stay;
    ``table_depth``: how deep a fingertip may be commanded below the table, the plane z = 0, metres;
    ``arm_distance``, ``link_distance``: least distance between the surfaces of two arms, and of two links of one arm
    that are not neighbours, metres; ``turn_per_step`` rad and ``step``
    metres: largest change of a tool between two waypoints of a plan; ``following_error`` rad: largest difference
    between a commanded and a measured joint.
    """

    workspace: FloatArray
    table_depth: float = TABLE_TOLERANCE_M
    arm_distance: float = ARM_DISTANCE_M
    link_distance: float = LINK_DISTANCE_M
    turn_per_step: float = TURN_PER_STEP_RAD
    step: float = STEP_M
    following_error: float = FOLLOWING_ERROR_RAD


def exceeded(who: str, what: str, value: float, limit: float, unit: str, key: str) -> str:
    """One line that names the limit, the value, and the key of the cell's file that changes it."""
    return f"{who}: {what} {value:.3g} {unit}, the limit is {limit:.3g} {unit} ({key} in the cell's file)"
