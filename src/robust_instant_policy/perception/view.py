"""One image, prepared for registration: descriptors, foreground, and where both lie in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import KeypointError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.perception.descriptors import (
    NEIGHBOURS,
    DescriptorMap,
    DescriptorNetwork,
    Float32Array,
    IntArray,
)
from robust_instant_policy.perception.foreground import Foreground, segment_foreground

MAX_SEGMENT_POINTS = 500  # of a segment, in `View.target`
MAX_CENTRE_OFFSET = 0.4  # of the principal point from the image centre, of half the image


@dataclass(frozen=True, eq=False)
class View:
    """An ``observation`` with its ``descriptors`` and ``foreground``.

    ``target (N, 6)`` are the XYZRGB points that objects are registered to. ``cells (C,)`` of the descriptor map: those
    with foreground, whose mean points are ``cell_points (F, 3)`` in metres, world, and then their neighbours.
    """

    observation: Observation
    descriptors: DescriptorMap
    foreground: Foreground
    target: Float32Array
    cells: IntArray
    cell_points: FloatArray


def make_view(
    observation: Observation, network: DescriptorNetwork, workspace: FloatArray | None = None, seed: int = 0
) -> View:
    """Describe and segment an image. For ``workspace`` and ``seed`` see `KeypointExtractor`.

    Raises `KeypointError` for intrinsics of another resolution, and where depth or foreground are missing.
    """
    height, width = observation.depth.shape
    cx, cy = observation.intrinsics[:2, 2]
    if not (abs(cx / (width / 2) - 1) < MAX_CENTRE_OFFSET and abs(cy / (height / 2) - 1) < MAX_CENTRE_OFFSET):
        raise KeypointError(
            f"the intrinsics belong to an image of about {2 * cx:.0f}x{2 * cy:.0f} pixels, but this one has "
            f"{width}x{height}; scale them to it"
        )
    descriptors = network.describe(observation.rgb)
    foreground = segment_foreground(observation, descriptors, network.salient, workspace, seed)
    cells, inverse, counts = np.unique(foreground.cells, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(inverse, foreground.points[:, axis]) for axis in range(3)], axis=1)
    kept = np.concatenate([subsample(segment, MAX_SEGMENT_POINTS, seed) for segment in foreground.segments])
    neighbours = np.setdiff1d([descriptors.shifted(cells, row, col) for row, col in NEIGHBOURS], cells)
    with_neighbours, cell_points = np.concatenate([cells, neighbours]), sums / counts[:, None]
    return View(observation, descriptors, foreground, foreground.xyzrgb[kept], with_neighbours, cell_points)


def subsample(indices: IntArray, count: int, seed: int) -> IntArray:
    """At most ``count`` of ``indices``, drawn uniformly, in order."""
    if len(indices) <= count:
        return indices
    return np.sort(np.random.default_rng(seed).choice(indices, count, replace=False))
