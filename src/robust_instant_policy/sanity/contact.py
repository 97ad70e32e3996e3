"""Does the gripper's path touch what its own start image shows?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.sanity.view import View
from robust_instant_policy.trajectory import Trajectory

PATH_STEPS = 60  # of a demonstration are compared with the image, and those at which a gripper closes
BETWEEN_FINGERS = np.array([0.0, 0.25, 0.5, 0.75, 1.0])  # points between the fingertips, as shares of the way
FARTHEST_M = 0.25  # larger distances count as this


@dataclass(frozen=True, eq=False)
class Contact:
    """How a path lies to a scene, in metres.

    ``path`` is the smallest gap over the path between the fingers and a raised surface (0: it passes through what
    the image shows there); ``grasps (G,)`` the gaps where grippers close; ``lowest`` the smallest height of a
    fingertip above the table, ``lowest_gripper_point`` that of a gripper point, where the table is seen: elsewhere
    there may be a hole; ``least_height`` that of both above the table's plane, hole or not; ``buried`` the largest
    depth of a gripper point behind a raised surface that also lies above it: what is only behind one may be free, if
    the camera looks from the side.
    """

    path: float
    grasps: FloatArray
    lowest: float
    lowest_gripper_point: float
    least_height: float
    buried: float


@dataclass(frozen=True, eq=False)
class GripperPath:
    """The steps of a trajectory that are compared with images.

    ``fingers (M, 3)`` points between the fingertips, ``gripper_points (P, 3)``, ``tips (2P, 3)`` and
    ``closings (G, 3)``, the middle between the fingertips where a gripper closes.
    """

    fingers: FloatArray
    gripper_points: FloatArray
    tips: FloatArray
    closings: FloatArray

    @classmethod
    def of(cls, trajectory: Trajectory) -> GripperPath:
        """Thin ``trajectory`` out; idle arms, which never move, touch nothing."""
        closing = closings(trajectory)
        steps = np.unique(np.round(np.linspace(0, len(trajectory) - 1, PATH_STEPS)).astype(np.intp))
        steps = np.union1d(steps, closing[:, 0])
        triplets = trajectory.triplets
        kept = triplets[steps].reshape(-1, 3, 3)
        left, right = kept[:, 1, None], kept[:, 2, None]
        fingers = (left + BETWEEN_FINGERS[:, None] * (right - left)).reshape(-1, 3)
        middles = triplets[:, :, 1:].mean(axis=2)
        return cls(fingers, kept[:, 0], kept[:, 1:].reshape(-1, 3), middles[closing[:, 0], closing[:, 1]])


def closings(trajectory: Trajectory) -> NDArray[np.intp]:
    """Step and arm ``(G, 2)`` of each first closed step."""
    closed = trajectory.gripper_state > 0.5
    return np.argwhere(closed[1:] & ~closed[:-1]) + np.array([1, 0])


def gaps(view: View, points: FloatArray) -> FloatArray:
    """Distance ``(N,)`` from ``points (N, 3)`` to the nearest raised surface, 0 inside or under one."""
    if len(points) == 0:
        return np.zeros(0)
    behind, raised = view.behind_surface(points)
    inside = raised & (np.nan_to_num(behind, nan=-1.0) >= 0) & (view.above_plane(points) > 0)
    distance = np.minimum(view.tree.query(points)[0], FARTHEST_M)
    return np.where(inside, 0.0, distance)


def contact(view: View, path: GripperPath) -> Contact:
    """How ``path`` lies to the scene of ``view``."""
    behind, raised = view.behind_surface(path.gripper_points)
    hidden = raised & np.isfinite(behind)
    hidden[hidden] = view.covered(path.gripper_points[hidden])
    buried = behind[hidden]
    return Contact(
        path=float(gaps(view, path.fingers).min()),
        grasps=gaps(view, path.closings),
        lowest=float(view.above_table(path.tips).min()),
        lowest_gripper_point=float(view.above_table(path.gripper_points).min()),
        least_height=float(view.above_plane(np.concatenate([path.tips, path.gripper_points])).min()),
        buried=float(buried.max(initial=0.0)),
    )
