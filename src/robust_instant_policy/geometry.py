"""Poses, cameras and the gripper triangle.

Poses are homogeneous matrices ``(4, 4)`` float64 that map points of the named frame into the world.
The world frame is right-handed, in metres, z up. Camera frames follow OpenCV: x right, y down, z forward.
The tool frame of a parallel gripper has its origin midway between the fingertips, z along the approach
(out of the gripper) and y along the line on which the fingers open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from robust_instant_policy.errors import InvalidValueError

FloatArray = NDArray[np.float64]

MIN_TRIANGLE_HEIGHT_M = 1e-3  # below this the three gripper points say nothing about orientation


def make_pose(rotation: ArrayLike, position: ArrayLike) -> FloatArray:
    """Pose ``(4, 4)`` from a rotation matrix ``(3, 3)`` and a position ``(3,)``."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = position
    return pose


def invert_pose(pose: ArrayLike) -> FloatArray:
    """Inverse of a rigid pose ``(4, 4)``."""
    pose = np.asarray(pose, dtype=np.float64)
    rotation = pose[:3, :3].T
    return make_pose(rotation, -rotation @ pose[:3, 3])


def transform_points(pose: ArrayLike, points: ArrayLike) -> FloatArray:
    """Map ``points (..., 3)`` of a frame into the world by its ``pose (4, 4)``."""
    pose = np.asarray(pose, dtype=np.float64)
    return np.asarray(points, dtype=np.float64) @ pose[:3, :3].T + pose[:3, 3]


def fit_rigid(source: ArrayLike, target: ArrayLike, weights: ArrayLike | None = None) -> FloatArray:
    """Proper rigid motion that maps ``source`` onto ``target`` with the least (weighted) squared error.

    Batched: ``source`` and ``target`` are ``(..., N, 3)``, ``weights`` ``(..., N)``; the result is
    ``(..., 4, 4)`` with determinant +1 (Kabsch 1976; Umeyama 1991 for the reflection case).
    """
    source = np.asarray(source, dtype=np.float64)
    target = np.asarray(target, dtype=np.float64)
    share = np.ones(np.broadcast_shapes(source.shape, target.shape)[:-1])
    if weights is not None:
        share = share * np.asarray(weights, dtype=np.float64)
    share = (share / share.sum(axis=-1, keepdims=True))[..., None]
    source_mean = (share * source).sum(axis=-2, keepdims=True)
    target_mean = (share * target).sum(axis=-2, keepdims=True)
    covariance = np.swapaxes(share * (target - target_mean), -1, -2) @ (source - source_mean)
    left, _, right = np.linalg.svd(covariance)
    signs = np.ones(covariance.shape[:-1])
    signs[..., 2] = np.sign(np.linalg.det(left @ right))
    rotation = (left * signs[..., None, :]) @ right
    pose = np.zeros((*rotation.shape[:-2], 4, 4))
    pose[..., :3, :3] = rotation
    pose[..., :3, 3] = target_mean[..., 0, :] - (rotation @ np.swapaxes(source_mean, -1, -2))[..., 0]
    pose[..., 3, 3] = 1.0
    return pose


def interpolate_poses(times: ArrayLike, poses: ArrayLike, at: ArrayLike) -> FloatArray:
    """Poses ``(M, 4, 4)`` at times ``at (M,)``: positions linear, rotations on the shortest arc.

    ``times (N,)`` must increase; times outside are clamped to the ends.
    """
    times = np.asarray(times, dtype=np.float64)
    poses = np.asarray(poses, dtype=np.float64)
    at = np.clip(np.asarray(at, dtype=np.float64), times[0], times[-1])
    if len(times) == 1:
        return np.repeat(poses, len(at), axis=0)
    result = np.tile(np.eye(4), (len(at), 1, 1))
    result[:, :3, :3] = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
    for axis in range(3):
        result[:, axis, 3] = np.interp(at, times, poses[:, axis, 3])
    return result


def project(points: ArrayLike, intrinsics: ArrayLike, camera_pose: ArrayLike) -> FloatArray:
    """Pixels ``(..., 2)`` (column u, row v) of world ``points (..., 3)``; pixel centres are integers."""
    local = transform_points(invert_pose(camera_pose), points)
    image = local @ np.asarray(intrinsics, dtype=np.float64).T
    return image[..., :2] / image[..., 2:]


def lift(pixels: ArrayLike, depth: ArrayLike, intrinsics: ArrayLike, camera_pose: ArrayLike) -> FloatArray:
    """World points ``(..., 3)`` of ``pixels (..., 2)`` (u, v) at ``depth (...)`` metres along the optical axis."""
    pixels = np.asarray(pixels, dtype=np.float64)
    rays = np.concatenate([pixels, np.ones((*pixels.shape[:-1], 1))], axis=-1)
    rays = rays @ np.linalg.inv(np.asarray(intrinsics, dtype=np.float64)).T
    return transform_points(camera_pose, rays * np.asarray(depth, dtype=np.float64)[..., None])


@dataclass(frozen=True)
class GripperTriangle:
    """The rigid triangle of palm and open fingertips that stands for a gripper's pose.

    ``length`` is the distance from the palm point to the midpoint of the fingertips, ``opening`` the
    distance between the open fingertips, both in metres. In the tool frame the palm lies at
    ``(0, 0, -length)`` and the fingertips at ``(0, ±opening/2, 0)``, the first at +y.
    """

    length: float
    opening: float

    def __post_init__(self) -> None:
        if not (self.length > MIN_TRIANGLE_HEIGHT_M and self.opening > MIN_TRIANGLE_HEIGHT_M):
            raise InvalidValueError(
                f"a gripper of length {self.length:.4f} m and opening {self.opening:.4f} m has no orientation; "
                "palm and fingertips must be three distinct points, in metres"
            )

    @classmethod
    def from_triplets(cls, triplets: ArrayLike) -> GripperTriangle:
        """Median lengths of measured ``triplets (..., 3, 3)`` (palm, fingertip, fingertip)."""
        triplets = np.asarray(triplets, dtype=np.float64)
        palm, left, right = triplets[..., 0, :], triplets[..., 1, :], triplets[..., 2, :]
        return cls(
            float(np.median(np.linalg.norm((left + right) / 2 - palm, axis=-1))),
            float(np.median(np.linalg.norm(left - right, axis=-1))),
        )

    @property
    def points(self) -> FloatArray:
        """Palm and fingertips ``(3, 3)`` in the tool frame."""
        half = self.opening / 2
        return np.array([[0.0, 0.0, -self.length], [0.0, half, 0.0], [0.0, -half, 0.0]])

    def triplets(self, poses: ArrayLike) -> FloatArray:
        """World triplets ``(..., 3, 3)`` of tool ``poses (..., 4, 4)``."""
        poses = np.asarray(poses, dtype=np.float64)
        return self.points @ np.swapaxes(poses[..., :3, :3], -1, -2) + poses[..., None, :3, 3]

    def poses(self, triplets: ArrayLike) -> FloatArray:
        """Tool poses ``(..., 4, 4)`` whose rigid triangle fits ``triplets (..., 3, 3)`` best."""
        return fit_rigid(self.points, triplets)
