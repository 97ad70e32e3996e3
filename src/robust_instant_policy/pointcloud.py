"""Depth images as real cameras give them, and the table plane in the points that they hold."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robust_instant_policy.geometry import FloatArray

MILLIMETRES_ABOVE = 20.0  # a median depth beyond 20 "metres" is millimetres: arms do not reach that far
SURFACE_TOLERANCE = 0.015  # share of the depth within which neighbouring readings are one surface
STEADY_NEIGHBOURS = 3

ON_TABLE_M = 0.006  # points this near to a plane count for it
SAMPLED_POINTS = 1500
SAMPLED_PLANES = 200
MAX_LEVELS = 3  # horizontal planes that are compared with the largest one
MIN_LEVEL_SHARE = 0.2  # of the largest plane's points, for another one to be the table
TALLEST_OBJECT_M = 0.45  # whose top may be a plane above the table
LEVEL = 0.9  # upward part of a unit normal from which a plane counts as horizontal


def in_metres(image: ArrayLike) -> tuple[NDArray[np.float32], str]:
    """Depth with NaN for every missing reading, in metres, and a line that says so if it was in millimetres."""
    depth: NDArray[np.float32] = np.array(image, dtype=np.float32)
    depth[~np.isfinite(depth) | (depth <= 0)] = np.nan
    known = np.isfinite(depth)
    if known.any() and (median := float(np.median(depth[known]))) > MILLIMETRES_ABOVE:
        return (depth / 1000).astype(np.float32), f"depth with a median of {median:.0f} was read as millimetres"
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


def table_plane(points: FloatArray, seed: int) -> FloatArray:
    """Plane ``(4,)`` (unit normal, upward; offset) of the table in ``points (N, 3)``.

    Of the nearly horizontal planes with many points: the floor lies far under a table, the top of an object little
    above it. So a higher plane replaces a lower one if it is more than `TALLEST_OBJECT_M` above it.
    """
    rng = np.random.default_rng(seed)
    points = points[rng.choice(len(points), min(len(points), SAMPLED_POINTS), replace=False)]
    table = _largest_plane(points, rng)
    rest, found = points, int((_distances(table, points) < ON_TABLE_M).sum())
    plane = table
    for _ in range(MAX_LEVELS):
        rest = rest[_distances(plane, rest) >= ON_TABLE_M]
        if len(rest) < MIN_LEVEL_SHARE * found:
            break
        plane = _largest_plane(rest, rng)
        near = rest[_distances(plane, rest) < ON_TABLE_M]
        if len(near) < MIN_LEVEL_SHARE * found:
            break
        if np.median(near @ table[:3] + table[3]) > TALLEST_OBJECT_M:
            table = plane
    return table


def _distances(plane: FloatArray, points: FloatArray) -> FloatArray:
    return np.abs(points @ plane[:3] + plane[3])


def _largest_plane(points: FloatArray, rng: np.random.Generator) -> FloatArray:
    """The nearly horizontal plane ``(4,)`` that holds most of ``points (N, 3)``."""
    corners = points[rng.integers(len(points), size=(SAMPLED_PLANES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    level = (np.abs(normals[:, 2]) > LEVEL * lengths) & (lengths > 0)
    if not level.any():
        return np.array([0.0, 0.0, 1.0, -np.median(points[:, 2])])
    normals = normals[level] / (np.sign(normals[level, 2]) * lengths[level])[:, None]
    offsets = -(normals * corners[level, 0]).sum(axis=1)
    near = np.abs(points @ normals.T + offsets) < ON_TABLE_M
    best = near.sum(axis=0).argmax()
    inliers = points[near[:, best]]
    if len(inliers) < len(corners[0]):  # of points far away, a plane's own corners lie off it by rounding
        return np.append(normals[best], offsets[best])
    centre = inliers.mean(axis=0)
    normal = np.linalg.eigh(np.cov((inliers - centre).T))[1][:, 0]
    normal = normal * np.sign(normal[2])
    return np.append(normal, -normal @ centre)
