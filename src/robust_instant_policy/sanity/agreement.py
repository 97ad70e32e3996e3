"""Do the colour and the depth image show the same scene, in the same place? Edges of depth must be edges of colour.

The mean strength of colour edges along depth edges, as a function of how far these are moved back, has its peak at the
displacement of the depth image. At no displacement it is about that by chance where the images are of different scenes.
Stripes, shadows and sides of another colour move the peak, too, so that a small displacement is a warning and no error.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_gradient_magnitude, maximum_filter, minimum_filter, uniform_filter
from scipy.optimize import linear_sum_assignment

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.pointcloud import in_metres
from robust_instant_policy.sanity.finding import Finding, Severity
from robust_instant_policy.sanity.geometry import MIN_SHARE
from robust_instant_policy.sanity.hypotheses import TURNS
from robust_instant_policy.sanity.view import RAISED_DEVIATIONS, RAISED_M, View

EDGE_SIGMA_PX = 0.7  # of the grid
SMOOTH_PX = 1.0  # of the image
MIN_EDGE_PIXELS, MIN_EDGE_CELLS = 60, 12  # of depth, in the image and in the grid, below which nothing can be said
FAR_SHIFTS = ((0.13, 0.07), (-0.11, 0.17), (0.21, -0.12), (-0.16, -0.19), (0.29, 0.23), (-0.27, 0.05), (0.05, -0.31))
"""Displacements, as shares of the image, at which depth and colour cannot agree but by chance."""
REACH = 0.16  # share of the image, of the displacements that are compared
NEAR_PX = 16  # beyond it a displacement is no fault of a calibration
ALIGNED_PX = 3.5  # displacement of sound images, where `sound_shift` is not more
LOST = 0.3  # share of the peak's height over the median that is lost at the place where it should be
CLEARLY = 1.35  # times as strong as by chance: edges agree
DISTINCT_EDGES = 1.6  # times as strong as by chance, which does not happen by chance in a sound image
NAMED = 1.25  # times as strong as now: a displacement or turn that explains it
ALONG = 0.6  # strength, of 1, of colour edges along depth edges that belong to them; by chance, over many tries, less

Shift = tuple[int, int]  # columns, rows, in pixels


@dataclass(frozen=True)
class Agreement:
    """``own`` is the mean strength of colour edges along depth edges, ``chance`` the median of that over `FAR_SHIFTS`;
    ``cause`` names what makes them agree better, with the strength ``best`` then. NaN where there are too few edges.
    ``strength`` is that at all displacements, see `edge_strength`.
    """

    own: float
    chance: float
    best: float
    cause: str
    strength: FloatArray | None

    @property
    def ratio(self) -> float:
        """How much stronger than by chance; about 1 where the images have nothing to do with each other."""
        return self.own / self.chance if self.chance > 0 else float("nan")


def colour_edges(rgb: NDArray[np.float32]) -> FloatArray:
    """Strength ``(h, w)`` of the edges of ``rgb (h, w, 3)``, saturated, so that no single edge decides."""
    channels = np.moveaxis(rgb, -1, 0)
    strength = np.max([gaussian_gradient_magnitude(channel, EDGE_SIGMA_PX) for channel in channels], axis=0)
    return _saturated(maximum_filter(strength, size=3))


def depth_edges(view: View) -> NDArray[np.bool_]:
    """Where raised things end ``(h, w)``, away from the image's border."""
    edges = maximum_filter(view.raised, size=3) & ~minimum_filter(view.raised, size=3)
    edges[[0, 1, -2, -1]] = False
    edges[:, [0, 1, -2, -1]] = False
    return edges


def edge_strength(view: View) -> FloatArray | None:
    """Mean strength of colour edges ``(2 R + 1, 2 C + 1)`` along depth edges at full resolution, for each displacement
    (rows, columns) up to `REACH` that is taken back; None where there are too few depth edges."""
    observation = view.observation
    depth, _ = in_metres(observation.depth)
    # height = depth · n'R K⁻¹(u, v, 1)' + n't + d, of the plane (n, d) and the camera's pose (R, t)
    upward = view.plane[:3] @ observation.camera_pose[:3, :3] @ np.linalg.inv(observation.intrinsics)
    rows, cols = np.ogrid[: depth.shape[0], : depth.shape[1]]
    height = np.nan_to_num(depth * (upward[0] * cols + upward[1] * rows + upward[2]) + view.camera_height, nan=-1.0)
    raised = uniform_filter((height > max(RAISED_M, RAISED_DEVIATIONS * view.noise)).astype(np.float32), 5) > 0.5
    edges = maximum_filter(raised, size=3) & ~minimum_filter(raised, size=3)
    inner = np.zeros(edges.shape)
    margin = slice(NEAR_PX + 2, -NEAR_PX - 2)
    inner[margin, margin] = edges[margin, margin]
    if inner.sum() < MIN_EDGE_PIXELS:
        return None
    smooth = gaussian_filter(observation.rgb.astype(np.float32), (SMOOTH_PX, SMOOTH_PX, 0))
    down, right = np.gradient(smooth, axis=(0, 1))
    colour = _saturated(np.sqrt((down**2 + right**2).max(axis=-1)))
    # all displacements at once: the sum of colour edges under displaced depth edges is a cross-correlation
    sums = np.fft.irfft2(np.fft.rfft2(inner).conj() * np.fft.rfft2(colour), s=inner.shape) / inner.sum()
    back = [np.arange(reach, -reach - 1, -1) for reach in (max(NEAR_PX, int(REACH * size)) for size in inner.shape)]
    return np.asarray(sums[np.ix_(*back)])


def _saturated(strength: FloatArray) -> FloatArray:
    """``strength (H, W)`` of edges, 0 to 1, so that no single edge decides."""
    return np.minimum(strength / (np.percentile(strength, 97) + 1.0), 1.0)


def agreement(view: View) -> Agreement:
    """Of the colour and the depth image of ``view``."""
    edges, colour, strength = depth_edges(view), colour_edges(view.rgb), edge_strength(view)
    if edges.sum() < MIN_EDGE_CELLS:
        return Agreement(float("nan"), float("nan"), float("nan"), "", strength)
    size = np.array(edges.shape)
    own = float(colour[edges].mean())
    chance = float(
        np.median([colour[np.roll(edges, tuple(np.rint(size * s).astype(int)), (0, 1))].mean() for s in FAR_SHIFTS])
    )
    found = Agreement(own, chance, own, "", strength)
    if found.ratio >= CLEARLY:
        return found
    tried = [(float(colour[edges[::rows, ::cols]].mean()), f"one of them {what}") for what, rows, cols in TURNS]
    if strength is not None and not _is_at_border(strength):
        words = "depth moved by {:+d}, {:+d} pixels (it is not aligned to colour, or of another scene)"
        tried.append((float(strength.max()), words.format(*depth_shift(strength))))
    best, cause = max(tried)
    return Agreement(own, chance, best, cause if best > NAMED * max(own, chance) else "", strength)


def depth_shift(strength: FloatArray) -> Shift:
    """The displacement of depth against colour: the peak of an `edge_strength`."""
    row, col = np.unravel_index(int(strength.argmax()), strength.shape)
    return int(col) - strength.shape[1] // 2, int(row) - strength.shape[0] // 2


def _is_at_border(strength: FloatArray) -> bool:
    """Whether the best displacement may lie beyond those that were compared."""
    return strength.max() > strength[1:-1, 1:-1].max()


def _near(strength: FloatArray) -> FloatArray:
    """The part of an `edge_strength` up to `NEAR_PX`."""
    rows, cols = (slice(size // 2 - NEAR_PX, size // 2 + NEAR_PX + 1) for size in strength.shape)
    return strength[rows, cols]


def sound_shift(view: View) -> float:
    """Displacement, pixels, of sound images at most: depth edges lie `RAISED_M` above the table, colour edges on it."""
    down = abs(float(view.plane[:3] @ view.observation.camera_pose[:3, 2]))  # cosine of the camera's tilt
    pixels = view.observation.intrinsics[0, 0] / float(np.nanmedian(view.depth))  # a metre
    return max(ALIGNED_PX, RAISED_M * pixels * float(np.sqrt(max(1 - down**2, 0.0))))


def is_displaced(strength: FloatArray, usual: Shift, tolerance: float) -> bool:
    """Whether the peak of an `edge_strength` up to `NEAR_PX` lies by more than ``tolerance``, pixels, beside ``usual``,
    where much of it is lost."""
    near = _near(strength)
    col, row = depth_shift(near)
    if np.hypot(col - usual[0], row - usual[1]) <= tolerance or _is_at_border(near):
        return False
    peak = float(near.max())
    first_row, first_col = (max(NEAR_PX + by - 1, 0) for by in (usual[1], usual[0]))
    there = float(near[first_row : first_row + 3, first_col : first_col + 3].max())
    return peak > ALONG and peak - there > LOST * (peak - float(np.median(near)))


def check_depth_shift(views: Sequence[View], found: Sequence[Agreement]) -> tuple[list[Finding], Shift]:
    """Whether depth is aligned to colour in demonstrations, and the displacement that they have in common."""
    known = [
        (index, view, _near(one.strength))
        for index, (view, one) in enumerate(zip(views, found, strict=True))
        if one.strength is not None
    ]
    if not known:
        return [], (0, 0)
    mean = np.mean([strength for *_, strength in known], axis=0)
    sound = max(sound_shift(view) for _, view, _ in known)
    if is_displaced(mean, (0, 0), sound):
        return [_displaced("in the demonstrations ", depth_shift(mean), known[0][1])], depth_shift(mean)
    usual = depth_shift(mean) if np.hypot(*depth_shift(mean)) <= sound else (0, 0)
    return [
        _displaced(f"in demonstration {index} ", depth_shift(strength), view)
        for index, view, strength in known
        if is_displaced(strength, usual, sound)
    ], usual


def check_scene_depth_shift(view: View, found: Agreement, usual: Shift) -> list[Finding]:
    """Whether depth is displaced against colour otherwise than in the demonstrations, ``usual``."""
    if found.strength is None or not is_displaced(found.strength, usual, sound_shift(view)):
        return []
    return [_displaced("", depth_shift(_near(found.strength)), view, usual)]


def _displaced(where: str, shift: Shift, view: View, usual: Shift = (0, 0)) -> Finding:
    pixels = float(np.hypot(shift[0] - usual[0], shift[1] - usual[1]))
    metres = pixels * float(np.nanmedian(view.depth) / view.observation.intrinsics[0, 0])
    words = f"{where}depth is displaced by {shift[0]:+d}, {shift[1]:+d} pixels ({metres * 1e3:.0f} mm) against colour"
    advice = ": their edges agree there; is depth aligned to colour, with the calibration of both?"
    numbers = {"cols": float(shift[0]), "rows": float(shift[1]), "metres": metres}
    return Finding("registration", "warning", words + advice, numbers, "depth displaced against colour")


def exchanged(views: Sequence[View]) -> tuple[int, float, float]:
    """How many colour images fit the depth of another view better, when images are exchanged for the best fit; the
    mean strength of edges then, and as they are."""
    edges, colours = [depth_edges(view) for view in views], [colour_edges(view.rgb) for view in views]
    strength = np.array([[colour[e].mean() if e.any() else 0.0 for colour in colours] for e in edges])
    rows, order = linear_sum_assignment(-strength)
    return int((order != rows).sum()), float(strength[rows, order].mean()), float(np.diag(strength).mean())


def check_agreement(views: Sequence[View], found: Sequence[Agreement]) -> list[Finding]:
    """Whether colour and depth of the demonstrations show the same scenes."""
    ratios = np.array([one.ratio for one in found])
    if not np.isfinite(ratios).any():
        return []
    usual = float(np.nanmedian(ratios))
    numbers = {"edges": usual}
    if usual >= CLEARLY:
        low = [i for i, one in enumerate(found) if one.ratio < 1 + (usual - 1) / 4]
        words = f"colour and depth of demonstration {low[0]} show different scenes" if low else ""
        return [Finding("colour and depth", "warning", words, numbers)] if low else []
    if len({view.depth.shape for view in views}) == 1:
        moved, best, as_is = exchanged(views)
        if moved > len(views) / 2 and best > max(ALONG, CLEARLY * as_is):
            words = (
                f"edges of depth are no edges of colour; with other colour images ({moved} of {len(views)}) they are"
            )
            advice = f" ({best / max(as_is, 1e-9):.1f} times stronger): pair each depth image with its own colour image"
            cause = "colour and depth of different episodes"
            return [Finding("colour and depth", "error", words + advice, numbers, cause)]
    kinds = [one.cause.split(" (")[0] for one in found if one.cause and one.best > ALONG]
    common = max(set(kinds), key=kinds.count, default="")
    if common and kinds.count(common) >= MIN_SHARE * len(found):
        words = f"edges of depth are no edges of colour ({usual:.1f} times chance); with {common} they are"
        return [Finding("colour and depth", "error", words, numbers, f"colour and depth: {common}")]
    words = f"edges of depth are no edges of colour ({usual:.1f} times chance)"
    advice = ": colour and depth are of different scenes or streams, or the objects look like the table"
    return [Finding("colour and depth", "warning", words + advice, numbers, "colour and depth of different scenes")]


def check_scene_agreement(found: Agreement, demonstrated: FloatArray) -> list[Finding]:
    """An error where the images agree far less than in any demonstration, a warning where less than is usual.

    Only far less than in all, because texture, such as wood grain, hides the edges of some sound scenes.
    """
    usual, lowest = (float(np.median(demonstrated)), float(demonstrated.min())) if len(demonstrated) else (0.0, 0.0)
    if not np.isfinite(found.ratio) or usual < CLEARLY or found.ratio >= 1 + (usual - 1) / 3:
        return []
    severity: Severity = "error" if lowest >= DISTINCT_EDGES and found.ratio < 1 + (lowest - 1) / 3 else "warning"
    cause = found.cause or "colour and depth of different scenes"
    words = f"edges of depth are no edges of colour ({found.ratio:.1f} times chance, {usual:.1f} in the demonstrations)"
    told = f"; with {found.cause} they are" if found.cause else ": colour and depth are of different scenes or streams"
    numbers = {"edges": found.ratio, "usual": usual}
    return [Finding("colour and depth", severity, words + told, numbers, f"colour and depth: {cause}")]
