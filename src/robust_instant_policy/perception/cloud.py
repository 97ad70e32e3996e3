"""The coloured points of one RGB-D image, and which of them stand out from the table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import KeypointError
from robust_instant_policy.geometry import FloatArray, lift
from robust_instant_policy.perception.depth import in_metres
from robust_instant_policy.perception.descriptors import DescriptorMap

MAX_EDGE_PX = 256  # clouds of larger images are thinned out: enough for millimetres, and quick
FLAT_TOLERANCE = 0.015  # share of the depth by which a pixel may differ from a neighbour on the same surface
MIN_NEIGHBOURS = 3  # of four; a pixel that agrees with fewer flies
TABLE_TOLERANCE = 0.006  # metres; points this near to the plane belong to it
LIFTED = 0.010  # metres above the table from which a point belongs to an object
PLANE_SAMPLES = 60
SALIENT = 0.5  # saliency from which a flat point counts as an object
COLOURED = 0.06  # distance from the table's chromaticity that a flat point needs too, so that shadows do not count
BRIGHTER = 0.08  # or its brightness above the table's: shadows only darken
PIECE_GAP = 0.02  # metres on the table; foreground points further apart belong to different objects


@dataclass(frozen=True, eq=False)
class Cloud:
    """Foreground points of an image: ``points (N, 3)`` metres, world; ``colours (N, 3)`` in [0, 1];
    ``pixels (N, 2)`` (u, v); ``cells (N,)`` of the descriptor map they lie in.
    """

    points: FloatArray
    colours: FloatArray
    pixels: FloatArray
    cells: NDArray[np.intp]


def chromaticity(colours: FloatArray) -> FloatArray:
    """Colour without brightness ``(..., 3)``: the shares of red, green and blue."""
    return (colours + 0.02) / (colours + 0.02).sum(axis=-1, keepdims=True)


def table_plane(points: FloatArray, seed: int) -> FloatArray:
    """Plane ``(4,)`` (normal up, offset) that holds most of ``points (N, 3)``, nearly horizontal."""
    rng = np.random.default_rng(seed)
    subset = points[rng.choice(len(points), min(len(points), 2000), replace=False)]
    best, best_count = np.array([0.0, 0.0, 1.0, -np.median(points[:, 2])]), -1
    for _ in range(PLANE_SAMPLES):
        a, b, c = subset[rng.choice(len(subset), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-9 or abs(normal[2]) < 0.9 * length:
            continue
        normal = normal / length * np.sign(normal[2])
        count = int((np.abs((subset - a) @ normal) < TABLE_TOLERANCE).sum())
        if count > best_count:
            best, best_count = np.append(normal, -normal @ a), count
    near = subset[np.abs(subset @ best[:3] + best[3]) < TABLE_TOLERANCE]
    if len(near) >= 3:
        centre = near.mean(axis=0)
        normal = np.linalg.svd(near - centre, full_matrices=False)[2][2]
        normal = normal * np.sign(normal[2])
        best = np.append(normal, -normal @ centre)
    return best


def foreground(
    observation: Observation, descriptors: DescriptorMap, workspace: FloatArray | None, seed: int
) -> tuple[Cloud, str]:
    """The points that stand out by height above the table or by saliency, and a line about the depth's unit."""
    depth, note = in_metres(observation.depth)
    if not np.isfinite(depth).any():
        raise KeypointError("the depth image has no reading at all; check the camera's depth stream")
    height, width = depth.shape
    every = max(1, int(np.ceil(max(height, width) / MAX_EDGE_PX)))
    steady = np.zeros(depth.shape, dtype=np.uint8)
    for axis in (0, 1):
        near = np.abs(np.diff(depth, axis=axis)) < FLAT_TOLERANCE * np.take(
            depth, range(depth.shape[axis] - 1), axis=axis
        )
        first: list[slice] = [slice(None), slice(None)]
        second = list(first)
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        steady[tuple(first)] += near
        steady[tuple(second)] += near
    rows, cols = np.nonzero(np.isfinite(depth[::every, ::every]) & (steady[::every, ::every] >= MIN_NEIGHBOURS))
    if len(rows) < 10:
        raise KeypointError("fewer than 10 pixels have a steady depth; check the camera's depth stream")
    pixels = np.stack([cols, rows], axis=1) * float(every)
    index = pixels.astype(np.intp)
    points = lift(pixels, depth[index[:, 1], index[:, 0]], observation.intrinsics, observation.camera_pose)
    if workspace is not None:
        kept = ((points >= workspace[0]) & (points <= workspace[1])).all(axis=1)
        if not kept.any():
            raise KeypointError("no point of the image lies in the workspace; check camera pose and workspace")
        points, pixels, index = points[kept], pixels[kept], index[kept]
    colours = observation.rgb[index[:, 1], index[:, 0]] / 255.0
    plane = table_plane(points, seed)
    above = points @ plane[:3] + plane[3]
    flat = np.abs(above) < LIFTED
    cells = descriptors.cells_at(pixels)
    table = np.median(colours[flat], axis=0) if flat.any() else np.median(colours, axis=0)
    coloured = np.linalg.norm(chromaticity(colours) - chromaticity(table), axis=1) > COLOURED
    brighter = colours.mean(axis=1) > table.mean() + BRIGHTER
    stands_out = (descriptors.saliency.reshape(-1)[cells] > SALIENT) & (coloured | brighter)
    chosen = (above > LIFTED) | (flat & stands_out)
    return Cloud(points[chosen], colours[chosen], pixels[chosen], cells[chosen]), note


def pieces(points: FloatArray) -> NDArray[np.intp]:
    """Number of the object each of ``points (N, 3)`` belongs to; seen from above, gaps part objects."""
    pairs = cKDTree(points[:, :2]).query_pairs(PIECE_GAP, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    return connected_components(graph, directed=False)[1].astype(np.intp)
