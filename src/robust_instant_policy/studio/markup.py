"""HTML that the page shows, from the macros of ``templates/panel.html``. Every value is escaped."""

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from robust_instant_policy.datasets.images import encode_image
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.perception import KeypointExtractor
from robust_instant_policy.policies import Context, LocatedScene, Plan

BLUE, RED, GREEN, ORANGE, GREY = "#2e6f95", "#b3262e", "#2a7d3f", "#b35c00", "#5b6470"
GOOD, FAIR = 0.9, 0.5  # confidence from which a plan is shown in green, and in orange
MARGIN, LEAST_SHARE = 1.4, 0.3  # of the image that is shown: times the box of the keypoints, and at least
JPEG_QUALITY = 88
KEYPOINT_PX = 5  # radius of a mark, where the picture is 256 pixels wide
OBJECT_COLOURS = ("#e6194b", "#ffe119", "#4363d8", "#3cb44b", "#f58231", "#911eb4", "#42d4f4", "#f032e6")

Colour = tuple[int, int, int]

_ENVIRONMENT = Environment(
    loader=PackageLoader(__package__), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
)


def _html(macro: str, *values: Any) -> str:
    """A plain string: viser sends no other kind."""
    return str(getattr(_ENVIRONMENT.get_template("panel.html").module, macro)(*values))


def box(colour: str, text: str, name: str = "") -> str:
    """HTML of ``text`` on ``colour``; ``name`` is the element's id."""
    return _html("box", colour, text, name)


def line(text: str) -> str:
    """HTML of a line of ``text``."""
    return _html("line", text)


def legend(*entries: tuple[str, Colour, str]) -> str:
    """HTML that explains colours: a name, its colour, and what more is to be said, for each of ``entries``."""
    return _html("legend", entries)


def prompt(text: str) -> str:
    """HTML of the ``text`` that the language model is given."""
    return _html("prompt", text)


def script(text: str) -> str:
    """HTML that runs the JavaScript ``text``."""
    return _html("script", text)


def comparison(rows: Sequence[tuple[str, Colour, str]]) -> str:
    """HTML of a table with a method, its colour and its outcome in each of ``rows``."""
    return _html("comparison", rows)


def trust(plan: Plan, available: int, complete: bool) -> str:
    """HTML of the confidence of a plan and its reasons; ``available`` candidates are there.

    The confidence is told where they are ``complete``: that of some of them says little.
    """
    ignored = [f"{index + 1} from step {plan.onset[index]}" for index in np.flatnonzero(plan.hallucinated)]
    words = f"{len(plan.candidates)} of {available} candidates"
    words += f", hallucinated: {', '.join(ignored)}" if ignored else ", none hallucinated"
    if not complete:
        return box(GREY, f"{words}; more follow, then the confidence")
    confidence = plan.confidence or 0.0
    colour = GREEN if confidence >= GOOD else ORANGE if confidence >= FAIR else RED
    return _html("trust", colour, f"Confidence {confidence:.2f}: {words}", plan.evidence, plan.notes)


def keypoint_picture(rgb: np.ndarray, context: Context | None = None, scene: LocatedScene | None = None) -> str:
    """HTML of the start image, with the keypoints of ``scene``; the pointer on one tells what is known of it."""
    height, width = rgb.shape[:2]
    data = base64.b64encode(encode_image(rgb, "jpeg", quality=JPEG_QUALITY)).decode()
    part, marks = np.array([0.0, 0.0, width, height]), []
    if context is not None and scene is not None:
        pixels = scene.located.pixels + 0.5
        part = _around(pixels, width, height)
        scale = part[2] / 256
        for index, pixel in enumerate(pixels):
            told, colour = _known(context, scene, index)
            marks.append((pixel, KEYPOINT_PX * scale, scale, colour, told))
    return _html("keypoint_picture", data, width, height, part.round(1), marks)


def _around(pixels: FloatArray, width: int, height: int) -> FloatArray:
    """Left, top, width and height ``(4,)`` of the part of an image around ``pixels (K, 2)``, in its proportions."""
    size, low, high = np.array([width, height]), pixels.min(axis=0), pixels.max(axis=0)
    shown = size * np.clip(MARGIN * ((high - low) / size).max(), LEAST_SHARE, 1.0)
    return np.concatenate([((low + high - shown) / 2).clip(0, size - shown), shown])


def _known(context: Context, scene: LocatedScene, index: int) -> tuple[str, str]:
    """What is known of a keypoint, and its colour: its object, how sure it is here, and in the demonstrations."""
    sure = f"confidence here {scene.located.confidence[index]:.2f}"
    if not isinstance(context.extractor, KeypointExtractor):
        return f"keypoint {index}: {sure}", OBJECT_COLOURS[0]
    thing = int(context.extractor.object_of_[index])
    shown = ", ".join(f"{value:.2f}" for value in context.extractor.confidence_[:, index])
    told = f"keypoint {index} on object {thing}: {sure}, in the demonstrations {shown}"
    return told, OBJECT_COLOURS[thing % len(OBJECT_COLOURS)]
