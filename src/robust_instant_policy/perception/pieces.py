"""Foreground points that belong together: connected pieces, and what is no thing on the table."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.perception.descriptors import IntArray

GAP_M = 0.015  # foreground points further apart in space belong to different pieces,
GAP_PX = 3  # but those of pixels this near do not,
HIDDEN_GAP_M = 0.020  # nor those of such pixels this near in a horizontal direction: sides may be hidden from above
STRIP_M = 0.035  # that an arm or a rod above the table may hide between two pieces of one thing
SAME_COLOUR = 0.2  # greatest difference of the mean colours of such pieces, of a range of 1
MIN_TOLD_SHARE = 1 / 3  # of the size of an object: smaller pieces are noise
MAX_TOLD = 3  # of them that a note names
BORDER_SHARE = 0.01  # of the image's width and height, at its border
HOVERING_M = 0.06  # above the table where it crosses the image's border: an arm or a person

TABLE, BELOW, BESIDE, HIGH, BORDER, SMALL, OUTSIDE, UNKNOWN, UNRELATED, HAND = range(-1, -11, -1)
REASONS = {
    TABLE: "table",
    BELOW: "below the table",
    BESIDE: "beside the table",
    HIGH: "too high for a thing on the table",
    BORDER: "reaches in over the image's border, as an arm does",
    SMALL: "too small",
    OUTSIDE: "outside the workspace",
    UNKNOWN: "no steady depth",
    UNRELATED: "no object that all demonstrations show",
    HAND: "the gripper where the demonstrations start",
}
CUT_OFF_NOTE = (
    "all that stands on the table reaches over the image's border: it is taken for the task's object, not for an arm; "
    "show the whole of it, and park the arm outside the image"
)


def connected_pieces(points: FloatArray, gap: float) -> IntArray:
    """Number ``(N,)`` of the piece of each of ``points (N, 3)``: chains of points less than ``gap`` apart."""
    if not len(points):
        return np.zeros(0, dtype=np.intp)
    _, voxel, counts = np.unique(cubes(points, gap / 3), return_inverse=True, return_counts=True)
    centres = np.stack([np.bincount(voxel, axis) for axis in points.T], axis=1) / counts[:, None]
    return _components(cKDTree(centres).query_pairs(gap, output_type="ndarray"), len(centres))[voxel]


def join_hidden(label: IntArray, points: FloatArray, usable: NDArray[np.bool_]) -> None:
    """Join the pieces in ``label (N,)`` whose pixels meet and that are near in a horizontal direction.

    ``points (N, 3)`` are those of the ``usable (h, w)`` pixels.
    """
    grid = np.full(usable.shape, -1)
    grid[usable] = np.arange(len(points))
    joined: list[IntArray] = []
    for step in range(1, GAP_PX + 1):
        for a, b in (
            (grid[:, step:], grid[:, :-step]),
            (grid[step:], grid[:-step]),
            (grid[step:, step:], grid[:-step, :-step]),
            (grid[step:, :-step], grid[:-step, step:]),
        ):
            known = (a >= 0) & (b >= 0)
            one, other = a[known], b[known]
            apart = (label[one] != label[other]) & (label[one] >= 0) & (label[other] >= 0)
            one, other = one[apart], other[apart]
            near = np.linalg.norm((points[one] - points[other])[:, :2], axis=1) < HIDDEN_GAP_M
            joined.append(np.stack([label[one[near]], label[other[near]]], axis=1))
    _join(label, np.concatenate(joined))


def leave_out_arms(label: IntArray, heights: FloatArray, pixels: IntArray, least: int) -> str:
    """Mark in ``label (N,)`` the pieces that reach in over the border; returns a note where one is kept.

    A thing that the border cuts off looks like an arm. It is kept where there is nothing else, of ``least`` points or
    more, and it comes down to the table.
    """
    first, last = pixels.min(axis=0), pixels.max(axis=0)
    margin = np.maximum((last - first) * BORDER_SHARE, 1)
    crossing = ((pixels < first + margin) | (pixels > last - margin)).any(axis=1) & (label >= 0)
    over = [piece for piece in np.unique(label[crossing]) if heights[crossing & (label == piece)].min() > HOVERING_M]
    others = np.bincount(label[(label >= 0) & ~np.isin(label, over)], minlength=1)
    standing = [piece for piece in over if heights[label == piece].min() < HOVERING_M]
    alone = bool(standing) and others.max() < least
    label[np.isin(label, [piece for piece in over if not (alone and piece in standing)])] = BORDER
    return CUT_OFF_NOTE if alone else ""


def join_behind(
    label: IntArray, points: FloatArray, usable: NDArray[np.bool_], over: NDArray[np.bool_], colours: FloatArray
) -> None:
    """Join the pieces in ``label (N,)`` of one of ``colours (N, 3)`` that are apart only where something that is above
    the table, at the pixels ``over (h, w)``, hides what is between them.

    ``points (N, 3)`` are those of the ``usable (h, w)`` pixels.
    """
    grid = np.full(usable.shape, UNKNOWN)
    grid[usable] = label
    number = np.full(usable.shape, -1)
    number[usable] = np.arange(len(points))
    above = binary_dilation(over, iterations=GAP_PX) & (grid < 0)
    if not above.any() or not (grid >= 0).any():
        return
    nearest = number[tuple(distance_transform_edt(grid < 0, return_distances=False, return_indices=True))]
    mean = {piece: colours[label == piece].mean(axis=0) for piece in np.unique(label[label >= 0])}
    pairs = []
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        between = above[a] & above[b]
        one, other = nearest[a][between], nearest[b][between]
        near = (label[one] != label[other]) & (np.linalg.norm(points[one] - points[other], axis=1) < STRIP_M)
        pairs.append(np.stack([label[one[near]], label[other[near]]], axis=1))
    found = np.unique(np.concatenate(pairs), axis=0)
    _join(label, found[[abs(mean[a] - mean[b]).max() < SAME_COLOUR for a, b in found]])


def leave_out_small(label: IntArray, heights: FloatArray, pixels: IntArray, least: int) -> str:
    """Mark in ``label (N,)`` the pieces of fewer than ``least`` points; number the others from 0.

    Returns a line that tells where things are that are too small, or nothing.
    """
    number, small = 0, []
    for piece in np.unique(label[label >= 0]):
        members = np.flatnonzero(label == piece)
        if MIN_TOLD_SHARE * least <= len(members) < least and heights[members].min() > 0:
            small.append("({:.0f}, {:.0f})".format(*pixels[members].mean(axis=0)))
        label[members] = SMALL if len(members) < least else number
        number += len(members) >= least
    if not small:
        return ""
    return (
        f"too small for keypoints: what is at pixel {', '.join(small[:MAX_TOLD])}; take larger or nearer images of it"
    )


def cubes(points: FloatArray, edge: float) -> IntArray:
    """Number ``(N,)`` of the cube with this ``edge``, metres, in which each of ``points (N, 3)`` lies."""
    number = np.floor(points / edge).astype(np.intp)
    number -= number.min(axis=0)
    return np.ravel_multi_index(tuple(number.T), tuple(number.max(axis=0) + 1))


def _join(label: IntArray, pairs: IntArray) -> None:
    """Give the pieces in ``label (N,)`` that ``pairs (P, 2)`` connect one number."""
    label[label >= 0] = _components(pairs, label.max() + 1)[label[label >= 0]]


def _components(pairs: IntArray, count: int) -> IntArray:
    """Number ``(count,)`` of the connected component of each node, from ``pairs (P, 2)`` of nodes."""
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), pairs.T), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.intp)
