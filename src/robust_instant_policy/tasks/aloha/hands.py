"""What experts say about the hand."""

from __future__ import annotations

import numpy as np

from robust_instant_policy.geometry import FloatArray, make_pose
from robust_instant_policy.tasks.aloha.robot import BASE_X_M
from robust_instant_policy.tasks.poses import pitched


def grip(point: FloatArray, pitch: float, yaw: float, beyond: float) -> FloatArray:
    """Tool pose ``(4, 4)`` of a hand, turned as in `pitched`, whose fingertips reach ``beyond`` metres past a point."""
    hand = pitched(pitch, yaw)
    return make_pose(hand, point + beyond * hand[:, 2])


def back(pose: FloatArray, distance: float) -> FloatArray:
    """``pose`` drawn back along its approach, in metres."""
    return make_pose(pose[:3, :3], pose[:3, 3] - distance * pose[:3, 2])


def over(point: FloatArray, height: float) -> FloatArray:
    """``point (3,)`` raised by ``height`` metres."""
    return point + np.array([0.0, 0.0, height])


def bearing(point: FloatArray) -> float:
    """Direction, in rad, in which the working arm sees ``point (3,)``.

    A hand that points that way is in line with its forearm and turns up without effort; at an angle to it, the
    forearm would have to roll over.
    """
    return float(np.arctan2(point[1], point[0] + BASE_X_M))
