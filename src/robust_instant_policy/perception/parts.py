"""Parts of a piece of an image that move against the rest of it: doors, drawers, levers, and things that touched."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from robust_instant_policy.geometry import FloatArray, project, transform_points
from robust_instant_policy.perception.descriptors import IntArray
from robust_instant_policy.perception.pieces import GAP_M, connected_pieces
from robust_instant_policy.perception.view import View

UNEXPLAINED_M = 0.008  # distance from the surfaces of the other images
PERCENTILE = 75.0  # over the images: a part need not move in all of them
GREATEST_M = 0.05  # distance that counts
SMOOTHING_POINTS = 8
THIN = 0.5  # of the greatest radius of a circle inside a piece
MIN_GAIN = 0.4  # of the distances, by a motion of its own
MIN_DISTANCE_M = 0.004  # mean; less is the noise of the depth

BoolArray = NDArray[np.bool_]


def candidate_parts(
    home: View, piece: IntArray, views: Sequence[View], motions: Sequence[FloatArray]
) -> list[BoolArray]:
    """Parts ``(N,)`` of a ``piece (N,)`` of the image ``home`` that may move against the rest: those that the
    ``motions`` of the whole into each of ``views`` leave off the surfaces there, and those of these that are thin.
    """
    distances = surface_distances(home.points[piece], views, motions)
    parts = [*_connected(home, piece, _thin(home, piece)), *_connected(home, piece, distances > UNEXPLAINED_M)[:1]]
    return [part for part in parts if part.sum() <= len(piece) / 2 and distances[part].mean() > MIN_DISTANCE_M]


def _thin(home: View, piece: IntArray) -> BoolArray:
    """Which points of a ``piece (N,)`` are not within its thick core, as the image shows it."""
    place = np.flatnonzero(home.labels >= 0)[piece]
    mask = np.zeros(home.labels.shape, dtype=bool)
    mask.flat[place] = True
    depth = distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]
    radius = THIN * depth.max()
    return distance_transform_edt(depth <= radius).flat[place] > radius + 1


def _connected(home: View, piece: IntArray, which: BoolArray) -> list[BoolArray]:
    """The connected parts ``(N,)`` of those points of a ``piece (N,)``, the largest first, that are large enough."""
    chosen = np.flatnonzero(which)
    number = connected_pieces(home.points[piece[chosen]], GAP_M)
    parts = []
    for members in sorted((chosen[number == n] for n in np.unique(number)), key=len, reverse=True):
        if len(members) >= home.least:
            parts.append(np.isin(np.arange(len(piece)), members))
    return parts


def gain(
    points: FloatArray, views: Sequence[View], whole: Sequence[FloatArray], own: Sequence[FloatArray]
) -> tuple[float, float]:
    """By how much the distances of a part's ``points (N, 3)`` from the surfaces in ``views`` become smaller with its
    ``own`` motions than with those of the ``whole``: as a share, and in all, metres.
    """
    before, after = (surface_distances(points, views, motions) for motions in (whole, own))
    return 1 - float(after.mean() / before.mean()), float((before - after).sum())


def surface_distances(points: FloatArray, views: Sequence[View], poses: Sequence[FloatArray]) -> FloatArray:
    """`PERCENTILE` over ``views`` of the distances ``(N,)`` of moved ``points (N, 3)`` from the surfaces there, metres.

    Smoothed over neighbours; views that do not show a point do not count.
    """
    distances = np.empty((len(views), len(points)))
    for row, (view, pose) in enumerate(zip(views, poses, strict=True)):
        moved = transform_points(pose, points)
        distances[row] = np.minimum(cKDTree(view.points).query(moved)[0], GREATEST_M)
        camera = view.observation
        pixels = np.rint(project(moved, camera.intrinsics, camera.camera_pose))
        height, width = view.depth.shape
        seen = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
        distances[row, ~seen | view.hides(moved)] = np.nan
    # As np.nanpercentile, which is slow: those that are not known come last.
    last = np.isfinite(distances).sum(axis=0) - 1
    place = np.maximum(last, 0) * PERCENTILE / 100
    ordered = np.sort(distances, axis=0)
    below, above = (ordered[number.astype(np.intp), np.arange(len(points))] for number in (place, np.ceil(place)))
    typical = np.where(last < 0, 0, below + (above - below) * (place % 1))
    near = cKDTree(points).query(points, min(SMOOTHING_POINTS, len(points)))[1]
    return typical[near].mean(axis=1)
