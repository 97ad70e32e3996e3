"""One image, prepared for registration: its descriptors, and the XYZRGB points that stand on the table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import binary_dilation, binary_fill_holes, distance_transform_edt, uniform_filter

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import KeypointError
from robust_instant_policy.geometry import FloatArray, invert_pose, lift, project
from robust_instant_policy.perception.descriptors import (
    NEIGHBOURS,
    DescriptorMap,
    DescriptorNetwork,
    Float32Array,
    IntArray,
)
from robust_instant_policy.perception.pieces import (
    BELOW,
    BESIDE,
    BORDER,
    GAP_M,
    GAP_PX,
    HAND,
    HIGH,
    HOVERING_M,
    OUTSIDE,
    TABLE,
    UNKNOWN,
    connected_pieces,
    cubes,
    join_behind,
    join_hidden,
    leave_out_arms,
    leave_out_small,
)
from robust_instant_policy.perception.table import Table, TableColour, levelling
from robust_instant_policy.pointcloud import in_metres, steady
from robust_instant_policy.trajectory import ACTION_DIM, Trajectory

MAX_CENTRE_OFFSET = 0.4  # of the principal point from the image centre, of half the image
SPACING_M = 0.003  # between points, where the image has as many: enough for millimetres, and fast
UNBOUNDED = np.array([[-np.inf] * 3, [np.inf] * 3])  # metres
MIN_STEADY_PIXELS = 100  # with depth, of an image
MIN_OBJECT_M2 = 1.5e-4  # of the image of an object
MIN_OBJECT_POINTS = 12  # fewer have no shape
MIN_DISTANCE_SMOOTHED = 4.0  # Mahalanobis distance of a flat point's smoothed colour from the table's,
MIN_DISTANCE_POINT = 2.5  # and of its own colour, so that smoothing adds no border to objects
SMOOTHING_PX = 5  # evens out the grain of the table
HIDDEN_M = 0.02  # behind the surface that the image shows there
SQUARE_M = 0.004  # edge of the squares of `Ground`,
SQUARE_SPACINGS = 1.2  # or of this many distances between points, if that is more
FILLED_PX = 8  # from things: greatest distance of pixels without a steady depth that belong to them
FILLED_SMOOTHING_PX = 3
TARGET_M = 0.005  # edge of the cubes with one point each in `View.target`
COLOUR_SCALE_M = 0.06  # metres in an XYZRGB point for the difference between black and white in one channel
MIN_TILT_RAD = np.deg2rad(1.0)  # of the table in the world; less is the noise of its plane
TALLEST_M = 0.8  # of what stands on a table
DEEPEST_M = 0.3  # of a hole in a table: what is lower is the floor under it

HAND_SHARE = 0.5  # of the distance from the gripper point to the fingertips: what is nearer to it is the hand
TOLD_BORDER_SHARE = 0.01  # of the image, that something at its border covers

FREE, OCCUPIED = 1, 2


@dataclass(frozen=True, eq=False)
class Ground:
    """What an image shows of the horizontal plane: ``states (X, Y)`` of squares, 0 where it shows nothing, `FREE` where
    the table, `OCCUPIED` where something stands; ``corner (2,)`` of the first square and ``edge``, metres.
    """

    states: NDArray[np.int8]
    corner: FloatArray
    edge: float

    @classmethod
    def of(cls, occupied: FloatArray, free: FloatArray, edge: float) -> Ground:
        """From places ``(N, 2)`` where something stands, and ``(M, 2)`` where the table is seen, metres."""
        every = np.concatenate([free, occupied])
        corner = every.min(axis=0) - edge  # the squares at the border stay empty: `at` clips to them
        x, y = ((every - corner) / edge).astype(np.intp).T
        states = np.zeros((x.max() + 2, y.max() + 2), dtype=np.int8)
        states[x[: len(free)], y[: len(free)]] = FREE
        states[x[len(free) :], y[len(free) :]] = OCCUPIED  # a thing also where the table is seen through it
        return cls(states, corner, edge)

    def at(self, places: FloatArray) -> NDArray[np.int8]:
        """States ``(...)`` at ``places (..., 2)``, metres."""
        number = np.floor((places - self.corner) / self.edge).astype(np.intp)
        x, y = (number[..., axis].clip(0, size - 1) for axis, size in enumerate(self.states.shape))
        return self.states[x, y]


@dataclass(frozen=True, eq=False)
class View:
    """An ``observation``, its ``descriptors``, its ``depth (H, W)`` in metres, and its foreground.

    The world of a view is level: ``to_world (4, 4)`` maps it to the world of the given camera pose, from which it
    differs where that is tilted. Foreground: ``points (N, 3)`` in metres; the same as ``xyzrgb (N, 6)``, colours in
    units of `COLOUR_SCALE_M`; ``pieces``, the points' numbers by connected piece; ``target (M, 6)``, a sample of
    ``xyzrgb`` to which objects are registered; ``cells (C,)`` of the descriptor map: first those with foreground,
    whose mean points are ``cell_points (F, 3)``, then their neighbours. ``labels (h, w)``, subsampled by ``stride``: a
    pixel's piece, or the key in `REASONS` of what it is instead. ``ground``: where something stands.
    ``least``: points of the smallest object.
    ``notes`` tell what was unusual.
    """

    observation: Observation
    descriptors: DescriptorMap
    depth: Float32Array
    to_world: FloatArray
    points: FloatArray
    xyzrgb: Float32Array
    pieces: tuple[IntArray, ...]
    target: Float32Array
    cells: IntArray
    cell_points: FloatArray
    labels: NDArray[np.int16]
    ground: Ground
    stride: int
    least: int
    notes: tuple[str, ...]

    def hides(self, points: FloatArray) -> NDArray[np.bool_]:
        """Which of ``points (..., 3)``, metres, world, lie in the image, behind a surface that it shows."""
        camera = self.observation
        pixels = np.rint(project(points, camera.intrinsics, camera.camera_pose))
        height, width = self.depth.shape
        u, v = (pixels[..., axis].clip(0, size - 1).astype(np.intp) for axis, size in enumerate((width, height)))
        inside = (pixels[..., 0] == u) & (pixels[..., 1] == v)
        axis = camera.camera_pose[:3, 2]
        return inside & ((points - camera.camera_pose[:3, 3]) @ axis - self.depth[v, u] > HIDDEN_M)

    @property
    def shows_hand(self) -> bool:
        """Whether something lies where a hand is at the start of a path."""
        return bool((self.labels == HAND).any())


@dataclass(frozen=True, eq=False)
class Hands:
    """Where grippers are in an image: their gripper ``points (A, 3)``, world, and how far they reach around these,
    ``radii (A,)``, metres.
    """

    points: FloatArray
    radii: FloatArray

    @classmethod
    def at_start(cls, trajectories: Sequence[Trajectory]) -> Hands:
        """The median over ``trajectories``, at their start."""
        first = np.median([path.actions[0] for path in trajectories], axis=0).reshape(-1, ACTION_DIM)
        length = np.linalg.norm((first[:, 3:6] + first[:, 6:9]) / 2 - first[:, :3], axis=1)
        return cls(first[:, :3], HAND_SHARE * length)

    def near(self, points: FloatArray) -> NDArray[np.bool_]:
        """Which of ``points (N, 3)`` belong to a hand."""
        return (np.linalg.norm(points[:, None] - self.points, axis=2) < self.radii).any(axis=1)


def make_view(
    observation: Observation,
    network: DescriptorNetwork,
    workspace: FloatArray | None = None,
    seed: int = 0,
    hands: Hands | None = None,
) -> View:
    """Describe and segment an image.

    A point is foreground by its height above the table, in a hole of the table, or, when flat, by the network's
    saliency and a colour that differs from the table's. What is under or beside the table, outside ``workspace (2, 3)``
    (metres, world; its lower z is ignored), or reaches in over the border is not, nor is a piece that holds a part of
    ``hands``. Raises `KeypointError` for intrinsics of another resolution, and for too few depth readings
    or foreground points.
    """
    _check_resolution(observation)
    depth, note = in_metres(observation.depth)
    if not np.isfinite(depth).any():
        raise KeypointError("the depth image has no reading at all; check the camera's depth stream")
    pixel_m = float(np.nanmedian(depth)) / observation.intrinsics[0, 0]
    stride = max(1, int(SPACING_M / pixel_m))
    least = max(MIN_OBJECT_POINTS, round(MIN_OBJECT_M2 / (stride * pixel_m) ** 2))
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
    table = Table.find(points[inside], observation.camera_pose[:3, 3], seed)
    heights = table.heights(points)
    descriptors = network.describe(observation.rgb)
    label = np.full(len(points), TABLE)
    label[_unlike_table(observation, descriptors, pixels, heights, table, network.salient)] = 0
    within_table = _within_table(np.abs(heights) <= table.least_height, usable)
    lower = heights < -table.least_height
    label[lower] = np.where(within_table & (heights > -DEEPEST_M), 0, BELOW)[lower]
    standing = np.flatnonzero((label == 0) & ~within_table)
    label[standing[table.beside(points[standing])]] = BESIDE
    label[(label == 0) & (heights > TALLEST_M)] = HIGH
    label[~inside | ((label == 0) & (points[:, 2] > upper[2]))] = OUTSIDE

    of_hand = hands.near(points) if hands is not None else np.zeros(len(points), dtype=bool)
    to_world = np.eye(4)
    if np.arccos(min(table.plane[2], 1.0)) > MIN_TILT_RAD:
        to_level = levelling(table.plane)
        points, to_world = points @ to_level[:3, :3].T, invert_pose(to_level)
        observation = replace(observation, camera_pose=to_level @ observation.camera_pose)
    foreground = np.flatnonzero(label == 0)
    label[foreground] = connected_pieces(points[foreground], max(GAP_M, GAP_PX * stride * pixel_m))
    join_hidden(label, points, usable)
    label[(label >= 0) & np.isin(label, label[of_hand])] = HAND
    cut_off = leave_out_arms(label, heights, pixels, least)
    # Above the table, be it left out for that or for being outside the workspace.
    over = np.zeros(usable.shape, dtype=bool)
    over[usable] = np.isin(label, (BORDER, HIGH, HAND)) | ((label == OUTSIDE) & (heights > HOVERING_M))
    join_behind(label, points, usable, over, observation.rgb[pixels[:, 1], pixels[:, 0]] / 255)
    small = leave_out_small(label, heights, pixels, least)

    labels = np.full(usable.shape, UNKNOWN, dtype=np.int16)
    labels[usable] = label
    free = points[label == TABLE, :2]
    kept = np.flatnonzero(label >= 0)
    if not len(kept):
        raise KeypointError(
            f"nothing stands out from the table in an image; is the object in the workspace? {small}".rstrip()
        )
    at = pixels[kept, 1], pixels[kept, 0]
    colours = np.divide(observation.rgb[at], 255, dtype=np.float32)
    points, label = points[kept], label[kept]
    xyzrgb = np.concatenate([points, colours * COLOUR_SCALE_M], axis=1).astype(np.float32)
    pieces = tuple(np.flatnonzero(label == piece) for piece in range(label.max() + 1))
    # Of equal density: near or separate things have no more weight than others.
    target = xyzrgb[spread_out(points)]
    cells, cell_points = _cell_points(descriptors.cells_at(pixels[kept]), label, points)
    neighbours = np.setdiff1d([descriptors.shifted(cells, row, col) for row, col in NEIGHBOURS], cells)
    cells = np.concatenate([cells, neighbours])
    occupied = np.concatenate([points, _filled(observation, depth, labels, over, stride)])[:, :2]
    arm = ""
    if (labels == HAND).any() or (labels == BORDER).mean() > TOLD_BORDER_SHARE:
        arm = "an arm is in the image: it is left out, and what it hides is not seen; park it outside the image"
    notes = tuple(line for line in (note, small, cut_off, arm) if line)
    return View(
        observation,
        descriptors,
        depth,
        to_world,
        points,
        xyzrgb,
        pieces,
        target,
        cells,
        cell_points,
        labels,
        Ground.of(occupied, free, max(SQUARE_M, SQUARE_SPACINGS * stride * pixel_m)),
        stride,
        least,
        notes,
    )


def _within_table(on_table: NDArray[np.bool_], usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the points ``(N,)`` of the ``usable (h, w)`` pixels lie where the image shows the table all around: what
    is lower than the table there is in a hole of it.
    """
    shown = np.zeros(usable.shape, dtype=bool)
    shown[usable] = on_table
    return binary_fill_holes(binary_dilation(shown))[usable]


def subsample(indices: IntArray, count: int, seed: int) -> IntArray:
    """At most ``count`` of ``indices``, drawn uniformly, in order."""
    if len(indices) <= count:
        return indices
    return np.sort(np.random.default_rng(seed).choice(indices, count, replace=False))


def spread_out(points: ArrayLike) -> IntArray:
    """Numbers of one of ``points (N, 3)``, metres, in each cube with edges of `TARGET_M`."""
    return np.unique(cubes(np.asarray(points), TARGET_M), return_index=True)[1]


def _filled(
    observation: Observation, depth: Float32Array, labels: NDArray[np.int16], over: NDArray[np.bool_], stride: int
) -> FloatArray:
    """Points ``(N, 3)``, metres, world, of pixels without a steady depth that are beside a thing and have not the
    table's colour, at the depth of the thing: stereo cameras see no depth on narrow parts.
    """
    things, table = labels >= 0, labels == TABLE
    if not table.any():
        return np.zeros((0, 3))
    distance, nearest = distance_transform_edt(~things, return_indices=True)
    asked = (labels == UNKNOWN) & (distance <= FILLED_PX / stride) & ~binary_dilation(over, iterations=GAP_PX)
    colours = observation.rgb[::stride, ::stride]
    smoothed = uniform_filter(observation.rgb, (FILLED_SMOOTHING_PX, FILLED_SMOOTHING_PX, 1))[::stride, ::stride]
    of_table = TableColour.fit(np.divide(colours[table], 255, dtype=np.float32))
    for seen, least in ((smoothed, MIN_DISTANCE_SMOOTHED), (colours, MIN_DISTANCE_POINT)):
        asked[asked] = of_table.distance(np.divide(seen[asked], 255, dtype=np.float32)) > least
    rows, cols = nearest[:, asked] * stride
    pixels = np.argwhere(asked)[:, ::-1] * stride
    return lift(pixels, depth[rows, cols], observation.intrinsics, observation.camera_pose)


def _cell_points(cells: IntArray, label: IntArray, points: FloatArray) -> tuple[IntArray, FloatArray]:
    """The different ones of ``cells (N,)``, and for each the mean of its ``points (N, 3)`` of the most frequent piece.

    The mean of all points of a cell at the border of a thing would lie neither on that nor on what is behind it.
    """
    shown, which, counts = np.unique(np.stack([cells, label]), axis=1, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(which.reshape(-1), axis) for axis in points.T], axis=1) / counts[:, None]
    order = np.lexsort((-counts, shown[0]))
    different, first = np.unique(shown[0][order], return_index=True)
    return different, means[order[first]]


def _check_resolution(observation: Observation) -> None:
    height, width = observation.depth.shape
    cx, cy = observation.intrinsics[:2, 2]
    if not (abs(cx / (width / 2) - 1) < MAX_CENTRE_OFFSET and abs(cy / (height / 2) - 1) < MAX_CENTRE_OFFSET):
        raise KeypointError(
            f"the intrinsics belong to an image of about {2 * cx:.0f}x{2 * cy:.0f} pixels, but this one has "
            f"{width}x{height}; scale them to it"
        )


def _unlike_table(
    observation: Observation,
    descriptors: DescriptorMap,
    pixels: IntArray,
    heights: FloatArray,
    table: Table,
    salient: float,
) -> NDArray[np.bool_]:
    """Which of ``pixels (N, 2)`` at ``heights (N,)`` are above the table, or salient and of another colour."""
    at = pixels[:, 1], pixels[:, 0]
    raised = heights > table.least_height
    flat = np.abs(heights) <= table.least_height
    colours = np.divide(observation.rgb[at], 255, dtype=np.float32)
    smoothed = np.divide(uniform_filter(observation.rgb, (SMOOTHING_PX, SMOOTHING_PX, 1))[at], 255, dtype=np.float32)
    colour = TableColour.fit(colours[flat] if flat.any() else colours)
    unlike = (colour.distance(smoothed) > MIN_DISTANCE_SMOOTHED) & (colour.distance(colours) > MIN_DISTANCE_POINT)
    return raised | (flat & unlike & (descriptors.saliency.flat[descriptors.cells_at(pixels)] > salient))
