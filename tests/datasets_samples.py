"""Small demonstrations for the tests of `datasets`, the same ones for the same seed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.geometry import GripperTriangle, make_pose
from robust_instant_policy.trajectory import Trajectory

TASK, DESCRIPTION, RATE_HZ = "push-cube", "push the cube to the goal", 55.0
HEIGHT, WIDTH = 48, 64


def observation(seed: int) -> Observation:
    random = np.random.default_rng(seed)
    depth = random.uniform(0.4, 1.6, (HEIGHT, WIDTH)).astype(np.float32)
    depth[0, :10] = np.nan
    depth[1, :10] = 0
    rgb = random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    intrinsics = np.array([[80.1, 0, 31.5], [0, 79.9, 23.5], [0, 0, 1]])
    return Observation(rgb, depth, intrinsics, make_pose(np.diag([1, -1, -1]), random.normal(size=3)))


def demonstration(seed: int | None, steps: int = 40, arms: int = 1) -> Demonstration:
    random = np.random.default_rng(seed or 0)
    poses = np.stack([make_pose(np.eye(3), position) for position in random.normal(size=(steps, 3)).cumsum(0) * 0.01])
    one_arm = Trajectory.from_poses(poses, np.arange(steps) > steps // 2, GripperTriangle(0.1, 0.08))
    trajectory = Trajectory.from_actions(np.tile(one_arm.actions, (1, arms)))
    return Demonstration(
        observation(seed or 0), trajectory, RATE_HZ, TASK, seed, {"manner": "slow – calm", "pause": np.float32(0.5)}
    )


def images(seed: int, steps: int = 40) -> np.ndarray:
    """A square that moves over a ramp, its colour the seed's."""
    ramp = np.linspace(40, 200, WIDTH).astype(np.uint8)
    frames = np.tile(ramp[None, None, :, None], (steps, HEIGHT, 1, 3))
    for step in range(steps):
        row, column = divmod(2 * step, WIDTH - 16)  # by two pixels, which is as fine as colour is kept
        frames[step, 8 * row : 8 * row + 16, column : column + 16] = (200, 40 + seed % 100, 60)
    return frames


def with_task(demo: Demonstration, task: str) -> Demonstration:
    return replace(demo, task=task)
