"""The actions of both: absolute tool poses in the world.

For each arm ten numbers: the origin of the tool frame, x, y, z in metres (between the fingertips); the first and the
second column of its rotation matrix (rot6d; z points out of the gripper, y along the line on which the fingers open);
and the gripper, 1 open, 0 closed.
"""

from __future__ import annotations

import numpy as np
from inspect_robots.spaces import ActionSemantics, Box

from robust_instant_policy.geometry import FloatArray, GripperTriangle
from robust_instant_policy.trajectory import Trajectory

SIZE = 10  # numbers for each arm
REACH_M = 2.0  # bound of a coordinate
LABELS = ("x", "y", "z", "r00", "r10", "r20", "r01", "r11", "r21", "gripper")


def action_space(num_arms: int) -> Box:
    """The space of actions. Its whole range counts as safe for one step: the twin times each waypoint by the arm's
    speed limit, so a waypoint that is far away takes longer."""
    low = np.tile([*[-REACH_M] * 3, *[-1.0] * 6, 0.0], num_arms)
    high = np.tile([*[REACH_M] * 3, *[1.0] * 6, 1.0], num_arms)
    labels = LABELS if num_arms == 1 else tuple(f"arm_{arm}.{name}" for arm in range(num_arms) for name in LABELS)
    semantics = ActionSemantics("eef_abs_pose", "rot6d", "binary", "world", labels, tuple(high - low))
    return Box((SIZE * num_arms,), low, high, semantics)


def to_actions(trajectory: Trajectory, triangle: GripperTriangle) -> FloatArray:
    """Actions ``(T, 10·A)`` of a trajectory."""
    poses = triangle.poses(trajectory.triplets)
    columns = np.swapaxes(poses[..., :3, :2], -1, -2).reshape(*poses.shape[:2], 6)
    opened = 1 - trajectory.gripper_state[..., None]
    return np.concatenate([poses[..., :3, 3], columns, opened], axis=-1).reshape(len(trajectory), -1)


def to_waypoint(action: FloatArray, triangle: GripperTriangle) -> FloatArray:
    """A row ``(1, 10·A)`` as in `Trajectory` of an action ``(10·A,)``; columns are made orthonormal (Gram-Schmidt)."""
    rows = np.asarray(action, dtype=np.float64).reshape(-1, SIZE)
    poses = np.tile(np.eye(4), (1, len(rows), 1, 1))
    x = rows[:, 3:6] / np.linalg.norm(rows[:, 3:6], axis=1, keepdims=True)
    y = rows[:, 6:9] - (rows[:, 6:9] * x).sum(axis=1, keepdims=True) * x
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    poses[0, :, :3, :3] = np.stack([x, y, np.cross(x, y)], axis=-1)
    poses[0, :, :3, 3] = rows[:, :3]
    return Trajectory.from_poses(poses, (rows[None, :, 9] < 0.5).astype(float), triangle).actions
