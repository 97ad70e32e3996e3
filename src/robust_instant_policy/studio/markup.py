"""HTML that the page shows."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence

import numpy as np
from PIL import Image

from robust_instant_policy.perception import KeypointExtractor
from robust_instant_policy.policies import Context, LocatedScene, Plan

BLUE, RED, GREEN, ORANGE, GREY = "#2e6f95", "#b3262e", "#2a7d3f", "#b35c00", "#5b6470"
GOOD, FAIR = 0.9, 0.5  # confidence from which a plan is shown in green, and in orange
PICTURE_HEIGHT = "15em"
KEYPOINT_COLOURS = ("#e6194b", "#3cb44b", "#ffe119", "#4363d8", "#f58231", "#911eb4", "#42d4f4", "#f032e6")


def box(colour: str, text: str, name: str = "") -> str:
    """HTML of ``text`` on ``colour``; ``name`` is the element's id."""
    return (
        f'<div id="{name}" style="background:{colour};color:#fff;font-size:1.02em;line-height:1.35;padding:0.6em 0.8em;'
        f'margin:0.3em 0.5em;border-radius:6px">{html.escape(text)}</div>'
    )


def line(text: str) -> str:
    """HTML of a line of ``text``."""
    return f'<div style="padding:0 0.8em">{html.escape(text)}</div>'


def prompt(text: str) -> str:
    """HTML of the ``text`` that the language model is given."""
    return f'<pre style="max-height:20em;overflow:auto;font-size:0.75em;padding:0 0.8em">{html.escape(text)}</pre>'


def comparison(rows: Sequence[tuple[str, tuple[int, int, int], str]]) -> str:
    """HTML of a table with a method, its colour and its outcome in each of ``rows``."""
    cells = (
        f'<tr><td style="color:rgb{colour};font-weight:bold;padding-right:1em">{html.escape(method)}</td>'
        f"<td>{html.escape(outcome)}</td></tr>"
        for method, colour, outcome in rows
    )
    return f'<table style="margin:0.5em 0.8em">{"".join(cells)}</table>'


def trust(plan: Plan, available: int) -> str:
    """HTML of the confidence of a plan and its reasons; ``available`` candidates are there."""
    ignored = [f"{index + 1} from step {plan.onset[index]}" for index in np.flatnonzero(plan.hallucinated)]
    confidence = plan.confidence or 0.0
    colour = GREEN if confidence >= GOOD else ORANGE if confidence >= FAIR else RED
    words = f"Confidence {confidence:.2f}: {len(plan.candidates)} of {available} candidates"
    words += f", hallucinated: {', '.join(ignored)}" if ignored else ", none hallucinated"
    evidence = "".join(
        f"<tr><td style='padding-right:1em'>{html.escape(name)}</td><td>{value:.3g}</td></tr>"
        for name, value in plan.evidence.items()
    )
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in plan.notes)
    return (
        f"{box(colour, words)}<details style='padding:0 0.8em'><summary>Reasons</summary>"
        f"<table>{evidence}</table><ul style='padding-left:1.2em'>{notes}</ul></details>"
    )


def keypoint_picture(rgb: np.ndarray, context: Context | None = None, scene: LocatedScene | None = None) -> str:
    """HTML of the start image, with the keypoints of ``scene``; the pointer on one tells what is known of it."""
    height, width = rgb.shape[:2]
    with io.BytesIO() as buffer:
        Image.fromarray(rgb).save(buffer, "JPEG", quality=88)
        data = base64.b64encode(buffer.getvalue()).decode()
    marks = []
    if context is not None and scene is not None:
        size = width / 256
        for index, (u, v) in enumerate(scene.located.pixels + 0.5):
            told = html.escape(_known(context, scene, index))
            colour = KEYPOINT_COLOURS[index % len(KEYPOINT_COLOURS)]
            marks.append(
                f'<g class="keypoint"><title>{told}</title><circle cx="{u:.1f}" cy="{v:.1f}" r="{5 * size:.1f}" '
                f'fill="{colour}" stroke="#000" stroke-width="{size:.1f}"/><text x="{u:.1f}" y="{v + 2.4 * size:.1f}" '
                f'font-size="{7 * size:.1f}" text-anchor="middle">{index}</text></g>'
            )
    return (
        f'<svg viewBox="0 0 {width} {height}" style="width:100%;max-height:{PICTURE_HEIGHT};border-radius:6px">'
        f'<image href="data:image/jpeg;base64,{data}" width="{width}" height="{height}"/>{"".join(marks)}</svg>'
    )


def _known(context: Context, scene: LocatedScene, index: int) -> str:
    """What is known of a keypoint: its object, how sure it is here, and in the demonstrations."""
    sure = f"here {scene.located.confidence[index]:.2f}"
    if not isinstance(context.extractor, KeypointExtractor):
        return f"keypoint {index}: confidence {sure}"
    shown = ", ".join(f"{value:.2f}" for value in context.extractor.confidence_[:, index])
    return (
        f"keypoint {index} on object {context.extractor.object_of_[index]}: confidence {sure}; demonstrations {shown}"
    )
