"""One image, prepared for registration: its descriptors, and the XYZRGB points that do not belong to the table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label, maximum_filter, uniform_filter

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import KeypointError
from robust_instant_policy.geometry import FloatArray, lift
from robust_instant_policy.perception.descriptors import (
    NEIGHBOURS,
    DescriptorMap,
    DescriptorNetwork,
    Float32Array,
    IntArray,
)
from robust_instant_policy.pointcloud import in_metres, steady, table_plane

MAX_CENTRE_OFFSET = 0.4  # of the principal point from the image centre, of half the image
MAX_EDGE_PX = 256  # larger images are subsampled: enough for millimetres, and fast
UNBOUNDED = np.array([[-np.inf] * 3, [np.inf] * 3])  # metres
MIN_STEADY_PIXELS = 100
MIN_FOREGROUND_POINTS = 25
MIN_HEIGHT_M = 0.010  # above the table, for points of objects,
MIN_HEIGHT_DEVIATIONS = 4.0  # or this many standard deviations of the depth noise, if that is more
MAD_TO_DEVIATION = 1.4826  # standard deviation of a Gaussian with median absolute deviation 1
MIN_DISTANCE_SMOOTHED = 4.0  # Mahalanobis distance of a flat point's smoothed colour from the table's,
MIN_DISTANCE_POINT = 2.5  # and of its own colour, so that smoothing adds no border to objects
SMOOTHING_PX = 5  # evens out the grain of the table
COLOUR_SAMPLES = 1000
TRIM_ROUNDS = 4
TRIM_DEVIATIONS = 3.0
COLOUR_NOISE = 0.02  # standard deviation of the camera's noise in a colour channel, of a range of 1
SEGMENT_GAP_M = 0.02  # foreground points further apart in the image belong to different segments
MIN_SEGMENT_POINTS = 15
MAX_SEGMENT_POINTS = 500  # of a segment, in `View.target`
COLOUR_SCALE_M = 0.06  # metres in an XYZRGB point for the difference between black and white in one channel


@dataclass(frozen=True, eq=False)
class View:
    """An ``observation``, its ``descriptors``, its ``depth (H, W)`` in metres, and its foreground.

    Foreground: ``points (N, 3)`` in metres, world; the same as ``xyzrgb (N, 6)`` in metres, colours in units of
    `COLOUR_SCALE_M`; ``segments``, the points' numbers by connected component; ``target (M, 6)``, a sample of
    ``xyzrgb`` to which objects are registered; ``cells (C,)`` of the descriptor map: first those with foreground,
    whose mean points are ``cell_points (F, 3)``, then their neighbours. ``note`` tells if the depth was in another
    unit, or is empty.
    """

    observation: Observation
    descriptors: DescriptorMap
    depth: Float32Array
    points: FloatArray
    xyzrgb: Float32Array
    segments: tuple[IntArray, ...]
    target: Float32Array
    cells: IntArray
    cell_points: FloatArray
    note: str


def make_view(
    observation: Observation, network: DescriptorNetwork, workspace: FloatArray | None = None, seed: int = 0
) -> View:
    """Describe and segment an image.

    A point is foreground by its height above the table, or, when flat, by the network's saliency and a colour that
    differs from the table's. Points outside ``workspace (2, 3)``, metres, world, are not foreground; its lower z is
    ignored. Raises `KeypointError` for intrinsics of another resolution, and for too few depth readings or foreground
    points.
    """
    height, width = observation.depth.shape
    cx, cy = observation.intrinsics[:2, 2]
    if not (abs(cx / (width / 2) - 1) < MAX_CENTRE_OFFSET and abs(cy / (height / 2) - 1) < MAX_CENTRE_OFFSET):
        raise KeypointError(
            f"the intrinsics belong to an image of about {2 * cx:.0f}x{2 * cy:.0f} pixels, but this one has "
            f"{width}x{height}; scale them to it"
        )
    depth, note = in_metres(observation.depth)
    if not np.isfinite(depth).any():
        raise KeypointError("the depth image has no reading at all; check the camera's depth stream")
    stride = -(-max(depth.shape) // MAX_EDGE_PX)
    usable = steady(depth)[::stride, ::stride]
    pixels = np.argwhere(usable)[:, ::-1] * stride
    if len(pixels) < MIN_STEADY_PIXELS:
        raise KeypointError(f"only {len(pixels)} pixels have a steady depth; check the camera's depth stream")
    points = lift(pixels, depth[pixels[:, 1], pixels[:, 0]], observation.intrinsics, observation.camera_pose)
    lower, upper = UNBOUNDED if workspace is None else workspace
    inside = ((points >= lower) & (points <= upper))[:, :2].all(axis=1)
    if inside.sum() < MIN_STEADY_PIXELS:
        raise KeypointError(
            f"only {inside.sum()} points of the image lie in the workspace; check it and the camera's pose"
        )
    points, pixels = points[inside], pixels[inside]
    descriptors = network.describe(observation.rgb)
    cells = descriptors.cells_at(pixels)
    at = pixels[:, 1], pixels[:, 0]
    colours = np.divide(observation.rgb[at], 255, dtype=np.float32)
    smoothed = np.divide(uniform_filter(observation.rgb, (SMOOTHING_PX, SMOOTHING_PX, 1))[at], 255, dtype=np.float32)
    raised = _raised(points, seed)
    table = TableColour.fit(colours if raised.all() else colours[~raised])
    unlike_table = (table.distance(smoothed) > MIN_DISTANCE_SMOOTHED) & (table.distance(colours) > MIN_DISTANCE_POINT)
    flat_object = unlike_table & (descriptors.saliency.flat[cells] > network.salient)
    kept = np.flatnonzero((raised | flat_object) & (points[:, 2] <= upper[2]))
    place = tuple(pixels[kept, ::-1].T // stride)
    mask = np.zeros_like(usable)
    mask[place] = True
    gap = SEGMENT_GAP_M * observation.intrinsics[0, 0] / np.nanmedian(depth) / stride
    labels = label(maximum_filter(mask, size=max(1, round(gap))), structure=np.ones((3, 3)))[0][place]
    large = np.bincount(labels, minlength=1)[labels] >= MIN_SEGMENT_POINTS
    kept, labels = kept[large], labels[large]
    if len(kept) < MIN_FOREGROUND_POINTS:
        raise KeypointError("nothing stands out from the table in an image; is the object in the workspace?")
    points, cells = points[kept], cells[kept]
    xyzrgb = np.concatenate([points, colours[kept] * COLOUR_SCALE_M], axis=1).astype(np.float32)
    segments = tuple(np.flatnonzero(labels == segment) for segment in np.unique(labels))
    target = xyzrgb[np.concatenate([subsample(segment, MAX_SEGMENT_POINTS, seed) for segment in segments])]
    cells, inverse, counts = np.unique(cells, return_inverse=True, return_counts=True)
    cell_points = np.stack([np.bincount(inverse, axis) for axis in points.T], axis=1) / counts[:, None]
    neighbours = np.setdiff1d([descriptors.shifted(cells, row, col) for row, col in NEIGHBOURS], cells)
    cells = np.concatenate([cells, neighbours])
    return View(observation, descriptors, depth, points, xyzrgb, segments, target, cells, cell_points, note)


def subsample(indices: IntArray, count: int, seed: int) -> IntArray:
    """At most ``count`` of ``indices``, drawn uniformly, in order."""
    if len(indices) <= count:
        return indices
    return np.sort(np.random.default_rng(seed).choice(indices, count, replace=False))


def _raised(points: FloatArray, seed: int) -> NDArray[np.bool_]:
    """Which of ``points (N, 3)`` are higher above the table's plane than its noise."""
    plane = table_plane(points, seed)
    height = points @ plane[:3] + plane[3]
    of_table = np.abs(height)[np.abs(height) < MIN_HEIGHT_M]
    noise = MAD_TO_DEVIATION * np.median(of_table) if len(of_table) else 0.0
    return height > max(MIN_HEIGHT_M, MIN_HEIGHT_DEVIATIONS * noise)


@dataclass(frozen=True, eq=False)
class TableColour:
    """Gaussian of the table's colours in [0, 1]: ``mean (3,)``; ``whitening (3, 3)`` maps to unit covariance."""

    mean: Float32Array
    whitening: Float32Array

    @classmethod
    def fit(cls, colours: Float32Array) -> TableColour:
        """Fitted to ``colours (N, 3)``, outliers trimmed."""
        colours = colours[:: max(1, len(colours) // COLOUR_SAMPLES)]
        for _ in range(TRIM_ROUNDS):
            covariance = np.cov(colours.T) + COLOUR_NOISE**2 * np.eye(3)
            whitening = np.linalg.inv(np.linalg.cholesky(covariance)).T.astype(np.float32)
            table = cls(np.median(colours, axis=0), whitening)
            colours = colours[table._mahalanobis(colours) < TRIM_DEVIATIONS]
        return table

    def distance(self, colours: Float32Array) -> Float32Array:
        """Mahalanobis distances ``(N,)`` of ``colours (N, 3)``, each first scaled up to the table's brightness.

        A shadow has the table's colour, darker.
        """
        brightness = np.maximum(colours.mean(axis=1), COLOUR_NOISE)
        return self._mahalanobis(colours * np.maximum(self.mean.mean() / brightness, 1)[:, None])

    def _mahalanobis(self, colours: Float32Array) -> Float32Array:
        return np.sqrt((((colours - self.mean) @ self.whitening) ** 2).sum(axis=1))
