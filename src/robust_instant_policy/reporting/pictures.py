"""Camera images with keypoints and paths over them, as values for the template `picture`."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, invert_pose, project, transform_points
from robust_instant_policy.reporting.pages import jpeg

REFERENCE_WIDTH = 256  # pixels of an image in which a line of width 1 is one pixel wide
KEYPOINT_COLOURS = (
    "#e6194b", "#3cb44b", "#ffe119", "#4363d8", "#f58231", "#911eb4", "#42d4f4", "#f032e6", "#bfef45", "#fabed4",
)  # fmt: skip


@dataclass(frozen=True)
class Mark:
    """A keypoint at the pixel ``(u, v)``, and its true position, if that is known."""

    u: float
    v: float
    label: str
    colour: str
    title: str
    truth: tuple[float, float] | None = None


@dataclass(frozen=True)
class Line:
    """A polyline through ``points``, in the syntax of SVG; ``dash`` is empty for a solid one."""

    points: str
    colour: str
    width: float
    dash: str = ""
    title: str = ""


@dataclass(frozen=True)
class Picture:
    """An image, as a data URL, ``width`` × ``height`` pixels, with what is drawn over it."""

    image: str
    width: int
    height: int
    caption: str
    lines: tuple[Line, ...] = ()
    marks: tuple[Mark, ...] = ()


def picture(rgb: NDArray[np.uint8], caption: str, lines: Sequence[Line] = (), marks: Sequence[Mark] = ()) -> Picture:
    height, width = rgb.shape[:2]
    return Picture(jpeg(rgb), width, height, caption, tuple(lines), tuple(marks))


def keypoint_colour(index: int) -> str:
    return KEYPOINT_COLOURS[index % len(KEYPOINT_COLOURS)]


def keypoint_marks(
    pixels: FloatArray, confidence: FloatArray | None = None, truth: FloatArray | None = None
) -> list[Mark]:
    """Numbered marks at ``pixels (K, 2)``; ``truth (K, 2)`` may hold NaN."""
    marks = []
    for index, (u, v) in enumerate(np.reshape(pixels, (-1, 2)) + 0.5):
        told = "" if confidence is None else f", confidence {confidence[index]:.2f}"
        known = None
        if truth is not None and np.isfinite(truth[index]).all():
            known = (float(truth[index, 0]) + 0.5, float(truth[index, 1]) + 0.5)
        marks.append(Mark(u, v, str(index), keypoint_colour(index), f"keypoint {index}{told}", known))
    return marks


def svg_points(points: FloatArray, observation: Observation) -> str:
    """Those of ``points (T, 3)``, world, that lie before the camera of ``observation``, as points of an SVG line."""
    before = points[transform_points(invert_pose(observation.camera_pose), points)[:, 2] > 0]
    pixels = project(before, observation.intrinsics, observation.camera_pose) + 0.5
    return " ".join(f"{u:.1f},{v:.1f}" for u, v in pixels)
