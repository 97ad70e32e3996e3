"""One observation as the checks see it: a thinned grid of points, the table plane, and what is raised above it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, distance_transform_edt, median_filter
from scipy.spatial import cKDTree

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import MAD_TO_STD, FloatArray, invert_pose, lift, transform_points
from robust_instant_policy.pointcloud import in_metres, steady, table_plane

MAX_EDGE_PX = 160  # the longer edge of the grid
RAISED_M = 0.012  # height above the table from which a point belongs to an object,
RAISED_DEVIATIONS = 5.0  # or this many deviations of the depth's noise, if that is more
MIN_ON_PLANE = 0.4  # share of the readings on the table's plane from which its height and tilt mean something
MUCH_BELOW = 0.3  # share of the readings below a plane that make it no table
BEFORE_LENS = 0.3  # of the median depth: what is nearer hides the scene and is no part of it
MIN_POINTS = 100  # readings below which an image says nothing
PLANE_SEED = 0
FAR_AWAY_M = 1e3
COLUMN_SPACINGS = 1.0  # of the grid's points on the surface, between a point and one measured straight above it
HOLE_M = 0.015  # from a point to the nearest one of the table, seen from above: beyond it there may be a hole
HOLE_CELLS = 5  # of the grid: most of a square of so many is deeper where there is a hole
BESIDE_HOLE_M = 0.06  # from a point to one seen deeper than the table: within it there may be a hole
COVER_M = 0.005  # of surface above a point that is inside a thing


@dataclass(frozen=True, eq=False)
class View:
    """A grid ``(h, w)`` of every ``every``-th pixel of an observation.

    ``depth (h, w)`` metres, NaN without a steady reading; ``points (h, w, 3)`` metres, world; ``rgb (h, w, 3)`` in
    0 to 255; ``plane (4,)`` unit normal (upward) and offset of the table; ``height (h, w)`` metres above it;
    ``noise`` the deviation of the table's points from the plane, metres; ``raised (h, w)`` bool, above the table and
    not right before the camera. ``share_on_plane`` is the share of the readings that lie on the plane.
    """

    observation: Observation
    every: int
    depth: NDArray[np.float32]
    rgb: NDArray[np.float32]
    points: FloatArray
    plane: FloatArray
    height: FloatArray
    noise: float
    share_on_plane: float
    raised: NDArray[np.bool_]

    @classmethod
    def of(cls, observation: Observation, repaired: bool = False) -> View:
        """The grid of ``observation``; depth in millimetres is read as such.

        Flying pixels are left out, unless the image is ``repaired``, as `coarse` does.
        """
        depth, _ = in_metres(observation.depth)
        every = -(-max(depth.shape) // MAX_EDGE_PX)
        grid = (depth if repaired else _without_flying_pixels(depth))[::every, ::every]
        rgb = observation.rgb[::every, ::every].astype(np.float32)
        rows, cols = np.mgrid[: grid.shape[0], : grid.shape[1]] * every
        points = lift(np.stack([cols, rows], axis=-1), grid, observation.intrinsics, observation.camera_pose)
        known = np.isfinite(grid)
        if known.sum() < MIN_POINTS:
            nothing = np.zeros(grid.shape, dtype=bool)
            return cls(
                observation, every, grid, rgb, points, np.array([0.0, 0, 1, 0]), points[..., 2], 0.0, 0.0, nothing
            )
        plane = table_plane(points[known], PLANE_SEED)
        height = points @ plane[:3] + plane[3]
        flat = np.abs(height[known])[np.abs(height[known]) < 3 * RAISED_M]
        noise = float(MAD_TO_STD * np.median(flat)) if len(flat) else 0.0
        raised = np.nan_to_num(height, nan=-1.0) > max(RAISED_M, RAISED_DEVIATIONS * noise)
        raised = median_filter(raised, size=3) if noise > 1e-3 else raised
        with np.errstate(invalid="ignore"):
            raised &= grid > BEFORE_LENS * np.median(grid[known])
        share = float((np.abs(height[known]) < max(RAISED_M, RAISED_DEVIATIONS * noise)).mean())
        return cls(observation, every, grid, rgb, points, plane, height, noise, share, raised)

    @property
    def shows_table(self) -> bool:
        """Whether enough of the image is the table to measure its height and tilt."""
        return self.share_on_plane >= MIN_ON_PLANE

    @property
    def is_support(self) -> bool:
        """Whether the plane is what things stand on: not the top of something large, with much of the image below."""
        known = np.isfinite(self.height)
        return bool((self.height[known] < -RAISED_M).mean() < MUCH_BELOW) if known.any() else False

    @property
    def tilt(self) -> float:
        """Angle between the table's normal and the world's z axis, rad."""
        return float(np.arccos(np.clip(self.plane[2], -1, 1)))

    @property
    def camera_height(self) -> float:
        """Of the camera above the table plane, metres; negative where it looks from below."""
        return float(self.above_plane(self.observation.camera_pose[:3, 3]))

    @cached_property
    def raised_points(self) -> FloatArray:
        """``(N, 3)`` metres, world."""
        return self.points[self.raised & np.isfinite(self.depth)]

    @property
    def object_centre(self) -> FloatArray:
        """Mean ``(3,)`` of the raised points; NaN where there are none."""
        return self.raised_points.mean(axis=0) if len(self.raised_points) else np.full(3, np.nan)

    @cached_property
    def deeper_points(self) -> FloatArray:
        """``(N, 3)`` metres, world: below the table, such as in a hole, and not single wrong readings."""
        low = np.nan_to_num(self.height) < -max(RAISED_M, RAISED_DEVIATIONS * self.noise)
        return self.points[low & median_filter(low, size=HOLE_CELLS)]

    @cached_property
    def tree(self) -> cKDTree:
        """Nearest point beside the table's plane; where there is none, one far away."""
        beside = np.concatenate([self.raised_points, self.deeper_points if self.is_support else self.points[:0, 0]])
        return cKDTree(beside if len(beside) else np.full((1, 3), FAR_AWAY_M))

    @cached_property
    def columns(self) -> cKDTree:
        """Nearest raised point seen from above."""
        return cKDTree(self.raised_points[:, :2] if len(self.raised_points) else np.full((1, 2), FAR_AWAY_M))

    def covered(self, points: FloatArray) -> NDArray[np.bool_]:
        """Whether a surface was measured straight above each of ``points (N, 3)``."""
        if not len(self.raised_points):
            return np.zeros(len(points), dtype=bool)
        spacing = self.every * float(np.nanmedian(self.depth)) / self.observation.intrinsics[0, 0]
        distance, nearest = self.columns.query(points[:, :2])
        over = self.above_plane(self.raised_points[nearest]) - self.above_plane(points)
        return (distance < COLUMN_SPACINGS * spacing) & (over > COVER_M + 2 * self.noise)

    def above_plane(self, points: FloatArray) -> FloatArray:
        """Heights ``(...)`` of ``points (..., 3)`` above the table, metres."""
        return points @ self.plane[:3] + self.plane[3]

    def above_table(self, points: FloatArray) -> FloatArray:
        """Heights ``(N,)`` of ``points (N, 3)`` above the table, metres; 0 below its plane where no table is seen, or
        something deeper: a hole."""
        height = self.above_plane(points)
        below = height < 0
        if below.any():
            thick = max(RAISED_M, RAISED_DEVIATIONS * self.noise)
            level = self.points[np.abs(self.height) < thick][:, :2]
            deeper = self.deeper_points[:, :2]
            at_table, at_hole = (
                cKDTree(some).query(points[below, :2])[0] if len(some) else np.full(int(below.sum()), np.inf)
                for some in (level, deeper)
            )
            height[below] = np.where((at_table < HOLE_M) & (at_hole > BESIDE_HOLE_M), height[below], 0.0)
        return height

    def behind_surface(self, points: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """How far ``points (N, 3)`` lie behind the surface seen at their pixels, metres, and whether that is raised.

        NaN where a point is outside the image or nothing was read there; negative: in front of the surface.
        """
        at, inside, distance = self._cells(points)
        return np.where(inside, distance - self.depth[at], np.nan), inside & self.raised[at]

    @cached_property
    def holes(self) -> FloatArray:
        """``(h, w)`` how far each cell lies inside a hole of the depth image, metres: 0 where depth was read, or where
        what has none reaches the image's border."""
        step = self.every
        read = np.nan_to_num(self.observation.depth[::step, ::step]) > 0
        if not read.any():
            return np.zeros(read.shape)
        spacing = step * float(np.nanmedian(self.depth)) / self.observation.intrinsics[0, 0]
        return np.asarray(distance_transform_edt(binary_fill_holes(read) & ~read) * spacing)

    def in_hole(self, points: FloatArray) -> FloatArray:
        """``holes (N,)`` where ``points (N, 3)`` are seen, metres."""
        at, inside, _ = self._cells(points)
        return np.where(inside, self.holes[at], 0.0)

    def _cells(
        self, points: FloatArray
    ) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], NDArray[np.bool_], FloatArray]:
        """Row and column of ``points (N, 3)`` in the grid, whether they are inside, and their depth (metres)."""
        local = transform_points(invert_pose(self.observation.camera_pose), points)
        image = local @ self.observation.intrinsics.T
        with np.errstate(divide="ignore", invalid="ignore"):
            cells = np.rint(image[:, :2] / image[:, 2:] / self.every)
        height, width = self.depth.shape
        inside = (local[:, 2] > 0) & np.isfinite(cells).all(axis=1)
        inside &= (cells >= 0).all(axis=1) & (cells[:, 0] < width) & (cells[:, 1] < height)
        col, row = np.where(inside[:, None], cells, 0).astype(np.intp).T
        return (row, col), inside, local[:, 2]


def coarse(observation: Observation, max_edge: int) -> Observation:
    """``observation`` on a grid of at most ``max_edge`` pixels along the longer edge, flying pixels left out."""
    every = -(-max(observation.depth.shape) // max_edge)
    depth, _ = in_metres(observation.depth)
    shrink = np.array([[1 / every, 1, 1 / every], [1, 1 / every, 1 / every], [1, 1, 1]])
    return replace(
        observation,
        rgb=observation.rgb[::every, ::every],
        depth=_without_flying_pixels(depth)[::every, ::every],
        intrinsics=observation.intrinsics * shrink,
    )


def _without_flying_pixels(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    with np.errstate(invalid="ignore"):
        return np.where(steady(depth), depth, np.float32("nan"))
