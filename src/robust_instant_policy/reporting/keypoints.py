"""A self-contained page that shows where the keypoints are: demonstrations side by side, new scenes below."""

from __future__ import annotations

import base64
import colorsys
import html
import io
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, project
from robust_instant_policy.perception.accuracy import Accuracy
from robust_instant_policy.perception.keypoints import KeypointExtractor

IMAGE_PX = 300  # shown width of an image
JPEG_QUALITY = 85
STYLE = """
body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1300px;padding:0 1rem;color:#222}
.row{display:flex;flex-wrap:wrap;gap:12px} figure{margin:0} figcaption{font-size:12px;color:#555;max-width:300px}
svg{display:block;border-radius:4px} text{font:bold 11px system-ui;paint-order:stroke;stroke:#000;stroke-width:2.5px}
table{border-collapse:collapse;font-size:13px} td,th{padding:2px 10px;border-bottom:1px solid #ddd;text-align:right}
"""


def keypoints_page(
    extractor: KeypointExtractor,
    demonstrations: Sequence[Observation],
    scenes: Sequence[Observation] = (),
    accuracy: Accuracy | None = None,
    title: str = "Keypoints",
) -> str:
    """HTML of a fitted ``extractor``: its ``demonstrations``, numbered and coloured keypoints in each, and new
    ``scenes`` with what it locates there (hollow circles: the truth, where ``accuracy`` knows it).
    """
    count = len(extractor.pixels_[0])
    colours = [_colour(k, count) for k in range(count)]
    body = [f"<h1>{html.escape(title)}</h1>", "<ul>"]
    body += [f"<li>{html.escape(note)}</li>" for note in extractor.notes_]
    if accuracy is not None:
        body.append(f"<li><b>{html.escape(accuracy.summary())}</b></li>")
    body += ["</ul>", "<h2>Demonstrations</h2>", '<div class="row">']
    for i, (observation, pixels) in enumerate(zip(demonstrations, extractor.pixels_, strict=True)):
        body.append(_figure(observation.rgb, pixels, colours, f"demonstration {i}"))
    body.append("</div>")
    if scenes:
        body += ["<h2>New scenes</h2>", '<div class="row">']
    for i, observation in enumerate(scenes):
        located = accuracy.located[i] if accuracy is not None else extractor.locate(observation)
        caption = f"scene {i}: confidence {located.confidence.min():.2f} to {located.confidence.max():.2f}"
        true_pixels = None
        if accuracy is not None:
            true_pixels = project(accuracy.truth[i], observation.intrinsics, observation.camera_pose)
            if np.isfinite(accuracy.errors[i]).any():
                caption += f", median error {np.nanmedian(accuracy.errors[i]) * 1e3:.1f} mm"
        caption += "".join(f"; {note}" for note in located.notes)
        body.append(_figure(observation.rgb, located.pixels, colours, caption, true_pixels))
    if scenes:
        body.append("</div>")
    if accuracy is not None:
        body.append(_table(accuracy, colours))
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{STYLE}</style>{''.join(body)}</html>\n"
    )


def _colour(index: int, count: int) -> str:
    red, green, blue = colorsys.hsv_to_rgb(index / count, 0.75, 1.0)
    return f"#{round(red * 255):02x}{round(green * 255):02x}{round(blue * 255):02x}"


def _figure(
    rgb: NDArray[np.uint8], pixels: FloatArray, colours: list[str], caption: str, truth: FloatArray | None = None
) -> str:
    height, width = rgb.shape[:2]
    scale = IMAGE_PX / width
    shown = Image.fromarray(rgb).resize((IMAGE_PX, round(height * scale)), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    shown.save(stream, "JPEG", quality=JPEG_QUALITY)
    marks = []
    if truth is not None:
        for (u, v), colour in zip((truth + 0.5) * scale, colours, strict=True):
            if np.isfinite(u + v):
                marks.append(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="6" fill="none" stroke="{colour}"/>')
    for k, ((u, v), colour) in enumerate(zip((pixels + 0.5) * scale, colours, strict=True)):
        marks.append(
            f'<circle cx="{u:.1f}" cy="{v:.1f}" r="3" fill="{colour}" stroke="#000"/>'
            f'<text x="{u + 4:.1f}" y="{v - 4:.1f}" fill="{colour}">{k}</text>'
        )
    data = base64.b64encode(stream.getvalue()).decode()
    photograph = f'<image href="data:image/jpeg;base64,{data}" width="{shown.width}" height="{shown.height}"/>'
    return (
        f'<figure><svg width="{shown.width}" height="{shown.height}">{photograph}{"".join(marks)}</svg>'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def _table(accuracy: Accuracy, colours: list[str]) -> str:
    rows = ["<h2>Error of each keypoint</h2><table><tr><th></th><th>part</th><th>median mm</th><th>90% mm</th></tr>"]
    for k, part in enumerate(accuracy.part_of):
        errors = accuracy.errors[:, k] * 1e3
        figures = (
            f"<td>{np.nanmedian(errors):.1f}</td><td>{np.nanpercentile(errors, 90):.1f}</td>"
            if part
            else "<td></td>" * 2
        )
        name = html.escape(part or "background")
        rows.append(f'<tr><td style="background:{colours[k]}">{k}</td><td>{name}</td>{figures}</tr>')
    return "".join(rows) + "</table>"
