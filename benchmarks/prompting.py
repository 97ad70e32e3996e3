"""Accuracy, time and tokens of a language model, by frames and layout of the prompt.

Ten demonstrations of a task with simulated keypoints (`pick_and_place.py`), then new scenes. Every plan is stored in
`results/prompting.jsonl` and not repeated, so a run can be interrupted and continued; the table is written from all
stored plans, with the number of scenes of each row.

    python benchmarks/prompting.py                          # the embedded model, the paper's layout and ours
    python benchmarks/prompting.py --layouts factorised --temperatures 0.5 1.0 --tasks place midway
    python benchmarks/prompting.py --models gguf:qwen.gguf --layouts sequence --scenes 1 --deadline 1500
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path

import numpy as np
from pick_and_place import TASKS, WITHIN_M, PickAndPlace, Scene, key_error

from robust_instant_policy.context import Frames, Layout, Prompt, write_prompt
from robust_instant_policy.context.factorised import FactorisedPrompt
from robust_instant_policy.errors import ModelError
from robust_instant_policy.llm import LanguageModel, Listener, Sampling, connect
from robust_instant_policy.query import Query
from robust_instant_policy.regression import robust_gripper_trajectory
from robust_instant_policy.trajectory import Trajectory

ROOT = Path(__file__).parents[1]
KEPT, TABLE = ROOT / "results" / "prompting.jsonl", ROOT / "docs" / "tables" / "prompting.md"
NUM_DEMOS = 10
NUM_SAMPLES = 5  # Q
MIN_CANDIDATES = 3
FIRST_NEW_SEED = 1000  # demonstrations count from 0


@dataclass(frozen=True)
class Row:
    """One line of the table: a task, a model and a kind of prompt."""

    task: str
    model: str
    frames: Frames
    layout: Layout
    temperature: float


@dataclass(frozen=True)
class Outcome:
    """One plan: key-step errors in metres (infinite without an answer) and its cost.

    ``tokens`` are those read (not cached) and written, ``paper_tokens`` those of the paper's layout for the same
    numbers; ``cold`` means that nothing was cached. ``load`` is the load of the machine by other programs, and
    ``peak_gib`` the memory of the whole process so far.
    """

    scene: int
    cold: bool
    single: tuple[float, ...]
    mean: float
    robust: float
    refused: int
    answers: int
    tokens: int
    paper_tokens: int
    seconds: float
    cpu_seconds: float
    load_seconds: float
    peak_gib: float
    load: float


class Measurement:
    """Plans of one row, made with one model in one process."""

    def __init__(self, row: Row, model: LanguageModel, load_seconds: float, deadline_s: float):
        self._row, self._model, self._load_seconds, self._deadline_s = row, model, load_seconds, deadline_s
        self._world = PickAndPlace(row.task)
        demos = [self._world.scene(seed) for seed in range(NUM_DEMOS)]
        self._prompt = fitted(demos, row.frames, row.layout)
        self._paper = fitted(demos, "world", "sequence")
        self._cold = True

    def plan(self, number: int) -> Outcome:
        scene = self._world.scene(FIRST_NEW_SEED + number, exact=True)
        counts: Counter[bool] = Counter()
        load = os.getloadavg()[0]
        start, cpu = time.monotonic(), time.process_time()
        answers = self._model.sample(
            self._prompt.queries(scene.keypoints),
            Sampling(NUM_SAMPLES, self._row.temperature, seed=number, deadline_s=self._deadline_s),
            Listener(
                self._prompt.read,
                on_answer=lambda query, sample, attempt, answer, accepted: counts.update([accepted]),
            ),
        )
        seconds, cpu_seconds = time.monotonic() - start, time.process_time() - cpu
        every = [answer for own in answers for answer in own]
        candidates = [
            self._prompt.trajectory([own[index].value for own in answers], scene.keypoints)
            for index in range(min(map(len, answers)))
        ]
        single = [key_error(candidate, scene.trajectory) for candidate in candidates]
        outcome = Outcome(
            scene=number,
            cold=self._cold,
            single=(*single, *[float("inf")] * (NUM_SAMPLES - len(single))),
            mean=agreed_error(candidates, scene, "mean", self._prompt.curvature),
            robust=agreed_error(candidates, scene, "em", self._prompt.curvature),
            refused=counts[False],
            answers=counts.total(),
            tokens=sum(one.prompt_tokens - one.cached_tokens + one.completion_tokens for one in every),
            paper_tokens=self._paper_tokens(scene),
            seconds=seconds,
            cpu_seconds=cpu_seconds,
            load_seconds=self._load_seconds,
            peak_gib=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
            load=load,
        )
        self._cold = False
        return outcome

    def _paper_tokens(self, scene: Scene) -> int:
        """Tokens of a correct plan in the paper's layout, counted by this model."""
        (query,) = self._paper.queries(scene.keypoints)
        # With the truth as one more demonstration, the correct answer is the text after its keypoints.
        told = fitted([scene], "world", "sequence").queries(scene.keypoints)[0].text
        keypoints = query.text.splitlines()[-1] + "\n"
        answer = told.removeprefix(keypoints).removesuffix(keypoints)
        read = query.text if self._cold else keypoints
        return self._model.count_tokens(read) + NUM_SAMPLES * self._model.count_tokens(answer)


def fitted(demos: Sequence[Scene], frames: Frames, layout: Layout) -> Prompt:
    keypoints = np.stack([demo.keypoints for demo in demos])
    return write_prompt(keypoints, [demo.trajectory for demo in demos], frames, layout)


def agreed_error(candidates: Sequence[Trajectory], scene: Scene, estimator: str, curvature: np.ndarray) -> float:
    if len(candidates) < MIN_CANDIDATES:
        return float("inf")
    actions = [candidate.actions for candidate in candidates]
    fit = robust_gripper_trajectory(actions, estimator=estimator, curvature=curvature)
    return key_error(Trajectory.from_actions(fit.actions), scene.trajectory)


def loaded(spec: str) -> tuple[LanguageModel, float]:
    """The model, ready to answer, and its start time in seconds."""
    start = time.monotonic()
    model = connect(spec)
    model.sample([Query("1 2 3 ", max_tokens=1)], Sampling(1, temperature=0.0))
    return model, time.monotonic() - start


def read_kept() -> dict[Row, dict[int, Outcome] | str]:
    """Plans by row and scene, or the error message of a model that refused the prompt."""
    kept: dict[Row, dict[int, Outcome] | str] = {}
    for line in KEPT.read_text().splitlines() if KEPT.exists() else ():
        entry = json.loads(line)
        row = Row(**entry["row"])
        if "refused" in entry:
            kept[row] = entry["refused"]
            continue
        plans = kept.setdefault(row, {})
        outcome = Outcome(**entry["plan"] | {"single": tuple(entry["plan"]["single"])})
        assert isinstance(plans, dict)
        plans[outcome.scene] = outcome
    return kept


def keep(row: Row, entry: dict[str, object]) -> None:
    KEPT.parent.mkdir(parents=True, exist_ok=True)
    with KEPT.open("a") as file:
        file.write(json.dumps({"row": asdict(row), **entry}) + "\n")


def measure(row: Row, spec: str, scenes: int, deadline_s: float) -> None:
    """Make the missing plans of ``row``."""
    done = read_kept().get(row, {})
    missing = [number for number in range(scenes) if number not in done] if isinstance(done, dict) else []
    if not missing:
        return
    model, load_seconds = loaded(spec)
    measurement = Measurement(row, model, load_seconds, deadline_s)
    for number in missing:
        try:
            outcome = measurement.plan(number)
        except ModelError as error:
            keep(row, {"refused": str(error)})
            break
        keep(row, {"plan": asdict(outcome)})
        print(
            f"{' '.join(map(str, astuple(row)))}, scene {number}: {1000 * outcome.robust:.1f} mm, "
            f"{outcome.seconds:.1f} s, {outcome.cpu_seconds:.1f} s of processor",
            flush=True,
        )
    model.close()


COLUMNS = (
    "task",
    "model",
    "frames, layout",
    "temperature",
    "scenes",
    "single sample",
    "mean",
    "Student's t",
    "unparsable",
    "tokens a plan, first / later",
    "of the paper's layout",
    "seconds",
    "CPU seconds",
    "load",
)


def as_cells(row: Row, plans: Sequence[Outcome]) -> list[str]:
    first, later = [[plan for plan in plans if plan.cold is cold] for cold in (True, False)]

    def both(form: str, name: str, share_of: str | None = None) -> str:
        return " / ".join(
            format(np.median([getattr(p, name) / (getattr(p, share_of) if share_of else 1) for p in own]), form)
            if own
            else "—"
            for own in (first, later)
        )

    return [
        row.task,
        row.model,
        f"{row.frames}, {row.layout}",
        f"{row.temperature:g}",
        str(len(plans)),
        _errors([error for plan in plans for error in plan.single]),
        _errors([plan.mean for plan in plans]),
        _errors([plan.robust for plan in plans]),
        f"{sum(plan.refused for plan in plans) / max(sum(plan.answers for plan in plans), 1):.0%}",
        both(".0f", "tokens"),
        both(".2f", "tokens", "paper_tokens"),
        both(".1f", "seconds"),
        both(".1f", "cpu_seconds"),
        f"{np.median([plan.load for plan in plans]):.1f}",
    ]


def reference_cells(task: str, scenes: int) -> list[str]:
    """The frames without a model: every number is the median of the demonstrations."""
    world = PickAndPlace(task)
    prompt = fitted([world.scene(seed) for seed in range(NUM_DEMOS)], "adaptive", "factorised")
    assert isinstance(prompt, FactorisedPrompt)
    new = [world.scene(FIRST_NEW_SEED + number, exact=True) for number in range(scenes)]
    errors = [key_error(prompt.median_trajectory(scene.keypoints), scene.trajectory) for scene in new]
    return [task, "none: the median", "adaptive, factorised", "—", str(scenes), "—", "—", _errors(errors), *["—"] * 6]


def _errors(values: Sequence[float]) -> str:
    median = float(np.median(values)) * 1000
    return f"{'—' if np.isinf(median) else f'{median:.1f}'} mm, {np.mean(np.array(values) <= WITHIN_M):.0%}"


def table() -> str:
    kept = read_kept()
    lines = [COLUMNS, ["---"] * len(COLUMNS)]
    remarks = []
    for task in dict.fromkeys(row.task for row in kept):
        lines.append(reference_cells(task, 20))
        for row, plans in sorted(kept.items(), key=lambda item: astuple(item[0])):
            if row.task != task:
                continue
            if isinstance(plans, str):
                remarks.append(f"{row.model}, {row.frames}, {row.layout}: {plans}.")
            else:
                lines.append(as_cells(row, [plans[number] for number in sorted(plans)]))
    made = [plan for plans in kept.values() if isinstance(plans, dict) for plan in plans.values()]
    embedded = [p for row, plans in kept.items() if row.model == "embedded" and isinstance(plans, dict)
                for p in plans.values() if row.layout == "factorised"]  # fmt: skip
    if embedded:
        ready = sorted({plan.load_seconds for plan in embedded})
        remarks.append(
            f"The embedded model was ready to answer in {np.median(ready):.1f} s (median of {len(ready)} starts, "
            f"{ready[0]:.1f} to {ready[-1]:.1f} s beside other work); the whole process needed at most "
            f"{max(plan.peak_gib for plan in embedded):.2f} GiB."
        )
    head = (
        f"Written by `benchmarks/prompting.py` from {len(made)} plans, {NUM_DEMOS} demonstrations each, "
        f"Q = {NUM_SAMPLES}, on {os.cpu_count()} cores.\n\n"
    )
    body = "".join("| " + " | ".join(cells) + " |\n" for cells in lines)
    return head + body + "".join(f"\n{remark}\n" for remark in remarks)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="*", default=["embedded"], help="as for rip.connect; none: only the table")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=["place"])
    parser.add_argument("--frames", nargs="+", choices=("world", "adaptive"), default=["world", "adaptive"])
    parser.add_argument("--layouts", nargs="+", choices=("sequence", "factorised"), default=["sequence", "factorised"])
    parser.add_argument("--temperatures", nargs="+", type=float, default=[0.7])
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--sequence-scenes", type=int, default=3, help="sequences take minutes a plan")
    parser.add_argument("--deadline", type=float, default=300.0, help="seconds a plan")
    parser.add_argument("--out", type=Path, default=TABLE, help="the table")
    args = parser.parse_args()
    for spec in args.models:
        name = Path(spec.removeprefix("gguf:")).stem
        for task in args.tasks:
            for layout in args.layouts:
                for frames in args.frames:
                    for temperature in args.temperatures:
                        row = Row(task, name, frames, layout, temperature)
                        scenes = args.sequence_scenes if layout == "sequence" else args.scenes
                        measure(row, spec, scenes, args.deadline)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(table())
    print(args.out.read_text())


if __name__ == "__main__":
    main()
