"""Do the colour and the depth image show the same scene? Edges of depth must be edges of colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_gradient_magnitude, maximum_filter, minimum_filter
from scipy.optimize import linear_sum_assignment

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.sanity.finding import Finding, Severity
from robust_instant_policy.sanity.geometry import MIN_SHARE
from robust_instant_policy.sanity.hypotheses import TURNS
from robust_instant_policy.sanity.view import View

EDGE_SIGMA_PX = 0.7
MIN_EDGE_PIXELS = 12  # of depth below which nothing can be said
FAR_SHIFTS = ((0.13, 0.07), (-0.11, 0.17), (0.21, -0.12), (-0.16, -0.19), (0.29, 0.23), (-0.27, 0.05), (0.05, -0.31))
"""Displacements, as shares of the image, at which depth and colour cannot agree but by chance."""
NEAR_SHARE = 0.16  # of the image that a depth image may be displaced to be called not aligned
CLEARLY = 1.35  # times as strong as by chance: edges agree
DISTINCT_EDGES = 1.6  # times as strong as by chance, which does not happen by chance in a sound image
NAMED = 1.25  # times as strong as now: a displacement or turn that explains it
ALONG = 0.6  # strength, of 1, of colour edges along depth edges that belong to them; by chance, over many tries, less


@dataclass(frozen=True)
class Agreement:
    """``own`` is the mean strength of colour edges along depth edges, ``chance`` the median of that over `FAR_SHIFTS`;
    ``cause`` names what makes them agree better, with the strength ``best`` then. NaN where there are too few edges.
    """

    own: float
    chance: float
    best: float
    cause: str

    @property
    def ratio(self) -> float:
        """How much stronger than by chance; about 1 where the images have nothing to do with each other."""
        return self.own / self.chance if self.chance > 0 else float("nan")


def colour_edges(rgb: NDArray[np.float32]) -> FloatArray:
    """Strength ``(h, w)`` of the edges of ``rgb (h, w, 3)``, saturated, so that no single edge decides."""
    channels = np.moveaxis(rgb, -1, 0)
    strength = np.max([gaussian_gradient_magnitude(channel, EDGE_SIGMA_PX) for channel in channels], axis=0)
    strength = maximum_filter(strength, size=3)
    return np.minimum(strength / (np.percentile(strength, 97) + 1.0), 1.0)


def depth_edges(view: View) -> NDArray[np.bool_]:
    """Where raised things end ``(h, w)``, away from the image's border."""
    edges = maximum_filter(view.raised, size=3) & ~minimum_filter(view.raised, size=3)
    edges[[0, 1, -2, -1]] = False
    edges[:, [0, 1, -2, -1]] = False
    return edges


def agreement(view: View) -> Agreement:
    """Of the colour and the depth image of ``view``."""
    edges, colour = depth_edges(view), colour_edges(view.rgb)
    if edges.sum() < MIN_EDGE_PIXELS:
        return Agreement(float("nan"), float("nan"), float("nan"), "")
    size = np.array(edges.shape)
    own = float(colour[edges].mean())
    chance = float(
        np.median([colour[np.roll(edges, tuple(np.rint(size * s).astype(int)), (0, 1))].mean() for s in FAR_SHIFTS])
    )
    found = Agreement(own, chance, own, "")
    if found.ratio >= CLEARLY:
        return found
    tried = [(float(colour[edges[::rows, ::cols]].mean()), f"one of them {what}") for what, rows, cols in TURNS]
    # all displacements at once: the sum of colour edges under displaced depth edges is a cross-correlation
    spectrum = np.fft.rfft2(edges.astype(float)).conj() * np.fft.rfft2(colour)
    sums = np.fft.fftshift(np.fft.irfft2(spectrum, s=edges.shape)) / edges.sum()
    middle, reach = size // 2, np.maximum((size * NEAR_SHARE).astype(int), 2)
    window = sums[middle[0] - reach[0] : middle[0] + reach[0] + 1, middle[1] - reach[1] : middle[1] + reach[1] + 1]
    row, col = np.unravel_index(int(window.argmax()), window.shape)
    by = np.array([col - reach[1], row - reach[0]]) * view.every
    if 0 < row < 2 * reach[0] and 0 < col < 2 * reach[1]:  # else the best may lie beyond
        words = f"depth moved by {by[0]:+d}, {by[1]:+d} pixels (it is not aligned to colour, or of another scene)"
        tried.append((float(window.max()), words))
    best, cause = max(tried)
    return Agreement(own, chance, best, cause if best > NAMED * max(own, chance) else "")


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
