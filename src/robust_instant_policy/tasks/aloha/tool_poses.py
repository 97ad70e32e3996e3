"""Tool poses for the experts of the ALOHA tasks."""

import numpy as np

from robust_instant_policy.geometry import FloatArray, make_pose
from robust_instant_policy.tasks.aloha.robot import BASE_X_M
from robust_instant_policy.tasks.poses import pitched


def grip(point: FloatArray, pitch: float, yaw: float, beyond: float) -> FloatArray:
    """Tool pose ``(4, 4)`` with the rotation of `pitched`, its fingertips ``beyond`` metres past a point."""
    rotation = pitched(pitch, yaw)
    return make_pose(rotation, point + beyond * rotation[:, 2])


def back(pose: FloatArray, distance: float) -> FloatArray:
    """``pose`` moved back along its approach, in metres."""
    return make_pose(pose[:3, :3], pose[:3, 3] - distance * pose[:3, 2])


def over(point: FloatArray, height: float) -> FloatArray:
    """``point (3,)`` raised by ``height`` metres."""
    return point + np.array([0.0, 0.0, height])


def bearing(point: FloatArray) -> float:
    """Direction, in rad, from the working arm's base to ``point (3,)``.

    A gripper in this direction is in line with its forearm and pitches up with one joint; in other directions the
    forearm would have to roll.
    """
    return float(np.arctan2(point[1], point[0] + BASE_X_M))
