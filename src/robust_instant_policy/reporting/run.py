"""The self-contained page about one run: image, candidates, robust trajectory and execution."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from plotly.offline import get_plotlyjs

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.files import load_arrays, npz, parse_json, read_regular, write_whole
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies.policy import Plan, Stage
from robust_instant_policy.reporting.charts import (
    AXIS_COLOURS,
    MM,
    ROBUST_COLOUR,
    candidate_colour,
    candidate_name,
    chart,
    dimensions_over_time,
    executed_paths,
    paths_in_space,
    swept_space,
    weights_over_time,
)
from robust_instant_policy.reporting.pages import data_uri, render
from robust_instant_policy.reporting.pictures import REFERENCE_WIDTH, Line, Picture, keypoint_marks, picture, svg_points
from robust_instant_policy.reporting.tables import NONE, Table
from robust_instant_policy.robots.path import MeasuredPath, Sweep
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX, Trajectory

SHOWN_DEMONSTRATIONS = 10
FRAME_AXIS_M = 0.04  # length of the axes of a frame in the picture
MOSTLY = 0.5  # mean weight below which a hallucinated candidate was ignored more than followed
RUN_FILE, PLAN_FILE, SEEN_FILE, CONTEXT_FILE, VIDEO_FILE, SWEEP_FILE, MEASURED_FILE, REPORT_FILE = (
    "run.json",
    "plan.json",
    "observation.npz",
    "context.npz",
    "execution.mp4",
    "sweep.npz",  # of a run on real arms
    "measured.npz",
    "report.html",
)


@dataclass(frozen=True)
class RunRecord:
    """The facts of a run that are not in the plan.

    ``seed`` is None for a scene in the real world; ``success`` is None if the plan was not executed; ``config`` is
    `Variant.config`, empty for runs of versions that did not note it.
    """

    task: str
    description: str
    seed: int | None
    llm: str
    method: str
    success: bool | None
    outcome: str
    stages: tuple[Stage, ...]
    config: str = ""

    def save(self, folder: Path) -> None:
        write_whole(folder / RUN_FILE, (json.dumps(asdict(self), indent=1) + "\n").encode())

    @classmethod
    def load(cls, folder: Path) -> RunRecord:
        """Raises `DatasetError` if ``folder`` holds no run, or a damaged one."""
        try:
            content = parse_json(read_regular(folder / RUN_FILE))
            record = cls(**{**content, "stages": tuple(Stage(**stage) for stage in content["stages"])})
            _stage_table(record.stages)
            return record
        except FileNotFoundError:
            raise DatasetError(f"{folder} holds no run ({RUN_FILE} is missing); make one with: rip demo") from None
        except (TypeError, ValueError, KeyError) as error:
            raise DatasetError(f"{folder / RUN_FILE} is damaged: {error}") from None


def save_context(folder: Path, images: Sequence[NDArray[np.uint8]], pixels: FloatArray) -> None:
    """Store the demonstrations' start images and their keypoints' ``pixels (I, K, 2)`` beside the plan."""
    arrays = {f"rgb_{index}": image for index, image in enumerate(images)}
    write_whole(folder / CONTEXT_FILE, npz({"pixels": pixels, **arrays}))


def write_report(folder: str | Path) -> Path:
    """Write ``report.html`` from the other files of a run folder and return its path.

    Raises `DatasetError` where one of them is missing or damaged.
    """
    folder = Path(folder)
    record = RunRecord.load(folder)
    plan = Plan.load(folder / PLAN_FILE)
    observation = Observation.load(folder / SEEN_FILE)
    shown = _load_context(folder / CONTEXT_FILE)
    video = folder / VIDEO_FILE
    measured = MeasuredPath.load(folder / MEASURED_FILE) if (folder / MEASURED_FILE).exists() else None
    sweep = Sweep.load(folder / SWEEP_FILE) if (folder / SWEEP_FILE).exists() else None
    page = render(
        "run.html",
        title=f"{record.task}: {record.outcome}",
        plotly=Markup(get_plotlyjs()),
        record=record,
        shown_count=len(shown),
        facts=_facts(record, plan),
        video=data_uri(read_regular(video), "video/mp4") if video.exists() else "",
        overlay=_candidates_over_scene(observation, plan),
        seen=picture(observation.rgb, "new scene", marks=keypoint_marks(plan.pixels, plan.keypoint_confidence)),
        shown=shown[:SHOWN_DEMONSTRATIONS],
        keypoints=_keypoint_table(plan),
        framed=_frames_over_scene(observation, plan),
        frames=_frame_table(plan),
        paths=chart(paths_in_space(plan, observation)),
        judged=plan.confidence is not None,
        candidates=_candidate_table(plan),
        weights=chart(weights_over_time(plan)) if plan.candidates else "",
        dimensions=chart(dimensions_over_time(plan)),
        swept="" if sweep is None else chart(swept_space(sweep, observation)),
        executed=chart(executed_paths(plan, measured)) if measured is not None else "",
        execution=_execution_table(measured) if measured is not None else None,
        confidence=_confidence_table(plan),
        notes=plan.notes,
        stages=_stage_table(record.stages),
    )
    write_whole(folder / REPORT_FILE, page.encode())
    return folder / REPORT_FILE


def _load_context(path: Path) -> list[Picture]:
    """The demonstrations' start images with their keypoints."""
    advice = "run rip demo again"
    context = load_arrays(path, ("pixels",), advice)
    try:
        return [
            picture(context[f"rgb_{index}"], f"demonstration {index}", marks=keypoint_marks(pixels))
            for index, pixels in enumerate(context["pixels"])
        ]
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{path} is damaged ({error}); {advice}") from None


def _facts(record: RunRecord, plan: Plan) -> dict[str, str]:
    facts = {
        "confidence": NONE if plan.confidence is None else f"{plan.confidence:.2f}",
        "candidates": str(len(plan.candidates)),
        "of these hallucinated": NONE if plan.confidence is None else str(int(plan.hallucinated.sum())),
        "planning": f"{plan.usage.seconds:.1f} s",
        "tokens read and written": f"{plan.usage.tokens:,}",
    }
    return {"method": record.method, **facts}


def _candidates_over_scene(observation: Observation, plan: Plan) -> Picture:
    """The scene with the paths of the fingertips, hallucinated candidates dotted red."""
    unit = observation.rgb.shape[1] / REFERENCE_WIDTH

    def lines(trajectory: Trajectory, colour: str, width: float, dash: str = "", title: str = "") -> list[Line]:
        return [
            Line(svg_points(trajectory.tool_points[:, arm], observation), colour, width * unit, dash, title)
            for arm in range(trajectory.num_arms)
        ]

    drawn = lines(plan.trajectory, "#fff", 4.2) + lines(plan.trajectory, ROBUST_COLOUR, 2.6, title="robust trajectory")
    for index, candidate in enumerate(plan.candidates):
        dash = f"{2 * unit:.2f}" if plan.hallucinated[index] else ""
        drawn += lines(candidate, candidate_colour(plan, index), 1.1, dash, candidate_name(plan, index))
    return picture(observation.rgb, "new scene with the candidates and, black, the trajectory that was planned", drawn)


def _frames_over_scene(observation: Observation, plan: Plan) -> Picture:
    """The scene with the axes x, y, z of each frame, red, green and blue, where its last step is planned."""
    unit = observation.rgb.shape[1] / REFERENCE_WIDTH
    drawn = []
    for frame in plan.frames:
        for axis, colour in enumerate(AXIS_COLOURS):
            ends = frame.pose[:3, 3] + np.stack([np.zeros(3), FRAME_AXIS_M * frame.pose[:3, axis]])
            title = f"steps {frame.first} to {frame.last}: {frame.words}"
            drawn.append(Line(svg_points(ends, observation), colour, 2.2 * unit, "", title))
    return picture(observation.rgb, "new scene with the frames in which the plan was made", drawn)


def _frame_table(plan: Plan) -> Table:
    rows = [(f"{frame.arm + 1}", f"{frame.first} to {frame.last}", frame.words) for frame in plan.frames]
    return Table(("arm", "steps", "frame: origin, axes"), tuple(rows), "")


def _keypoint_table(plan: Plan) -> Table:
    rows = [
        (str(index), f"{confidence:.2f}", *(f"{MM * value:.0f}" for value in point))
        for index, (confidence, point) in enumerate(zip(plan.keypoint_confidence, plan.keypoints, strict=True))
    ]
    return Table(("keypoint", "confidence", "world x [mm]", "world y [mm]", "world z [mm]"), tuple(rows), "")


def _candidate_table(plan: Plan) -> Table:
    rows = []
    for index, candidate in enumerate(plan.candidates):
        weight, onset = plan.weights[index].mean(), int(plan.onset[index])
        verdict, start = "agrees", NONE
        if plan.hallucinated[index]:
            verdict = "**hallucinated**" if weight < MOSTLY else "**hallucinated in part**"
            # The onset counts the candidate's own steps, which may be more than the plan's.
            if 0 <= onset < len(candidate):
                start = f"step {onset} of {len(candidate)} (time {candidate.times[onset]:.2f})"
        rows.append((str(index + 1), verdict, start, f"{plan.scores[index]:.2f}", f"{weight:.2f}", f"{len(candidate)}"))
    return Table(("candidate", "verdict", "ignored from", "score", "mean weight", "steps"), tuple(rows), "")


EVIDENCE: dict[str, tuple[str, Callable[[float], str]]] = {
    "agreement": ("agreement of the candidates", lambda value: f"{value:.2f}"),
    "vote": ("how clear it is which way to act applies", lambda value: f"{value:.2f}"),
    "doubled": ("things with keypoints that a second thing looks like", lambda value: f"{value:.0f}"),
    "carried": ("whether frames carry the plan beyond what was demonstrated", lambda value: "yes" if value else "no"),
    "recognition": ("how far the scene was recognised, 1 is as in the demonstrations", lambda value: f"{value:.2f}"),
    "frames": ("error with which demonstrations predict a gripper change", lambda value: f"{MM * value:.0f} mm"),
    "prediction": ("error with which they predict a key step at best", lambda value: f"{MM * value:.0f} mm"),
    "distortion": ("change of distances between keypoints, about 1 is usual", lambda value: f"{value:.1f}"),
    "novelty": ("distance of the scene from the demonstrations, above 1 it lies outside", lambda value: f"{value:.1f}"),
    "displacement": ("displacement against what is around the gripper", lambda value: f"{MM * value:.0f} mm"),
    "precision": ("displacement of demonstrations against each other", lambda value: f"{MM * value:.0f} mm"),
    "doubts": ("doubts whether states, grasps and rotations were recorded rightly", lambda value: f"{value:.0f}"),
    "errors": ("errors of the checks", lambda value: f"{value:.0f}"),
}  # see `policies.confidence.Evidence`


def _confidence_table(plan: Plan) -> Table:
    """The confidence and what it depends on."""
    lengths = np.arange(plan.scale.shape[1]) % ACTION_DIM != STATE_INDEX
    scale = MM * plan.scale[:, lengths]
    rows = [
        ("candidates that agree", f"{int((~plan.hallucinated).sum())} of {len(plan.candidates)}"),
        ("scale of the positions, median and largest", f"{np.median(scale):.1f} mm, {scale.max():.1f} mm"),
    ]
    if plan.candidates:
        rows.insert(1, ("mean weight of a candidate", f"{plan.weights.mean():.2f}"))
    if len(plan.keypoint_confidence):
        quarter, least = np.quantile(plan.keypoint_confidence, (0.25, 0.0))
        rows.append(("keypoint confidence, lower quartile and lowest", f"{quarter:.2f}, {least:.2f}"))
    rows += [(words, form(plan.evidence[name])) for name, (words, form) in EVIDENCE.items() if name in plan.evidence]
    if plan.confidence is not None:
        rows.insert(0, ("**confidence**", f"**{plan.confidence:.2f}**"))
    return Table(("quantity", "value"), tuple(rows), "")


def _execution_table(path: MeasuredPath) -> Table:
    """How far the measured path is from the commanded one, for each arm."""
    rows = []
    for arm in range(path.tool_errors.shape[1] if len(path.seconds) else 0):
        errors, seconds = MM * path.tool_errors[:, arm], len(path.seconds) / path.rate_hz
        degrees = np.rad2deg(path.joint_errors[:, arm].max())
        numbers = (seconds, np.median(errors), errors.max(), degrees)
        rows.append((str(arm + 1), *(f"{number:.1f}" for number in numbers)))
    head = ("arm", "seconds", "tool: median [mm]", "tool: largest [mm]", "joint: largest [degrees]")
    return Table(head, tuple(rows), "")


def _stage_table(stages: Sequence[Stage]) -> Table:
    kinds = ("prompt_tokens", "cached_tokens", "completion_tokens")
    sums = {name: sum(getattr(stage, name) for stage in stages) for name in ("seconds", *kinds)}
    rows = []
    for stage in (*stages, Stage("total", **sums)):
        seconds = f"{stage.seconds:.3f}" if stage.seconds < 1 else f"{stage.seconds:.1f}"
        counts = [getattr(stage, kind) for kind in kinds]
        rows.append((stage.name, seconds, *(f"{count:,}" if count else NONE for count in counts)))
    rows[-1] = tuple(f"**{cell}**" for cell in rows[-1])
    return Table(("stage", "seconds", "tokens given", "of these cached", "tokens written"), tuple(rows), "")
