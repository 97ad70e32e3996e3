"""The coloured points of one RGB-D image, and which of them stand out from the table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label, maximum_filter, uniform_filter

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
STRANGE = 4.0  # deviations from the table's colour that the surroundings of a flat point need too
STRANGE_ITSELF = 2.5  # and the point itself, so that objects have no halo
INLIER_DEVIATIONS = 3.0
GAUSSIAN_ROUNDS = 4
COLOUR_NOISE = 0.02  # of a channel's range; less is the camera's noise
SMOOTH_PX = 5  # evens out the grain of the table
MIN_FLAT = 100
PIECE_GAP_M = 0.02  # foreground points further apart in the image belong to different objects


@dataclass(frozen=True, eq=False)
class Cloud:
    """Foreground points of an image: ``points (N, 3)`` metres, world; ``colours (N, 3)`` in [0, 1];
    ``pixels (N, 2)`` (u, v); ``cells (N,)`` of the descriptor map they lie in; ``pieces (N,)`` numbers the
    connected pieces they form in the image.
    """

    points: FloatArray
    colours: FloatArray
    pixels: FloatArray
    cells: NDArray[np.intp]
    pieces: NDArray[np.intp]


def strangeness(colours: FloatArray) -> FloatArray:
    """How many deviations ``(N,)`` each of ``colours (N, 3)`` lies from the commonest colour, shadows aside.

    The commonest colour is a Gaussian fitted to what remains after dropping outliers; a darker point is first
    brightened to its mean, since a shadow is the same colour, darker.
    """
    kept = colours
    for _ in range(GAUSSIAN_ROUNDS):
        mean = np.median(kept, axis=0)
        whiten = np.linalg.inv(np.linalg.cholesky(np.cov(kept.T) + COLOUR_NOISE**2 * np.eye(3)))
        kept = kept[(((kept - mean) @ whiten.T) ** 2).sum(axis=1) < INLIER_DEVIATIONS**2]
    lit = colours * np.maximum(mean.mean() / np.maximum(colours.mean(axis=1), COLOUR_NOISE), 1)[:, None]
    return np.sqrt((((lit - mean) @ whiten.T) ** 2).sum(axis=1))


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
    observation: Observation, descriptors: DescriptorMap, salient: float, workspace: FloatArray | None, seed: int
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
    if len(rows) < MIN_FLAT:
        raise KeypointError(f"fewer than {MIN_FLAT} pixels have a steady depth; check the camera's depth stream")
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
    smooth = uniform_filter(observation.rgb / np.float32(255), size=(SMOOTH_PX, SMOOTH_PX, 1))
    strange = np.zeros(len(points), dtype=bool)
    if flat.sum() > MIN_FLAT:
        evened = strangeness(smooth[index[flat, 1], index[flat, 0]])
        strange[flat] = (evened > STRANGE) & (strangeness(colours[flat]) > STRANGE_ITSELF)
    stands_out = strange & (descriptors.saliency.reshape(-1)[cells] > salient)
    chosen = (above > LIFTED) | (flat & stands_out)
    mask = np.zeros(depth[::every, ::every].shape, dtype=bool)
    place = index[chosen, 1] // every, index[chosen, 0] // every
    mask[place] = True
    gap = PIECE_GAP_M * observation.intrinsics[0, 0] / np.median(depth[index[chosen, 1], index[chosen, 0]]) / every
    piece = label(maximum_filter(mask, size=max(1, round(gap))))[0][place] - 1
    return Cloud(points[chosen], colours[chosen], pixels[chosen], cells[chosen], piece), note
