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

from robust_instant_policy.errors import InvalidValueError

FloatArray = NDArray[np.float64]

MAD_TO_STD = 1.4826  # standard deviation of a Gaussian over its median absolute deviation
MIN_TRIANGLE_HEIGHT_M = 1e-3  # below this the three gripper points say nothing about orientation


def as_numbers(name: str, values: ArrayLike, dtype: type = np.float64) -> NDArray:
    """A copy of ``values`` as an array of ``dtype``; raises `InvalidValueError` that calls it ``name``."""
    try:
        array = np.asarray(values)
        if array.dtype.kind not in "biuf":  # NumPy would read strings and drop imaginary parts
            raise ValueError(f"{array.dtype} is no type of real numbers")
        with np.errstate(over="ignore"):  # too large for float32 is infinite
            return array.astype(dtype)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise InvalidValueError(f"{name} must be an array of numbers, got {type(values).__name__} ({error})") from None


def robust_std(values: FloatArray) -> FloatArray:
    """Standard deviation over the first axis, from the median absolute deviation."""
    return MAD_TO_STD * np.asarray(np.median(np.abs(values - np.median(values, axis=0)), axis=0))


def make_pose(rotation: ArrayLike, position: ArrayLike) -> FloatArray:
    """Poses ``(..., 4, 4)`` from rotation matrices ``(..., 3, 3)`` and positions ``(..., 3)``."""
    pose = np.zeros((*np.shape(rotation)[:-2], 4, 4))
    pose[..., :3, :3] = rotation
    pose[..., :3, 3] = position
    pose[..., 3, 3] = 1.0
    return pose


def invert_pose(pose: ArrayLike) -> FloatArray:
    """Inverse of rigid poses ``(..., 4, 4)``."""
    pose = np.asarray(pose, dtype=np.float64)
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    return make_pose(rotation, (-rotation @ pose[..., :3, 3:])[..., 0])


def transform_points(pose: ArrayLike, points: ArrayLike) -> FloatArray:
    """Map ``points (..., 3)`` of a frame into the world by its ``pose (4, 4)``; or ``(..., N, 3)`` of several frames,
    each by its ``pose (..., 4, 4)``."""
    pose = np.asarray(pose, dtype=np.float64)
    position = pose[:3, 3] if pose.ndim == 2 else pose[..., None, :3, 3]
    return np.asarray(points, dtype=np.float64) @ np.swapaxes(pose[..., :3, :3], -1, -2) + position


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
    return make_pose(rotation, target_mean[..., 0, :] - (rotation @ np.swapaxes(source_mean, -1, -2))[..., 0])


def rotations_about_vertical(angles: ArrayLike) -> FloatArray:
    """Rotations ``(..., 3, 3)`` by ``angles (...)`` radians about the world's z axis."""
    rotation = np.zeros((*np.shape(angles), 3, 3))
    rotation[..., 0, 0] = rotation[..., 1, 1] = np.cos(angles)
    rotation[..., 1, 0] = np.sin(angles)
    rotation[..., 0, 1] = -rotation[..., 1, 0]
    rotation[..., 2, 2] = 1.0
    return rotation


def fit_upright(source: FloatArray, target: FloatArray, weights: FloatArray) -> FloatArray:
    """Motion about the vertical that maps ``source`` onto ``target`` with the least weighted squared error.

    Batched like `fit_rigid`: ``source`` and ``target`` are ``(..., N, 3)``, ``weights`` ``(..., N)``; the result is
    ``(..., 4, 4)``.
    """
    share = weights / weights.sum(axis=-1, keepdims=True)
    weighted = np.swapaxes(source * share[..., None], -1, -2)
    source_mean = weighted.sum(axis=-1)
    target_mean = (share[..., None, :] @ target)[..., 0, :]
    products = weighted @ target - source_mean[..., :, None] * target_mean[..., None, :]
    sine = products[..., 0, 1] - products[..., 1, 0]
    rotation = rotations_about_vertical(np.arctan2(sine, products[..., 0, 0] + products[..., 1, 1]))
    return make_pose(rotation, target_mean - (rotation @ source_mean[..., None])[..., 0])


def interpolate(at: np.ndarray, times: np.ndarray, values: FloatArray) -> FloatArray:
    """``values (T, D)`` at increasing ``times (T,)``, linearly interpolated at ``at (M,)``: ``(M, D)``."""
    return np.stack([np.interp(at, times, column) for column in values.T], axis=1)


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
    """The rigid triangle of gripper point and open fingertips that stands for a gripper's pose.

    ``length`` is the distance from the gripper point to the midpoint of the fingertips, ``opening`` the
    distance between the open fingertips, both in metres. In the tool frame the gripper point lies at
    ``(0, 0, -length)`` and the fingertips at ``(0, ±opening/2, 0)``, the first at +y. Any point of the gripper
    behind the fingertips on the approach axis will do; the simulated UR5e and ALOHA tasks take the arm's flange.
    """

    length: float
    opening: float

    def __post_init__(self) -> None:
        if not (MIN_TRIANGLE_HEIGHT_M < self.length < np.inf and MIN_TRIANGLE_HEIGHT_M < self.opening < np.inf):
            raise InvalidValueError(
                f"a gripper of length {self.length:.4f} m and opening {self.opening:.4f} m has no orientation; "
                "gripper point and fingertips must be three distinct points, in metres"
            )

    @classmethod
    def from_triplets(cls, triplets: ArrayLike) -> GripperTriangle:
        """Median lengths of measured ``triplets (..., 3, 3)`` (gripper point, fingertip, fingertip)."""
        triplets = np.asarray(triplets, dtype=np.float64)
        point, left, right = triplets[..., 0, :], triplets[..., 1, :], triplets[..., 2, :]
        return cls(
            float(np.median(np.linalg.norm((left + right) / 2 - point, axis=-1))),
            float(np.median(np.linalg.norm(left - right, axis=-1))),
        )

    @property
    def points(self) -> FloatArray:
        """Gripper point and fingertips ``(3, 3)`` in the tool frame."""
        half = self.opening / 2
        return np.array([[0.0, 0.0, -self.length], [0.0, half, 0.0], [0.0, -half, 0.0]])

    def triplets(self, poses: ArrayLike) -> FloatArray:
        """World triplets ``(..., 3, 3)`` of tool ``poses (..., 4, 4)``."""
        return transform_points(poses, self.points)

    def poses(self, triplets: ArrayLike) -> FloatArray:
        """Tool poses ``(..., 4, 4)`` whose rigid triangle fits ``triplets (..., 3, 3)`` best."""
        return fit_rigid(self.points, triplets)
