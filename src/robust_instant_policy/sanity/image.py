"""What one RGB-D image with its camera says about itself."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.pointcloud import MILLIMETRES_ABOVE
from robust_instant_policy.sanity.contact import GripperPath
from robust_instant_policy.sanity.finding import Finding, Severity
from robust_instant_policy.sanity.view import View

MIN_READINGS = 0.05  # share of the pixels that must have a steady depth
FEWEST_LEVELS = 16  # of depth that was stored coarsely; fewer are flat surfaces seen from straight above
COARSE = 0.005  # of the median depth: a greater smallest difference between readings comes from no camera
UNIFORM = 3.0  # of 255; a colour image that varies less shows nothing
GREY = 2  # of 255: largest difference of the channels in a grey image with noise
SQUARE_PIXELS = 0.1  # relative difference of fx and fy that no camera has
CENTRED = 0.2  # of the image's size that the principal point may lie from its middle
BAND_M, BAND_ON_TABLE, BAND_ROWS = 0.03, 0.02, 3  # height off the table, share of a row still on it, rows of the grid
SEEN = 12.0  # of 255: difference of the colour of a band from what is beside it, from which on it is a thing
HOLE_M = 0.012  # from a point to the nearest depth reading, from which on what is there was not measured
WIDE_M, WIDER = 0.015, 1.5  # the same of a hole that may hide a thing, and so many times the demonstrations' holes
NEAR_TABLE_M = 0.05  # height of fingertips over the table below which they work
TILT_ERROR_RAD, TILT_WARNING_RAD = np.deg2rad(4.0), np.deg2rad(2.0)  # of the table against the world's z axis


def check_image(view: View) -> list[Finding]:
    """Intrinsics that no camera has, images without content, and a table that is not level."""
    observation = view.observation
    found = []
    (fx, _, cx), (_, fy, cy) = observation.intrinsics[0], observation.intrinsics[1]
    height, width = observation.depth.shape
    if abs(fx - fy) > SQUARE_PIXELS * max(fx, fy):
        words = f"fx {fx:.4g} and fy {fy:.4g} differ by a factor of {max(fx, fy) / min(fx, fy):.2f}: pixels are square"
        numbers = {"fx": float(fx), "fy": float(fy)}
        found.append(Finding("intrinsics", "error", f"{words}; check the focal length", numbers, "focal length"))
    off = max(abs(cx - (width - 1) / 2) / width, abs(cy - (height - 1) / 2) / height)
    if off > CENTRED:
        words = f"the principal point ({cx:.0f}, {cy:.0f}) is far from the middle of {width}x{height} pixels"
        advice = "; are these the intrinsics of another resolution or of a crop?"
        found.append(Finding("intrinsics", "warning", words + advice, {"off_centre": off}, "principal point"))
    readings = float(np.isfinite(view.depth).mean())
    if readings < MIN_READINGS:
        share = f"steady readings in only {readings:.0%} of its pixels" if readings else "no readings"
        words = f"the depth image has {share}; check the camera's depth stream"
        return [*found, Finding("depth", "error", words, {"readings": readings})]
    for lines, colours, what in (
        (view.height, view.rgb, "rows"),
        (view.height.T, np.swapaxes(view.rgb, 0, 1), "columns"),
    ):
        if band := _band(lines):
            first, last = (edge * view.every for edge in band)
            numbers = {"first": float(first), "last": float(last)}
            if _in_colour(colours, *band):
                words = f"something hides the whole of {what} {first} to {last} from the camera; move it away"
                found.append(Finding("hole", "warning", words, numbers, "hidden"))
                continue
            words = f"depth is off over the whole of {what} {first} to {last}, and right beside them"
            return [*found, Finding("depth", "error", f"{words}; check the depth stream", numbers, f"a band of {what}")]
    raw = observation.depth[np.isfinite(observation.depth) & (observation.depth > 0)]
    if (median := float(np.median(raw))) > MILLIMETRES_ABOVE:
        words = f"depth has a median of {median:.0f}: it is in millimetres, and read as such; store metres"
        found.append(Finding("depth unit", "warning", words, {"median": median}, "millimetres"))
    levels = np.unique(raw)
    step = float(np.diff(levels).min(initial=np.inf))
    if len(levels) >= FEWEST_LEVELS and step > COARSE * median:
        words = f"depth has {len(levels)} levels only, at least {step:.3g} apart: was it stored in 8 bits?"
        found.append(Finding("depth levels", "warning", words, {"step": step}, "8 bits"))
    if (spread := float(view.rgb.std())) < UNIFORM:
        words = (
            f"the colour image is all the same (deviation {spread:.1f} of 255): is the lens covered, or the stream off?"
        )
        found.append(Finding("colour", "error", words, {"deviation": spread}, "black image"))
    elif np.ptp(observation.rgb, axis=-1).max() <= GREY:
        words = (
            "the colour image has shades of grey only: is it the infrared stream? things of other colours look alike"
        )
        found.append(Finding("colour", "warning", words, cause="infrared"))
    if view.camera_height <= 0:
        words = f"the camera lies {-view.camera_height:.2f} m below the table that it sees"
        found.append(Finding("camera pose", "error", words, {"camera_height": view.camera_height}))
    elif view.shows_table and view.tilt > TILT_WARNING_RAD:
        words = f"the table is tilted by {np.rad2deg(view.tilt):.1f} degrees in the world, whose z axis must point up"
        severity: Severity = "error" if view.tilt > TILT_ERROR_RAD else "warning"
        advice = "; the camera's pose is turned, or the depth is wrong"
        found.append(Finding("table", severity, words + advice, {"tilt": view.tilt}, "camera turned"))
    return found


def check_holes(views: Sequence[View], paths: Sequence[GripperPath]) -> list[Finding]:
    """Whether depth was read where grippers close, or work near the table."""
    unseen = []
    for view, path in zip(views, paths, strict=True):
        low = path.fingers[view.above_plane(path.fingers) < NEAR_TABLE_M]
        unseen.append((view.in_hole(np.concatenate([path.closings, low])) > HOLE_M).any())
    if not (count := sum(unseen)):
        return []
    words = f"no depth was read where the gripper closes or works in {count} of {len(views)} demonstrations"
    advice = (
        "what it handles was not measured there, and keypoints may lie on other things; light it, or move the camera"
    )
    severity: Severity = "warning" if 2 * count >= len(views) else "unchecked"
    return [Finding("hole", severity, f"{words}: {advice}", {"demonstrations": float(count)}, "depth missing")]


def check_hole(view: View, demonstrated: float) -> list[Finding]:
    """Whether a hole of the depth image may hide a thing.

    ``demonstrated``: of the widest hole in the demonstrations' images, metres from its middle to its rim.
    """
    widest = float(view.holes.max())
    if widest <= max(WIDE_M, WIDER * demonstrated):
        return []
    row, col = np.array(np.unravel_index(int(view.holes.argmax()), view.holes.shape)) * view.every
    words = f"the depth image has a hole, {2e3 * widest:.0f} mm wide, at pixel ({col}, {row})"
    advice = f"; the demonstrations' are at most {2e3 * demonstrated:.0f} mm wide: what is there was not measured"
    return [Finding("hole", "warning", words + advice, {"hole_m": 2 * widest}, "depth missing")]


def _band(height: FloatArray) -> tuple[int, int] | None:
    """First and last row of a band that lies off the table over its whole width, with rows on it on both sides.

    ``height (h, w)`` above the table, metres, NaN without a reading.
    """
    on_table = (np.abs(height) < BAND_M).mean(axis=1)
    off = np.flatnonzero(on_table < BAND_ON_TABLE)
    inner = np.flatnonzero(on_table > 0.5)
    if not len(inner):
        return None
    off = off[(off > inner[0]) & (off < inner[-1])]
    return (int(off[0]), int(off[-1])) if len(off) >= BAND_ROWS else None


def _in_colour(rgb: NDArray[np.float32], first: int, last: int) -> bool:
    """Whether ``rgb (h, w, 3)`` shows a band from row ``first`` to ``last``, too: a thing, no error of depth."""
    width = last - first + 1
    beside = np.concatenate([rgb[max(first - width, 0) : first], rgb[last + 1 : last + 1 + width]])
    apart = np.abs(rgb[first : last + 1].mean(axis=0) - beside.mean(axis=0)).max(axis=-1)
    return bool(np.median(apart) > SEEN)


def check_each_image(views: Sequence[View]) -> list[Finding]:
    """`check_image` of every view, the same finding told once."""
    told: dict[tuple[str, Severity], list[tuple[int, Finding]]] = {}
    for index, view in enumerate(views):
        for finding in check_image(view):
            told.setdefault((finding.kind, finding.severity), []).append((index, finding))
    result = []
    for (kind, severity), cases in told.items():
        index, first = cases[0]
        where = "all demonstrations" if len(cases) == len(views) else f"{len(cases)} of {len(views)} demonstrations"
        where = f"demonstration {index}" if len(cases) == 1 else f"{where}, such as {index}"
        result.append(Finding(kind, severity, f"{where}: {first.message}", first.numbers, first.cause))
    return result
