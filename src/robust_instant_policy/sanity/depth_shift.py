"""By how many pixels is the depth image displaced against the colour image?

Where raised things end in the depth image, colours change. So the mean strength of colour edges along depth edges, as a
function of how far these are moved back, has its peak at the displacement of the depth image. Stripes, shadows and
sides of another colour move that peak, too, so that a displacement is a warning and never an error.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter, uniform_filter

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.pointcloud import in_metres
from robust_instant_policy.sanity.finding import Finding
from robust_instant_policy.sanity.view import RAISED_DEVIATIONS, RAISED_M, View

REACH_PX = 16  # of the displacements that are compared
ALIGNED_PX = 3.5  # displacement of sound images, where `sound_shift` is not more
OUTLINE = 0.6  # strength of colour edges (0 to 1) where depth edges are in place; objects without contrast have less
DISTINCT = 1.3  # strength at the peak over the median of all displacements, from which it is one, and
DISTINCT_DEVIATIONS = 3.0  # deviations over their mean
LOST = 0.1  # share of the peak's height over the median that is lost at the place where it should be
MIN_EDGE_PIXELS = 60  # of depth, below which nothing is measured
MEASURED = 10  # demonstrations that are compared
SMOOTH_PX = 1.0

Shift = tuple[int, int]


def edge_strength(view: View) -> FloatArray | None:
    """Mean strength of colour edges ``(2 R + 1, 2 R + 1)``, R = `REACH_PX`, along the depth edges of ``view``, for each
    displacement (rows, columns) that is taken back; None where there are too few depth edges."""
    edges = _depth_edges(view)
    if edges.sum() < MIN_EDGE_PIXELS:
        return None
    spectrum = np.fft.rfft2(edges).conj() * np.fft.rfft2(_colour_edges(view))
    sums = np.fft.irfft2(spectrum, s=edges.shape) / edges.sum()
    back = np.arange(REACH_PX, -REACH_PX - 1, -1)
    return np.asarray(sums[np.ix_(back, back)])


def _depth_edges(view: View) -> FloatArray:
    """1 where raised things end ``(H, W)`` at full resolution, away from the image's border."""
    observation = view.observation
    depth, _ = in_metres(observation.depth)
    # height = depth · n'R K⁻¹(u, v, 1)' + n't + d, of the plane (n, d) and the camera's pose (R, t)
    upward = view.plane[:3] @ observation.camera_pose[:3, :3] @ np.linalg.inv(observation.intrinsics)
    rows, cols = np.ogrid[: depth.shape[0], : depth.shape[1]]
    height = np.nan_to_num(depth * (upward[0] * cols + upward[1] * rows + upward[2]) + view.camera_height, nan=-1.0)
    raised = uniform_filter((height > max(RAISED_M, RAISED_DEVIATIONS * view.noise)).astype(np.float32), 5) > 0.5
    edges = maximum_filter(raised, size=3) & ~minimum_filter(raised, size=3)
    inner = np.zeros_like(edges)
    margin = slice(REACH_PX + 2, -REACH_PX - 2)
    inner[margin, margin] = edges[margin, margin]
    return inner.astype(np.float64)


def _colour_edges(view: View) -> FloatArray:
    """Strength ``(H, W)`` of the edges of colour at full resolution, saturated, so that no single edge decides."""
    smooth = gaussian_filter(view.observation.rgb.astype(np.float32), (SMOOTH_PX, SMOOTH_PX, 0))
    down, right = np.gradient(smooth, axis=(0, 1))
    strength = np.sqrt((down**2 + right**2).max(axis=-1))
    return np.minimum(strength / (np.percentile(strength, 97) + 1.0), 1.0)


def depth_shift(strength: FloatArray) -> Shift:
    """The displacement (columns, rows) of depth against colour, pixels: the peak of an `edge_strength`."""
    row, col = np.unravel_index(int(strength.argmax()), strength.shape)
    return int(col) - REACH_PX, int(row) - REACH_PX


def sound_shift(view: View) -> float:
    """Displacement, pixels, of sound images at most: depth edges lie `RAISED_M` above the table, colour edges on it."""
    down = abs(float(view.plane[:3] @ view.observation.camera_pose[:3, 2]))  # cosine of the camera's tilt
    pixels = view.observation.intrinsics[0, 0] / float(np.nanmedian(view.depth))  # a metre
    return max(ALIGNED_PX, RAISED_M * pixels * float(np.sqrt(max(1 - down**2, 0.0))))


def is_displaced(strength: FloatArray, usual: Shift, tolerance: float) -> bool:
    """Whether the peak of an `edge_strength` stands out and lies by more than ``tolerance``, pixels, beside ``usual``,
    where much of it is lost."""
    col, row = depth_shift(strength)
    beside = np.hypot(col - usual[0], row - usual[1]) > tolerance
    inside = max(abs(col), abs(row)) < REACH_PX  # else the peak may lie beyond
    middle, peak = float(np.median(strength)), float(strength.max())
    distinct = peak > max(OUTLINE, DISTINCT * middle, strength.mean() + DISTINCT_DEVIATIONS * strength.std())
    first_row, first_col = (max(REACH_PX + by - 1, 0) for by in (usual[1], usual[0]))
    there = float(strength[first_row : first_row + 3, first_col : first_col + 3].max())
    return bool(beside and inside and distinct and peak - there > LOST * (peak - middle))


def check_depth_shift(views: Sequence[View]) -> tuple[list[Finding], Shift]:
    """Whether depth is aligned to colour in demonstrations, and the displacement that they have in common."""
    measured = [(index, view, edge_strength(view)) for index, view in enumerate(views[:MEASURED])]
    known = [(index, view, strength) for index, view, strength in measured if strength is not None]
    if not known:
        return [], (0, 0)
    mean = np.mean([strength for *_, strength in known], axis=0)
    sound = max(sound_shift(view) for _, view, _ in known)
    if is_displaced(mean, (0, 0), sound):
        return [_finding("in the demonstrations ", depth_shift(mean), known[0][1])], depth_shift(mean)
    usual = depth_shift(mean) if np.hypot(*depth_shift(mean)) <= sound else (0, 0)
    return [
        _finding(f"in demonstration {index} ", depth_shift(strength), view)
        for index, view, strength in known
        if is_displaced(strength, usual, sound)
    ], usual


def check_scene_depth_shift(view: View, usual: Shift) -> list[Finding]:
    """Whether depth is displaced against colour otherwise than in the demonstrations, ``usual``."""
    strength = edge_strength(view)
    if strength is None or not is_displaced(strength, usual, sound_shift(view)):
        return []
    return [_finding("", depth_shift(strength), view, usual)]


def _finding(where: str, shift: Shift, view: View, usual: Shift = (0, 0)) -> Finding:
    pixels = float(np.hypot(shift[0] - usual[0], shift[1] - usual[1]))
    metres = pixels * float(np.nanmedian(view.depth) / view.observation.intrinsics[0, 0])
    words = f"{where}depth is displaced by {shift[0]:+d}, {shift[1]:+d} pixels ({metres * 1e3:.0f} mm) against colour"
    advice = ": their edges agree there; is depth aligned to colour, with the calibration of both?"
    numbers = {"cols": float(shift[0]), "rows": float(shift[1]), "metres": metres}
    return Finding("registration", "warning", words + advice, numbers, "depth displaced against colour")
