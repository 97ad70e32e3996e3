"""Scenes with simulated keypoints in which a gripper moves an object, to measure language models.

Two objects with random position and rotation, five keypoints on each, measured with noise; the gripper grasps the first
object in its own frame and sets it down. The error is the largest distance of any of the three gripper points from
the truth at any key step: start, both sides of the grasp and of the release, end.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from robust_instant_policy.geometry import FloatArray, GripperTriangle, make_pose
from robust_instant_policy.trajectory import Trajectory, downsample

TRIANGLE = GripperTriangle(length=0.10, opening=0.08)
KEYPOINT_NOISE_M = 0.002
HAND_NOISE_M = 0.002  # of a demonstrator's waypoints
HAND_NOISE_RAD = np.radians(2.0)
WITHIN_M = 0.015
HOME = make_pose(np.diag([1.0, -1.0, -1.0]), [0.30, 0.0, 0.35])
TASKS = ("place", "midway")


@dataclass(frozen=True, eq=False)
class Scene:
    """Measured keypoints ``(K, 3)`` and the demonstrated trajectory."""

    keypoints: FloatArray
    trajectory: Trajectory


class PickAndPlace:
    """Draws scenes. The objects' keypoints and the grasp depend on ``seed``.

    In the task "place" the gripper sets the first object down in the frame of the second, so that each step is the
    same in some object's frame. In "midway" it does so half-way between the two, which is constant in no object's
    frame: the median of the demonstrations is wrong.
    """

    def __init__(self, task: str = "place", seed: int = 0):
        self.task = task
        rng = np.random.default_rng(seed)
        self.shapes = rng.uniform([-0.04, -0.04, 0.0], [0.04, 0.04, 0.03], (2, 5, 3))
        self.grasp = _down(rng.uniform(-0.01, 0.01, 2), 0.02, rng.uniform(-0.5, 0.5))
        self.place = _down(rng.uniform(-0.01, 0.01, 2), 0.05, rng.uniform(-0.5, 0.5))

    def scene(self, seed: int, *, exact: bool = False) -> Scene:
        """Scene of ``seed``; ``exact`` removes the demonstrator's noise (the keypoints stay noisy)."""
        rng = np.random.default_rng([7, seed])
        while True:
            places = rng.uniform([0.35, -0.25], [0.65, 0.25], (2, 2))
            if np.linalg.norm(places[0] - places[1]) > 0.15:
                break
        objects = [_turned(place, angle) for place, angle in zip(places, rng.uniform(-1.5, 1.5, 2), strict=True)]
        keypoints = np.concatenate(
            [shape @ pose[:3, :3].T + pose[:3, 3] for shape, pose in zip(self.shapes, objects, strict=True)]
        )
        keypoints = keypoints + rng.normal(0, KEYPOINT_NOISE_M, keypoints.shape)
        grasp, place = objects[0] @ self.grasp, objects[1] @ self.place
        if self.task == "midway":
            place = make_pose(place[:3, :3], [*places.mean(axis=0), place[2, 3]])
        if not exact:
            grasp, place = _shaken(grasp, rng), _shaken(place, rng)
        ways = [
            (HOME, 0),
            (_raised(grasp, 0.10), 0),
            (grasp, 0),
            (grasp, 1),
            (_raised(grasp, 0.12), 1),
            (_raised(place, 0.12), 1),
            (place, 1),
            (place, 0),
            (_raised(place, 0.12), 0),
        ]
        return Scene(keypoints, downsample(_played(ways, rng)))


def _played(ways: list[tuple[FloatArray, int]], rng: np.random.Generator) -> Trajectory:
    poses, states = [ways[0][0][None]], [np.array([ways[0][1]])]
    for (start, _), (stop, state) in pairwise(ways):
        count = max(2, round(np.linalg.norm(stop[:3, 3] - start[:3, 3]) / 0.005 * rng.uniform(0.8, 1.25)))
        poses.append(between(start, stop, np.arange(1, count + 1) / count))
        states.append(np.full(count, state))
    return Trajectory.from_poses(np.concatenate(poses), np.concatenate(states), TRIANGLE)


def between(start: FloatArray, stop: FloatArray, shares: FloatArray) -> FloatArray:
    """Poses ``(N, 4, 4)`` at ``shares (N,)`` of a straight way that turns evenly."""
    poses = np.tile(np.eye(4), (len(shares), 1, 1))
    poses[:, :3, :3] = Slerp([0, 1], Rotation.from_matrix([start[:3, :3], stop[:3, :3]]))(shares).as_matrix()
    poses[:, :3, 3] = start[:3, 3] + shares[:, None] * (stop[:3, 3] - start[:3, 3])
    return poses


def _turned(place: FloatArray, angle: float) -> FloatArray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return make_pose([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], [*place, 0])


def _down(place: FloatArray, height: float, angle: float) -> FloatArray:
    return make_pose(_turned(place, angle)[:3, :3] @ np.diag([1.0, -1.0, -1.0]), [*place, height])


def _raised(pose: FloatArray, height: float) -> FloatArray:
    return make_pose(pose[:3, :3], pose[:3, 3] + [0, 0, height])


def _shaken(pose: FloatArray, rng: np.random.Generator) -> FloatArray:
    turn = _turned(np.zeros(2), rng.normal(0, HAND_NOISE_RAD))[:3, :3]
    return make_pose(turn @ pose[:3, :3], pose[:3, 3] + rng.normal(0, HAND_NOISE_M, 3))


def key_steps(trajectory: Trajectory) -> list[int]:
    """The start, both sides of every gripper change, and the end."""
    changes = np.flatnonzero(np.diff(np.round(trajectory.gripper_state[:, 0])))
    return [0, *(int(step) + side for step in changes for side in (0, 1)), len(trajectory) - 1]


def key_error(trajectory: Trajectory, truth: Trajectory) -> float:
    """Largest distance of the three gripper points from the truth at any key step, metres; infinite if the
    number of gripper changes differs."""
    own, true = key_steps(trajectory), key_steps(truth)
    if len(own) != len(true):
        return float("inf")
    return float(np.linalg.norm(trajectory.triplets[own] - truth.triplets[true], axis=-1).max())
