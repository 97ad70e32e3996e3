"""The coloured points of one RGB-D image that stand out from the table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label, maximum_filter, uniform_filter

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import KeypointError
from robust_instant_policy.geometry import FloatArray, lift
from robust_instant_policy.perception.descriptors import DescriptorMap, Float32Array, IntArray
from robust_instant_policy.perception.table import TableColour
from robust_instant_policy.pointcloud import in_metres, steady, table_plane

MAX_EDGE_PX = 256  # clouds of larger images are thinned out: enough for millimetres, and quick
MIN_STEADY = 100  # pixels with a trustworthy depth
LIFTED_M = 0.010  # above the table from which a point belongs to an object,
LIFTED_DEVIATIONS = 4.0  # or this many deviations of the depth's noise, if that is more
STRANGE = 4.0  # deviations from the table's colour that the surroundings of a flat point need
STRANGE_ITSELF = 2.5  # and the point itself, so that objects have no halo
SMOOTH_PX = 5  # size of those surroundings; evens out the grain of the table
COLOUR_SAMPLES = 1000
PIECE_GAP_M = 0.02  # foreground points further apart in the image belong to different objects
MIN_PIECE = 15  # points; less is noise


@dataclass(frozen=True, eq=False)
class Cloud:
    """Foreground points of an image: ``points (N, 3)`` metres, world; ``colours (N, 3)`` in [0, 1];
    ``pixels (N, 2)`` (u, v); ``cells (N,)`` of the descriptor map they lie in; ``pieces (N,)`` numbers the
    connected pieces they form in the image. ``depth (H, W)`` is the whole image's, in metres.
    """

    points: FloatArray
    colours: Float32Array
    pixels: IntArray
    cells: IntArray
    pieces: IntArray
    depth: Float32Array


def foreground(
    observation: Observation, descriptors: DescriptorMap, salient: float, workspace: FloatArray | None, seed: int
) -> tuple[Cloud, str]:
    """The points that stand out, and a line about the depth's unit if it was unusual.

    A point stands out by its height above the table, or, lying flat, by the network's saliency and a colour that
    the table does not have. Raises `KeypointError` for depth images without enough readings in the ``workspace``.
    """
    depth, note = in_metres(observation.depth)
    if not np.isfinite(depth).any():
        raise KeypointError("the depth image has no reading at all; check the camera's depth stream")
    every = -(-max(depth.shape) // MAX_EDGE_PX)
    rows, cols = np.nonzero(steady(depth)[::every, ::every])
    if len(rows) < MIN_STEADY:
        raise KeypointError(f"only {len(rows)} pixels have a steady depth; check the camera's depth stream")
    shape = -(-depth.shape[0] // every), -(-depth.shape[1] // every)
    pixels = np.stack([cols, rows], axis=1) * every
    points = lift(pixels, depth[pixels[:, 1], pixels[:, 0]], observation.intrinsics, observation.camera_pose)
    if workspace is not None:
        beside = ((points >= workspace[0]) & (points <= workspace[1]))[:, :2].all(axis=1)
        if beside.sum() < MIN_STEADY:
            raise KeypointError(
                f"only {beside.sum()} points of the image lie in the workspace; check it and the camera's pose"
            )
        points, pixels = points[beside], pixels[beside]

    plane = table_plane(points, seed)
    above = points @ plane[:3] + plane[3]
    noise = 1.4826 * np.median(np.abs(above[np.abs(above) < LIFTED_M])) if (np.abs(above) < LIFTED_M).any() else 0.0
    lifted = above > max(LIFTED_M, LIFTED_DEVIATIONS * noise)
    cells = descriptors.cells_at(pixels)
    flat = pixels[~lifted] if not lifted.all() else pixels
    table = TableColour(_colours(observation.rgb, flat[:: max(1, len(flat) // COLOUR_SAMPLES)]))
    candidates = np.flatnonzero(~lifted & (descriptors.saliency.reshape(-1)[cells] > salient))
    smooth = _colours(uniform_filter(observation.rgb, size=(SMOOTH_PX, SMOOTH_PX, 1)), pixels[candidates])
    strange = (table.strangeness(smooth) > STRANGE) & (
        table.strangeness(_colours(observation.rgb, pixels[candidates])) > STRANGE_ITSELF
    )
    chosen = lifted
    chosen[candidates[strange]] = True
    if workspace is not None:
        chosen &= points[:, 2] <= workspace[1][2]

    kept = np.flatnonzero(chosen)
    place = pixels[kept, 1] // every, pixels[kept, 0] // every
    mask = np.zeros(shape, dtype=bool)
    mask[place] = True
    gap = PIECE_GAP_M * observation.intrinsics[0, 0] / np.nanmedian(depth) / every
    pieces = label(maximum_filter(mask, size=max(1, round(gap))), structure=np.ones((3, 3)))[0][place]
    large = np.bincount(pieces, minlength=1)[pieces] >= MIN_PIECE
    kept, pieces = kept[large], pieces[large]
    colours = _colours(observation.rgb, pixels[kept])
    return Cloud(points[kept], colours, pixels[kept], cells[kept], pieces, depth), note


def _colours(rgb: NDArray[np.uint8], pixels: IntArray) -> Float32Array:
    """Colours ``(N, 3)`` in [0, 1] at ``pixels (N, 2)``."""
    return np.divide(rgb[pixels[:, 1], pixels[:, 0]], 255, dtype=np.float32)
