"""Depth as real cameras give it: holes, flying pixels at edges, sometimes millimetres."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robust_instant_policy.geometry import FloatArray

MILLIMETRES_ABOVE = 20.0  # a median depth beyond 20 "metres" is millimetres: arms do not reach that far
SURFACE_TOLERANCE = 0.015  # share of the depth within which neighbouring readings are one surface
STEADY_NEIGHBOURS = 3
MIN_SUPPORT = 3  # readings of a surface below which it is taken for flying pixels


def in_metres(image: ArrayLike) -> tuple[NDArray[np.float32], str]:
    """Depth with NaN for every missing reading, in metres, and a line that says so if it was in millimetres."""
    depth: NDArray[np.float32] = np.array(image, dtype=np.float32)
    depth[~np.isfinite(depth) | (depth <= 0)] = np.nan
    if np.isfinite(depth).any() and np.nanmedian(depth) > MILLIMETRES_ABOVE:
        return (depth / 1000).astype(
            np.float32
        ), f"depth with a median of {np.nanmedian(depth):.0f} was read as millimetres"
    return depth, ""


def steady(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels ``(H, W)`` that have a reading and agree with `STEADY_NEIGHBOURS` of their four neighbours."""
    agree = np.zeros(depth.shape, dtype=np.uint8)
    down = np.abs(depth[1:] - depth[:-1]) < SURFACE_TOLERANCE * depth[1:]
    right = np.abs(depth[:, 1:] - depth[:, :-1]) < SURFACE_TOLERANCE * depth[:, 1:]
    agree[1:] += down
    agree[:-1] += down
    agree[:, 1:] += right
    agree[:, :-1] += right
    return agree >= STEADY_NEIGHBOURS


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
