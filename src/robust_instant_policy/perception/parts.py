"""Parts of a piece of an image that move against the rest of it: doors, drawers, levers, and things that touched."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robust_instant_policy.geometry import FloatArray, invert_pose, project, transform_points
from robust_instant_policy.perception.view import GAP_M, MIN_FOREGROUND_POINTS, View, connected_pieces

UNEXPLAINED_M = 0.008  # distance from the surfaces of the other images
PERCENTILE = 75.0  # over the images: a part need not move in all of them
GREATEST_M = 0.05  # distance that counts
HIDDEN_M = 0.02  # behind the surface that the image shows there
SMOOTHING_POINTS = 8
MIN_SHARE = 0.05  # of a piece's points
MIN_GAIN = 0.5  # of the distances, by a motion of its own

BoolArray = NDArray[np.bool_]


def unexplained_part(points: FloatArray, views: Sequence[View], poses: Sequence[FloatArray]) -> BoolArray:
    """The largest connected part of ``points (N, 3)`` that one rigid motion ``poses`` into each of ``views`` leaves off
    the surfaces there; empty if it is small, or nearly all.
    """
    none = np.zeros(len(points), dtype=bool)
    off = np.flatnonzero(_distances(points, views, poses) > UNEXPLAINED_M)
    if len(off) < MIN_FOREGROUND_POINTS:
        return none
    number = connected_pieces(points[off], GAP_M)
    part = none.copy()
    part[off[number == np.bincount(number).argmax()]] = True
    return part if _is_large(part) else none


def moving_part(
    points: FloatArray,
    part: BoolArray,
    views: Sequence[View],
    rest_poses: Sequence[FloatArray],
    part_poses: Sequence[FloatArray],
    whole_poses: Sequence[FloatArray],
) -> BoolArray:
    """Those of ``points (N, 3)`` that the motions of a ``part (N,)`` explain better than those of the rest.

    Empty where the part's own motions do not explain it much better than the whole's.
    """
    own = _distances(points, views, part_poses)
    before = _distances(points, views, whole_poses)
    none = np.zeros(len(points), dtype=bool)
    if own[part].mean() > (1 - MIN_GAIN) * before[part].mean():
        return none
    better = own < _distances(points, views, rest_poses)
    inside = np.flatnonzero(better | part)
    number = connected_pieces(points[inside], GAP_M)
    grown = none.copy()
    grown[inside[number == np.bincount(number[part[inside]]).argmax()]] = True
    grown &= better
    return grown if _is_large(grown) else none


def _is_large(part: BoolArray) -> bool:
    """Whether both a part and the rest are large enough to be registered."""
    least = max(MIN_FOREGROUND_POINTS, MIN_SHARE * len(part))
    return least <= part.sum() <= len(part) - least


def _distances(points: FloatArray, views: Sequence[View], poses: Sequence[FloatArray]) -> FloatArray:
    """`PERCENTILE` over ``views`` of the distances ``(N,)`` of moved ``points (N, 3)`` from the surfaces there, metres.

    Smoothed over neighbours; views that do not show a point do not count.
    """
    distances = np.empty((len(views), len(points)))
    for row, (view, pose) in enumerate(zip(views, poses, strict=True)):
        moved = transform_points(pose, points)
        distances[row] = np.minimum(cKDTree(view.points).query(moved)[0], GREATEST_M)
        camera = view.observation
        pixels = np.rint(project(moved, camera.intrinsics, camera.camera_pose)).astype(int)
        height, width = view.depth.shape
        seen = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
        u, v = pixels.clip(0, (width - 1, height - 1)).T
        behind = transform_points(invert_pose(camera.camera_pose), moved)[:, 2] - view.depth[v, u]
        distances[row, ~seen | (behind > HIDDEN_M)] = np.nan
    known = np.isfinite(distances).any(axis=0)
    typical = np.zeros(len(points))
    typical[known] = np.nanpercentile(distances[:, known], PERCENTILE, axis=0)
    near = cKDTree(points).query(points, min(SMOOTHING_POINTS, len(points)))[1]
    return typical[near].mean(axis=1)
