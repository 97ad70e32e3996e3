"""Depth of the surface at a pixel, in images with holes and flying pixels."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, lift, project
from robust_instant_policy.perception.descriptors import Float32Array
from robust_instant_policy.pointcloud import SURFACE_TOLERANCE

WINDOW_PX = 2  # on each side of a pixel
MIN_SUPPORT = 3  # readings; fewer are flying pixels
MAX_LIFT_M = 0.02  # a surface further from where a point is expected is another object's


def surface_depth(depth: Float32Array, pixels: ArrayLike) -> FloatArray:
    """Depth ``(N,)`` of the surface at ``pixels (N, 2)``, in the unit of ``depth (H, W)``; NaN where there is none.

    The readings of a window, sorted, are split into surfaces where they jump by more than `SURFACE_TOLERANCE`. The
    result is the median of the centre's surface if that has `MIN_SUPPORT` readings, otherwise (a hole, a flying
    pixel) of the surface with the most, the nearest of equals.
    """
    height, width = depth.shape
    centre = np.rint(np.asarray(pixels, dtype=np.float64)).astype(np.intp)
    offsets = np.arange(-WINDOW_PX, WINDOW_PX + 1)
    rows = centre[:, 1, None, None] + offsets[:, None]
    cols = centre[:, 0, None, None] + offsets
    inside = (rows >= 0) & (rows < height) & (cols >= 0) & (cols < width)
    windows = np.where(inside, depth[rows.clip(0, height - 1), cols.clip(0, width - 1)], np.nan)
    windows = windows.reshape(len(centre), -1)
    middle = windows[:, windows.shape[1] // 2, None]
    readings = np.sort(windows, axis=1)  # missing ones last
    jumps = np.diff(readings, axis=1) > SURFACE_TOLERANCE * readings[:, :-1]
    surface = np.pad(jumps.cumsum(axis=1), ((0, 0), (1, 0)))
    same = (surface[:, :, None] == surface[:, None, :]) & np.isfinite(readings)[:, None, :]
    support = same.sum(axis=2)
    preferred = (readings == middle) & (support >= MIN_SUPPORT)
    chosen = np.where(preferred, readings.shape[1], support).argmax(axis=1)
    members = np.take_along_axis(same, chosen[:, None, None], axis=1)[:, 0]
    members &= members.sum(axis=1, keepdims=True) >= MIN_SUPPORT
    return np.ma.filled(np.ma.median(np.ma.array(readings.astype(np.float64), mask=~members), axis=1), np.nan)


def lift_to_surface(
    observation: Observation, depth: Float32Array, points: FloatArray, reach: ArrayLike = MAX_LIFT_M
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """``points (N, 3)``, metres, world, moved along their rays onto the surface in ``depth (H, W)``, metres.

    Also their pixels ``(N, 2)`` and which have a surface within ``reach``, metres; the others stay where they are.
    """
    pixels = project(points, observation.intrinsics, observation.camera_pose)
    found = surface_depth(depth, pixels)
    lifted = lift(pixels, np.nan_to_num(found), observation.intrinsics, observation.camera_pose)
    measured = np.isfinite(found) & (np.linalg.norm(lifted - points, axis=1) < reach)
    return np.where(measured[:, None], lifted, points), pixels, measured
