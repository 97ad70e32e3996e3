"""Depth of a surface where the image has holes and flying pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.pointcloud import SURFACE_TOLERANCE

MIN_SUPPORT = 3  # readings of a surface below which it is taken for flying pixels


def surface_depth(depth: NDArray[np.float32], pixels: ArrayLike, radius: int = 2) -> FloatArray:
    """Depth ``(N,)`` of the surface seen at ``pixels (N, 2)``, in the unit of ``depth``; NaN where there is none.

    The readings within ``radius`` pixels are split into surfaces wherever they jump by more than
    `SURFACE_TOLERANCE`. The surface of the centre pixel counts if at least `MIN_SUPPORT` readings belong to it,
    otherwise (a hole, a flying pixel) the one with the most readings, the nearer of two. The answer is its median.
    """
    height, width = depth.shape
    centre = np.rint(np.asarray(pixels, dtype=np.float64)).astype(np.intp)
    offsets = np.arange(-radius, radius + 1)
    rows = centre[:, 1, None, None] + offsets[:, None]
    cols = centre[:, 0, None, None] + offsets
    inside = (rows >= 0) & (rows < height) & (cols >= 0) & (cols < width)
    windows = np.where(inside, depth[rows.clip(0, height - 1), cols.clip(0, width - 1)], np.nan)
    windows = windows.reshape(len(centre), -1)
    middle = windows[:, windows.shape[1] // 2]
    readings = np.sort(windows, axis=1)  # missing ones last
    rows, last = np.arange(len(readings)), windows.shape[1] - 1
    jump = np.diff(readings, axis=1) > SURFACE_TOLERANCE * readings[:, :-1]
    surface = np.zeros(windows.shape, dtype=np.intp)  # number of the surface that a reading belongs to
    surface[:, 1:] = jump.cumsum(axis=1)
    numbers = surface + rows[:, None] * windows.shape[1]
    size = np.bincount(numbers[np.isfinite(readings)], minlength=readings.size).reshape(windows.shape)
    # A missing centre is compared false throughout, so it belongs to no surface.
    own = surface[rows, np.minimum((readings < middle[:, None]).sum(axis=1), last)]
    chosen = np.where(np.isfinite(middle) & (size[rows, own] >= MIN_SUPPORT), own, size.argmax(axis=1))
    count = size[rows, chosen]
    first = (surface < chosen[:, None]).sum(axis=1)
    lower = readings[rows, first + np.maximum(count - 1, 0) // 2].astype(np.float64)
    upper = readings[rows, np.minimum(first + count // 2, last)]
    return np.where(count >= MIN_SUPPORT, (lower + upper) / 2, np.nan)
