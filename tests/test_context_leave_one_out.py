"""How well demonstrations predict each other."""

import numpy as np

from robust_instant_policy.context import leave_one_out, write_prompt
from robust_instant_policy.geometry import GripperTriangle, make_pose
from robust_instant_policy.trajectory import Trajectory

DOWN = np.diag([1.0, -1.0, -1.0])
GRIPPER = GripperTriangle(length=0.1, opening=0.05)


def shown(objects: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, list[Trajectory]]:
    """Keypoints (I, 4, 3) of an object, and grasps of it that miss it by ``offsets`` (I, 3)."""
    corners = 0.02 * np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 1]], dtype=float)
    paths = []
    for place, offset in zip(objects, offsets, strict=True):
        way = np.linspace([0, 0, 0.3], place + offset, 12)
        poses = np.stack([make_pose(DOWN, point) for point in [*way, *way[::-1]]])
        paths.append(Trajectory.from_poses(poses, np.arange(24) > 11, GRIPPER))
    return objects[:, None] + corners, paths


def test_demonstrations_that_do_the_same_predict_each_other_and_scattered_ones_do_not():
    rng = np.random.default_rng(0)
    objects = np.column_stack([rng.uniform(0.3, 0.6, 10), rng.uniform(-0.2, 0.2, 10), np.full(10, 0.02)])
    errors = leave_one_out(write_prompt(*shown(objects, np.zeros((10, 3)))))
    assert errors.max() < 0.003
    scattered = leave_one_out(write_prompt(*shown(objects, rng.normal(0, 0.03, (10, 3)) * [1, 1, 0])))
    assert np.median(scattered.max(axis=1)) > 0.02


def test_two_demonstrations_tell_nothing():
    objects = np.array([[0.4, 0.0, 0.02], [0.5, 0.1, 0.02]])
    assert np.isnan(leave_one_out(write_prompt(*shown(objects, np.zeros((2, 3)))))).all()
