"""The self-contained page about one run: what was seen, what was proposed, what was kept, what happened."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from PIL import Image
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.geometry import FloatArray, GripperTriangle, project
from robust_instant_policy.policies.policy import Plan, Stage
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX, Trajectory

MM = 1000.0
SHOWN_DEMONSTRATIONS = 10
MOSTLY = 0.5  # mean weight below which a hallucinated candidate was ignored more than followed
AXIS_STEPS = 6  # gripper axes drawn along the robust trajectory
AXIS_LENGTH_M = 0.03
WEIGHT_COLOURS = "Viridis"
ROBUST_COLOUR = "#111111"
HALLUCINATED_COLOUR = "#d1495b"
CANDIDATE_COLOURS = (
    "#2e86ab",
    "#3fa34d",
    "#a06cd5",
    "#e09f3e",
    "#17817b",
    "#7d4f50",
    "#5c6f91",
    "#b56576",
    "#6b8f71",
    "#8d99ae",
)
KEYPOINT_COLOURS = (
    "#e6194b",
    "#3cb44b",
    "#ffe119",
    "#4363d8",
    "#f58231",
    "#911eb4",
    "#42d4f4",
    "#f032e6",
    "#bfef45",
    "#fabed4",
)
RUN_FILE, PLAN_FILE, SEEN_FILE, CONTEXT_FILE, VIDEO_FILE = (
    "run.json",
    "plan.json",
    "observation.npz",
    "context.npz",
    "execution.mp4",
)
DIMENSIONS = tuple(f"{point} {axis}" for point in ("palm", "fingertip 1", "fingertip 2") for axis in "xyz")


@dataclass(frozen=True)
class RunRecord:
    """What is known of a run beside the plan: the words and numbers of the report's head and last table.

    ``success`` is None where the plan was not executed.
    """

    task: str
    description: str
    seed: int
    llm: str
    method: str
    success: bool | None
    outcome: str
    stages: tuple[Stage, ...]

    def save(self, folder: Path) -> None:
        (folder / RUN_FILE).write_text(json.dumps(asdict(self), indent=1) + "\n")

    @classmethod
    def load(cls, folder: Path) -> RunRecord:
        try:
            content = json.loads((folder / RUN_FILE).read_text())
            return cls(**{**content, "stages": tuple(Stage(**stage) for stage in content["stages"])})
        except FileNotFoundError:
            raise DatasetError(f"{folder} holds no run ({RUN_FILE} is missing); make one with: rip demo") from None
        except (TypeError, ValueError, KeyError) as error:
            raise DatasetError(f"{folder / RUN_FILE} is damaged: {error}") from None


def save_context(folder: Path, images: Sequence[NDArray[np.uint8]], pixels: FloatArray) -> None:
    """Keep the demonstrations' start images and their keypoints' ``pixels (I, K, 2)`` beside the plan."""
    arrays = {f"rgb_{index}": image for index, image in enumerate(images)}
    np.savez_compressed(folder / CONTEXT_FILE, pixels=pixels, **arrays)  # type: ignore[arg-type]


def write_report(folder: str | Path) -> Path:
    """Write ``report.html`` from the other files of a run folder and return its path."""
    folder = Path(folder)
    record = RunRecord.load(folder)
    plan = Plan.load(folder / PLAN_FILE)
    observation = Observation.load(folder / SEEN_FILE)
    with np.load(folder / CONTEXT_FILE, allow_pickle=False) as context:
        pixels = context["pixels"]
        images = [context[f"rgb_{index}"] for index in range(len(pixels))]
    page = _PAGE.format(
        title=html.escape(f"{record.task}: {record.outcome}"),
        style=_STYLE,
        plotly=get_plotlyjs(),
        head=_head(record, plan),
        video=_video(folder / VIDEO_FILE),
        proposals=_proposals_over_scene(observation, plan),
        seen=_seen(observation.rgb, plan, images, pixels),
        paths=_html(_paths_in_space(plan)),
        dimensions=_html(_dimensions_over_time(plan)),
        verdicts=_verdicts(plan),
        stages=_stages(record.stages),
        notes=_notes(plan),
    )
    path = folder / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def _head(record: RunRecord, plan: Plan) -> str:
    state = {True: "good", False: "bad", None: "open"}[record.success]
    ignored = int(plan.hallucinated.sum())
    kept = f"{len(plan.candidates)} trajectories were proposed" + (
        f", {ignored} {'was' if ignored == 1 else 'were'} judged hallucinated." if plan.confidence is not None else "."
    )
    confidence = "" if plan.confidence is None else f" Confidence of the agreement: {plan.confidence:.2f} of 1."
    return (
        f'<h1>{html.escape(record.task)}</h1><p class="outcome {state}">{html.escape(record.outcome)}</p>'
        f"<p>The task: {html.escape(record.description)}. The robot was shown it a few times and never trained. "
        f"A language model ({html.escape(record.llm)}) read those demonstrations as numbers and "
        f"proposed what to do in a "
        f"scene it had not seen (number {record.seed}). {kept}{confidence}</p>"
    )


def _video(path: Path) -> str:
    if not path.exists():
        return ""
    data = base64.b64encode(path.read_bytes()).decode()
    return (
        "<video controls autoplay muted loop playsinline "
        f'src="data:video/mp4;base64,{data}"></video><p class="caption">The execution of the robust trajectory.</p>'
    )


def _numbered(
    image: NDArray[np.uint8], pixels: FloatArray, confidence: FloatArray | None, caption: str, kind: str
) -> str:
    height, width = image.shape[:2]
    radius = 0.022 * width
    marks = []
    for index, (u, v) in enumerate(pixels):
        colour = KEYPOINT_COLOURS[index % len(KEYPOINT_COLOURS)]
        tip = f"keypoint {index + 1}" + ("" if confidence is None else f", confidence {confidence[index]:.2f}")
        marks.append(
            f'<g><title>{tip}</title><circle cx="{u + 0.5:.1f}" cy="{v + 0.5:.1f}" r="{radius:.1f}" fill="{colour}" '
            f'fill-opacity="0.75" stroke="#000" stroke-width="{radius / 6:.2f}"/>'
            f'<text x="{u + 0.5:.1f}" y="{v + 0.5:.1f}" font-size="{1.35 * radius:.1f}">{index + 1}</text></g>'
        )
    return (
        f'<figure class="{kind}"><svg viewBox="0 0 {width} {height}">'
        f"{_image(image)}{''.join(marks)}</svg><figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def _proposals_over_scene(observation: Observation, plan: Plan) -> str:
    """The scene with the ways of the fingertips drawn over it, hallucinated proposals dotted red."""
    height, width = observation.rgb.shape[:2]

    def line(trajectory: Trajectory, colour: str, stroke: float, dash: str, name: str) -> str:
        parts = []
        for arm in range(trajectory.num_arms):
            tips = trajectory.triplets[:, arm, 1:].mean(axis=1)
            pixels = project(tips, observation.intrinsics, observation.camera_pose)
            points = " ".join(f"{u + 0.5:.1f},{v + 0.5:.1f}" for u, v in pixels)
            parts.append(
                f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="{stroke}" '
                f'stroke-dasharray="{dash}" stroke-linejoin="round"><title>{name}</title></polyline>'
            )
        return "".join(parts)

    unit = width / 256
    lines = [
        line(plan.trajectory, "#fff", 4.2 * unit, "", ""),
        line(plan.trajectory, ROBUST_COLOUR, 2.6 * unit, "", "robust"),
    ]
    for index, candidate in enumerate(plan.candidates):
        bad = bool(plan.hallucinated[index])
        colour = HALLUCINATED_COLOUR if bad else CANDIDATE_COLOURS[index % len(CANDIDATE_COLOURS)]
        lines.append(line(candidate, colour, 1.1 * unit, f"{2 * unit}" if bad else "", _candidate_name(plan, index)))
    return (
        f'<figure class="new"><svg viewBox="0 0 {width} {height}">{_image(observation.rgb)}{"".join(lines)}</svg>'
        "<figcaption>the proposals and, black, the robust trajectory over the new scene</figcaption></figure>"
    )


def _image(image: NDArray[np.uint8]) -> str:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    data = base64.b64encode(buffer.getvalue()).decode()
    return f'<image href="data:image/png;base64,{data}" width="{image.shape[1]}" height="{image.shape[0]}"/>'


def _seen(rgb: NDArray[np.uint8], plan: Plan, images: Sequence[NDArray[np.uint8]], pixels: FloatArray) -> str:
    new = _numbered(rgb, plan.pixels, plan.keypoint_confidence, "the new scene", "new")
    shown = "".join(
        _numbered(image, marks, None, f"demonstration {index + 1}", "shown")
        for index, (image, marks) in enumerate(zip(images[:SHOWN_DEMONSTRATIONS], pixels, strict=False))
    )
    return f'<div class="seen">{new}<div class="demos">{shown}</div></div>'


def _candidate_name(plan: Plan, index: int) -> str:
    return f"candidate {index + 1}" + (" (hallucinated)" if plan.hallucinated[index] else "")


def _paths_in_space(plan: Plan) -> go.Figure:
    """Palm paths in the world, candidates coloured by weight, with the gripper's axes along the robust one."""
    figure = go.Figure()
    arms = range(plan.trajectory.num_arms)
    for index, candidate in enumerate(plan.candidates):
        weight = np.interp(candidate.times, plan.trajectory.times, plan.weights[index])
        for arm in arms:
            x, y, z = (candidate.triplets[:, arm, 1:].mean(axis=1) * MM).T
            figure.add_scatter3d(
                x=x,
                y=y,
                z=z,
                mode="lines+markers",
                name=_candidate_name(plan, index),
                legendgroup=str(index),
                showlegend=arm == 0,
                line={"color": weight, "colorscale": WEIGHT_COLOURS, "cmin": 0, "cmax": 1, "width": 4},
                marker={
                    "color": weight,
                    "colorscale": WEIGHT_COLOURS,
                    "cmin": 0,
                    "cmax": 1,
                    "size": 3,
                    "symbol": "x" if plan.hallucinated[index] else "circle",
                    "showscale": index == 0 and arm == 0,
                    "colorbar": {"title": "weight", "thickness": 14, "len": 0.6},
                },
                customdata=np.stack([weight, np.arange(len(candidate))], axis=1),
                hovertemplate="step %{customdata[1]:.0f}, weight %{customdata[0]:.2f}<extra>%{fullData.name}</extra>",
            )
    for arm in arms:
        triplets = plan.trajectory.triplets[:, arm]
        x, y, z = (triplets[:, 1:].mean(axis=1) * MM).T
        figure.add_scatter3d(
            x=x,
            y=y,
            z=z,
            mode="lines+markers",
            name="robust trajectory",
            legendgroup="robust",
            showlegend=arm == 0,
            line={"color": ROBUST_COLOUR, "width": 9},
            marker={"color": ROBUST_COLOUR, "size": 3},
        )
        poses = GripperTriangle.from_triplets(triplets).poses(triplets)
        for step in np.unique(np.linspace(0, len(poses) - 1, AXIS_STEPS).astype(int)):
            origin, rotation = poses[step, :3, 3], poses[step, :3, :3]
            for axis, (colour, name) in enumerate(
                (("#d62728", "gripper x"), ("#2ca02c", "gripper y (opening)"), ("#1f77b4", "gripper z (approach)"))
            ):
                ends = np.stack([origin, origin + AXIS_LENGTH_M * rotation[:, axis]]) * MM
                figure.add_scatter3d(
                    x=ends[:, 0],
                    y=ends[:, 1],
                    z=ends[:, 2],
                    mode="lines",
                    line={"color": colour, "width": 5},
                    name=name,
                    legendgroup=name,
                    showlegend=bool(step == 0 and arm == 0),
                    hoverinfo="name",
                )
    x, y, z = (plan.keypoints * MM).T
    figure.add_scatter3d(
        x=x,
        y=y,
        z=z,
        mode="markers+text",
        name="keypoints",
        text=[str(k + 1) for k in range(len(x))],
        marker={"size": 5, "color": [KEYPOINT_COLOURS[k % len(KEYPOINT_COLOURS)] for k in range(len(x))]},
    )
    figure.update_layout(
        height=620,
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
        legend={"x": 0, "y": 1},
        scene={
            "aspectmode": "data",
            "xaxis_title": "world x [mm]",
            "yaxis_title": "world y [mm]",
            "zaxis_title": "world z [mm]",
        },
    )
    return figure


def _dimensions_over_time(plan: Plan) -> go.Figure:
    """Every action dimension over normalised time: candidates, robust mean, and the scale band."""
    arms = plan.trajectory.num_arms
    names = [
        (f"arm {arm + 1} " if arms > 1 else "") + name
        for arm in range(arms)
        for name in (*(f"{d}, world [mm]" for d in DIMENSIONS), "gripper state (0 open, 1 closed)")
    ]
    columns = 3
    rows = -(-len(names) // columns)
    figure = make_subplots(
        rows=rows, cols=columns, subplot_titles=names, vertical_spacing=0.28 / rows, horizontal_spacing=0.06
    )
    times = plan.trajectory.times
    for dimension in range(len(names)):
        unit = 1.0 if dimension % ACTION_DIM == STATE_INDEX else MM
        place = {"row": dimension // columns + 1, "col": dimension % columns + 1}
        first = dimension == 0
        mean, scale = plan.trajectory.actions[:, dimension] * unit, plan.scale[:, dimension] * unit
        if scale.any():
            figure.add_scatter(
                x=np.concatenate([times, times[::-1]]),
                y=np.concatenate([mean + scale, (mean - scale)[::-1]]),
                fill="toself",
                fillcolor="rgba(0,0,0,0.13)",
                line={"width": 0},
                hoverinfo="skip",
                name="robust mean ± scale",
                legendgroup="band",
                showlegend=first,
                **place,
            )
        for index, candidate in enumerate(plan.candidates):
            bad = bool(plan.hallucinated[index])
            figure.add_scatter(
                x=candidate.times,
                y=candidate.actions[:, dimension] * unit,
                mode="lines",
                line={
                    "color": HALLUCINATED_COLOUR if bad else CANDIDATE_COLOURS[index % len(CANDIDATE_COLOURS)],
                    "width": 1.6,
                    "dash": "dot" if bad else "solid",
                },
                name=_candidate_name(plan, index),
                legendgroup=str(index),
                showlegend=first,
                **place,
            )
        figure.add_scatter(
            x=times,
            y=mean,
            mode="lines",
            line={"color": ROBUST_COLOUR, "width": 2.6},
            name="robust mean",
            legendgroup="mean",
            showlegend=first,
            **place,
        )
        figure.update_xaxes(title_text="normalised time" if place["row"] == rows else None, **place)
    figure.update_layout(
        height=210 * rows + 60,
        margin={"l": 40, "r": 10, "t": 70, "b": 40},
        template="simple_white",
        legend={"orientation": "h", "y": 1 + 0.22 / rows, "yanchor": "bottom"},
    )
    figure.update_annotations(font_size=13)
    return figure


def _html(figure: go.Figure) -> str:
    return figure.to_html(include_plotlyjs=False, full_html=False, config={"displaylogo": False, "responsive": True})


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], classes: Sequence[str] | None = None) -> str:
    cells = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = "".join(
        f'<tr class="{(classes or [""] * len(rows))[index]}">'
        + "".join(f"<td>{html.escape(cell)}</td>" for cell in row)
        + "</tr>"
        for index, row in enumerate(rows)
    )
    return f"<table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table>"


def _verdicts(plan: Plan) -> str:
    if plan.confidence is None:
        return "<p>This method takes the first candidate at its word and judges none.</p>"
    rows = []
    for index, candidate in enumerate(plan.candidates):
        bad = bool(plan.hallucinated[index])
        start = int(plan.onset[index])
        verdict = "hallucinated" if plan.weights[index].mean() < MOSTLY else "hallucinated in part"
        rows.append(
            (
                str(index + 1),
                verdict if bad else "agrees",
                f"step {start} of {len(plan.trajectory)} (time {plan.trajectory.times[start]:.2f})"
                if bad and start >= 0
                else "–",
                f"{plan.scores[index]:.2f}",
                f"{plan.weights[index].mean():.2f}",
                f"{len(candidate)}",
            )
        )
    head = ("candidate", "verdict", "from", "score", "mean weight", "steps")
    return _table(head, rows, ["bad" if bad else "" for bad in plan.hallucinated])


def _stages(stages: Sequence[Stage]) -> str:
    def tokens(count: int) -> str:
        return f"{count:,}" if count else "–"

    rows = [
        (
            s.name,
            f"{s.seconds:.3f}" if s.seconds < 1 else f"{s.seconds:.1f}",
            tokens(s.prompt_tokens),
            tokens(s.cached_tokens),
            tokens(s.completion_tokens),
        )
        for s in stages
    ]
    rows.append(
        (
            "total",
            f"{sum(s.seconds for s in stages):.1f}",
            tokens(sum(s.prompt_tokens for s in stages)),
            tokens(sum(s.cached_tokens for s in stages)),
            tokens(sum(s.completion_tokens for s in stages)),
        )
    )
    return _table(
        ("stage", "seconds", "tokens given", "of these read before", "tokens written"),
        rows,
        [""] * len(stages) + ["total"],
    )


def _notes(plan: Plan) -> str:
    if not plan.notes:
        return ""
    return "<h2>Remarks</h2><ul>" + "".join(f"<li>{html.escape(note)}</li>" for note in plan.notes) + "</ul>"


_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;color:#1b1b1b;background:#fafaf8;margin:0}
main{max-width:1120px;margin:0 auto;padding:24px}
h1{margin:0 0 4px;font-size:30px}h2{margin:40px 0 6px;font-size:21px}
p{max-width:80ch}.caption,figcaption{color:#666;font-size:14px}
.outcome{font-weight:600;font-size:19px;padding:8px 14px;border-radius:6px;display:inline-block;margin:6px 0}
.outcome.good{background:#d8f0dc;color:#14532d}.outcome.bad{background:#f8dcdc;color:#7f1d1d}
.outcome.open{background:#e6e6e6}
video{width:100%;max-width:640px;border-radius:6px;background:#000}
.top{display:grid;grid-template-columns:minmax(300px,4fr) 3fr;gap:18px;align-items:start}
.seen{display:grid;grid-template-columns:minmax(280px,2fr) 3fr;gap:18px}
.demos{display:grid;grid-template-columns:repeat(auto-fill,minmax(115px,1fr));gap:8px;align-content:start}
figure{margin:0}figure svg{width:100%;border-radius:4px;display:block}
figure text{fill:#000;text-anchor:middle;dominant-baseline:central;font-family:sans-serif;font-weight:700}
.panel{background:#fff;border:1px solid #e4e4e0;border-radius:6px;padding:8px}
table{border-collapse:collapse;background:#fff;font-variant-numeric:tabular-nums}
th,td{padding:6px 14px;border-bottom:1px solid #e4e4e0;text-align:right}th:first-child,td:first-child{text-align:left}
th{font-size:14px;color:#555}
tr.bad td{color:#a11d33;font-weight:600}tr.total td{font-weight:600;border-top:2px solid #999}
@media(max-width:760px){.seen,.top{grid-template-columns:1fr}}
"""

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">
<title>{title}</title><style>{style}</style><script>{plotly}</script></head><body><main>
{head}
<div class="top"><div>{video}</div>{proposals}</div>
<h2>What the robot saw</h2>
<p>The camera looks down on the table. The same numbered point marks the same place on the object in every image:
left the new scene, right the demonstrations. With the depth of each pixel these become points in space, and those
are all that the language model learns about a scene.</p>
{seen}
<h2>What the model proposed, and what was kept</h2>
<p>Each line is the way of the gripper's fingertips in one proposal, coloured by how much it counted: bright lines
agree with the others, dark ones were ignored. The black line is the trajectory the robot followed; the short
red, green and blue strokes are the gripper's own axes along it. Drag to turn, scroll to zoom.</p>
<div class="panel">{paths}</div>
<h2>Every dimension over time</h2>
<p>An action is three points of the gripper (its palm and its two open fingertips) in the world, and whether it is
closed. The black line is the robust mean, the grey band its scale; dotted red lines belong to hallucinated
proposals.</p>
<div class="panel">{dimensions}</div>
<h2>Which proposals were hallucinated</h2>
<p>A proposal that leaves the agreement is ignored from there on for as long as it stays away; what it says elsewhere
still counts. The score adds up how far a proposal strays from the robust mean, in scales of what the others show.</p>
{verdicts}
<h2>Where the time went</h2>
{stages}
{notes}
</main></body></html>
"""
