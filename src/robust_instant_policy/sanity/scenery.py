"""What stays the same in all images of a fixed camera, and whether a new image still shows it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, invert_pose, project
from robust_instant_policy.sanity.view import View

SAME_PLACE_M = 0.003  # two camera poses nearer than this, and
SAME_ANGLE_RAD = 0.005  # turned by less, are one
SAME_INTRINSICS = 0.005  # relative difference of two cameras' intrinsics that are one
CALIBRATION_M, CALIBRATION_RAD = 0.01, np.deg2rad(1.0)  # that another calibration of one camera changes its pose,
CALIBRATION_SHARE = 0.03  # and its intrinsics
DEPTH_SHARE = 0.01  # of the depth by which a static pixel may differ,
DEPTH_M = 0.006  # and at least this
STATIC = 0.8  # share of the images that must agree on a pixel for it to be scenery
DETAIL_PX = 3.0  # texture is what remains of the brightness without what is smoother than this
MIN_TEXTURE = 0.35  # correlation of the demonstrations' own texture below which colour decides nothing
EXCHANGED = 2.0  # times nearer that colours must be with channels exchanged, and
COLOUR_NOISE = 3.0  # of 255 beyond that
COLOUR_CHANGE = 20.0  # of 255, from one image to the next, that is no change
MIN_PIXELS = 50  # fewer say nothing
BRIGHTNESS_NOISE = 1.0  # of 255


@dataclass(frozen=True)
class CameraChange:
    """How a camera differs from another: metres, rad, and the largest relative difference of the intrinsics."""

    moved: float
    turned: float
    intrinsics: float

    @property
    def same(self) -> bool:
        return self.moved < SAME_PLACE_M and self.turned < SAME_ANGLE_RAD and self.intrinsics < SAME_INTRINSICS

    @property
    def pose_within_calibration(self) -> bool:
        return self.moved < CALIBRATION_M and self.turned < CALIBRATION_RAD

    @property
    def intrinsics_within_calibration(self) -> bool:
        return self.intrinsics < CALIBRATION_SHARE

    @property
    def within_calibration(self) -> bool:
        return self.pose_within_calibration and self.intrinsics_within_calibration

    def __str__(self) -> str:
        return (
            f"{self.moved * 100:.1f} cm and {np.rad2deg(self.turned):.1f} degrees away, "
            f"intrinsics up to {self.intrinsics:.0%} different"
        )


def camera_change(old: Observation, new: Observation) -> CameraChange:
    """From the camera of ``old`` to that of ``new``."""
    between = invert_pose(old.camera_pose) @ new.camera_pose
    cosine = np.clip((np.trace(between[:3, :3]) - 1) / 2, -1, 1)
    entries = np.array([[0, 1, 0, 1], [0, 1, 2, 2]])  # fx, fy, cx, cy
    a, b = old.intrinsics[tuple(entries)], new.intrinsics[tuple(entries)]
    scale = np.array([a[0], a[1], old.rgb.shape[1], old.rgb.shape[0]])
    different = float(np.max(np.abs(a - b) / scale))
    return CameraChange(float(np.linalg.norm(between[:3, 3])), float(np.arccos(cosine)), different)


def detail(rgb: NDArray[np.float32]) -> FloatArray:
    """Texture ``(h, w)`` of ``rgb (h, w, 3)``: brightness without its smooth part, which lighting changes."""
    grey = rgb.mean(axis=-1)
    return grey - gaussian_filter(grey, DETAIL_PX)


def correlation(a: FloatArray, b: FloatArray, mask: NDArray[np.bool_]) -> float:
    """Pearson's correlation of two images where ``mask`` is set; outliers such as objects are cut off first."""
    if mask.sum() < MIN_PIXELS:
        return float("nan")
    x, y = a[mask], b[mask]
    x, y = (np.clip(v, *np.percentile(v, [1, 99])) for v in (x, y))
    x, y = x - x.mean(), y - y.mean()
    norms = float(np.linalg.norm(x) * np.linalg.norm(y))
    return float(x @ y) / norms if norms > len(x) * BRIGHTNESS_NOISE**2 else float("nan")


@dataclass(frozen=True)
class Likeness:
    """Of an image to the scenery: the ``depth`` share of static pixels that agree and the correlation of
    ``texture``, NaN where unknown; ``ratio`` and ``offset`` (metres), medians of new by old and new minus old depth.
    """

    depth: float
    texture: float
    ratio: float
    offset: float


UNKNOWN_LIKENESS = Likeness(*[float("nan")] * 4)


@dataclass(frozen=True, eq=False)
class Scenery:
    """The static background of images from one fixed camera, on the grid of `View`.

    ``depth (h, w)`` metres and ``rgb (h, w, 3)``: medians over the images; ``static (h, w)`` bool,
    ``steady (h, w)`` where colour stays the same, too. ``texture`` and
    ``agreed`` are the lowest `Likeness` of the images themselves, what a sound image has at least.
    """

    reference: Observation
    depth: FloatArray
    rgb: NDArray[np.float32]
    static: NDArray[np.bool_]
    steady: NDArray[np.bool_]
    texture: float
    agreed: float

    @classmethod
    def of(cls, views: Sequence[View]) -> Scenery:
        """Of ``views`` that share one camera and one image size."""
        depths = np.stack([view.depth for view in views])
        unknown = np.isnan(depths)
        depth = np.median(np.where(unknown, np.inf, depths), axis=0)
        depth[~np.isfinite(depth)] = np.nan
        raised = np.stack([view.raised for view in views])
        near = np.abs(depths - depth) < np.maximum(DEPTH_M, DEPTH_SHARE * depth)
        # a raised thing that never moves, a parked arm, is scenery too
        seldom_raised = (near & ~raised).mean(axis=0) >= STATIC
        static = (near.mean(axis=0) >= STATIC) & (seldom_raised | (raised.mean(axis=0) >= STATIC))
        rgb = np.median(np.stack([view.rgb for view in views]), axis=0).astype(np.float32)
        # shadows and flat things move with the objects
        change = np.abs(np.stack([view.rgb for view in views]) - rgb).max(axis=-1)
        steady = static & ((change < COLOUR_CHANGE).mean(axis=0) >= STATIC)
        bare = cls(views[0].observation, depth, rgb, static, steady, float("nan"), 1.0)
        copies = all(np.array_equal(view.rgb, views[0].rgb) for view in views[1:])  # say nothing of the camera's noise
        if len(views) < 3 or copies:  # a median of two is neither
            return bare
        own = [bare.likeness(view) for view in views]
        texture = float(np.nanmin(values)) if np.isfinite(values := [o.texture for o in own]).any() else float("nan")
        return cls(views[0].observation, depth, rgb, static, steady, texture, min(o.depth for o in own))

    @property
    def textured(self) -> bool:
        """Whether the background's texture repeats in the images themselves, so that it can be compared."""
        return bool(self.texture >= MIN_TEXTURE)

    def likeness(self, view: View) -> Likeness:
        """Of ``view`` where the scenery is not hidden by what stands on the table."""
        if view.depth.shape != self.depth.shape:
            return UNKNOWN_LIKENESS
        tolerance = np.maximum(DEPTH_M, DEPTH_SHARE * self.depth) + 3 * view.noise
        clear = self.static & np.isfinite(view.depth) & ~view.raised
        if clear.sum() < MIN_PIXELS:
            return UNKNOWN_LIKENESS
        old, new = self.depth[clear], view.depth[clear]
        return Likeness(
            float((np.abs(new - old) < tolerance[clear]).mean()),
            correlation(detail(self.rgb), detail(view.rgb), clear & self.steady),
            float(np.median(new / old)),
            float(np.median(new - old)),
        )

    def texture_in_world(self, view: View) -> float:
        """Correlation of the texture that ``view`` and the scenery show at the same places of the table, wherever the
        two cameras are; NaN where they share too little."""
        flat = np.isfinite(view.depth) & ~view.raised
        pixels = project(view.points[flat], self.reference.intrinsics, self.reference.camera_pose)
        every = -(-max(self.reference.depth.shape) // max(self.depth.shape))
        col, row = np.rint(pixels / every).astype(np.intp).T
        height, width = self.depth.shape
        inside = (col >= 0) & (col < width) & (row >= 0) & (row < height)
        inside[inside] = self.steady[row[inside], col[inside]]
        old = detail(self.rgb)[row[inside], col[inside]]
        return correlation(old, detail(view.rgb)[flat][inside], np.ones(len(old), dtype=bool))

    def swapped(self, view: View) -> bool:
        """Whether the colours of ``view`` are the scenery's with red and blue exchanged."""
        clear = self.steady & ~view.raised
        if view.rgb.shape != self.rgb.shape or clear.sum() < MIN_PIXELS:
            return False
        old, new = self.rgb[clear], view.rgb[clear]
        as_is, exchanged = (float(np.abs(old - other).mean()) for other in (new, new[:, ::-1]))
        return as_is > EXCHANGED * exchanged + COLOUR_NOISE

    def shift(self, view: View) -> tuple[int, int, float]:
        """The displacement (columns, rows, in full pixels) at which the texture of ``view`` fits best, and the
        correlation of the scenery's texture there."""
        a, b = detail(self.rgb), detail(view.rgb)
        a, b = (np.clip(v, *np.percentile(v, [1, 99])) for v in (a, b))
        a, b = np.where(self.steady, a, 0), np.where(view.raised, 0, b)
        spectrum = np.fft.rfft2(a).conj() * np.fft.rfft2(b)
        peaks = np.fft.irfft2(spectrum, s=a.shape) / (np.linalg.norm(a) * np.linalg.norm(b) + 1e-9)
        row, col = np.unravel_index(int(peaks.argmax()), peaks.shape)
        height, width = a.shape
        rows, cols = (int(row) + height // 2) % height - height // 2, (int(col) + width // 2) % width - width // 2
        back = np.roll(detail(view.rgb), (-rows, -cols), (0, 1))
        clear = self.steady & ~np.roll(view.raised, (-rows, -cols), (0, 1))
        margin_rows, margin_cols = abs(rows) + 1, abs(cols) + 1  # what was rolled round is not the picture
        inner = np.zeros_like(clear)
        inner[margin_rows:-margin_rows, margin_cols:-margin_cols] = True
        return cols * view.every, rows * view.every, correlation(detail(self.rgb), back, clear & inner)
