"""What can a policy infer from demonstrations? Families of relations between things, with given keypoints.

    python benchmarks/relations.py                        # median, neighbours, gp: all families, minutes
    python benchmarks/relations.py --quick --llm embedded openai:gpt-4o    # compare language models in ten minutes
    python benchmarks/relations.py --noise 1 2 4 --demos 3 5 10 20
    python benchmarks/relations.py --methods rip --llm embedded --families perp side --scenes 10
    python benchmarks/relations.py --confidence           # what Plan.confidence is worth, also in uncovered scenes
    python benchmarks/relations.py --table                # make no plans, only write the tables again

The families are in `relation_families.py`. For each, sets of demonstrations are drawn, and for each set new scenes.
Every plan is a row of ``--rows``, written as soon as it is made and not repeated; an interrupted run continues. `rip`,
`rip-gauss` and `kat` (single samples) plan from the same samples. The error of a plan is the largest distance of a
gripper point from the truth at any key step (first and last step, both sides of each gripper change); a plan is right
within `WITHIN_M`. The error along the way is the largest distance of a step's gripper points from the true path.

Choose constants with ``--split tune``, report with ``--split measure`` (the default): they share no random number.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from pick_and_place import WITHIN_M
from relation_families import FAMILIES, UNCOVERED, USUAL, Family, Scene
from rich.progress import Progress
from stand_in import StandIn

from robust_instant_policy.commands.options import positive
from robust_instant_policy.context import FactorisedPrompt
from robust_instant_policy.errors import PlanningError, RipError
from robust_instant_policy.evaluation.manifest import code_digest
from robust_instant_policy.evaluation.statistics import auroc, wilson_interval
from robust_instant_policy.llm import LanguageModel, connect
from robust_instant_policy.policies import (
    Context,
    KeypointPolicy,
    KeypointRegression,
    LocatedScene,
    Neighbours,
    Plan,
    RobustInstantPolicy,
    Settings,
    context_of_keypoints,
    scene_of_keypoints,
)
from robust_instant_policy.policies.confidence import Evidence, plan_confidence
from robust_instant_policy.policies.sampling import NO_SAMPLES
from robust_instant_policy.trajectory import Trajectory

ROOT = Path(__file__).parents[1]
ROWS = ROOT / "results" / "relations.jsonl"
RUN = Path("runs/relations")  # of a quick comparison, which leaves results and documentation alone
METHODS = ("median", "neighbours", "gp", "gp-world", "kat", "rip-gauss", "rip")
ASKING = ("kat", "rip-gauss", "rip")
CHEAP = ("median", "neighbours", "gp", "gp-world")
STAND_IN = "stand-in"  # a regression in place of a language model, see `stand_in.py`
CONFIDENT = ("neighbours", "rip")  # methods whose plans have a confidence
STANDARD = (2.0, 10)  # keypoint noise in mm, and demonstrations, of the main table
GATE = 0.9  # confidence from which on a plan would be executed
FIRST_NEW = 1000  # scenes from here on are new, demonstrations count from 0
QUICK = {"families": ("place", "push-to", "perp", "nearest", "along"), "sets": 1, "scenes": 4}


@dataclass(frozen=True)
class Case:
    """What decides a row, beside the code. ``noise_mm`` of the keypoints, ``demos`` demonstrations, new scene
    ``scene`` of ``set``; ``model`` is empty for methods that ask none."""

    family: str
    split: str
    noise_mm: float
    demos: int
    set: int
    scene: int
    condition: str
    method: str
    model: str


@dataclass(frozen=True)
class Outcome:
    """``errors`` at key steps and ``ways`` along the path in metres, one for each plan (`kat`: one for each sample),
    infinite where there is none; ``fit_s`` and ``plan_s`` in seconds; tokens ``read`` (not cached) and ``written``;
    ``failure`` says why there is no plan."""

    errors: tuple[float, ...]
    ways: tuple[float, ...]
    confidence: float | None
    evidence: dict[str, float]
    fit_s: float
    plan_s: float
    read: int
    written: int
    failure: str


@dataclass(frozen=True)
class Row:
    case: Case
    code: str
    outcome: Outcome


def gripper_changes(trajectory: Trajectory) -> list[int]:
    """The last step before each change of a gripper."""
    return [int(step) for step in np.flatnonzero(np.diff(np.round(trajectory.gripper_state), axis=0).any(axis=1))]


def key_error(trajectory: Trajectory, truth: Trajectory) -> float:
    """Largest distance of a gripper point from the truth at any key step, metres; infinite where the number of gripper
    changes differs."""
    own, true = gripper_changes(trajectory), gripper_changes(truth)
    if len(own) != len(true) or trajectory.num_arms != truth.num_arms:
        return math.inf
    steps, true_steps = (
        [0, *(change + after for change in changes for after in (0, 1)), -1] for changes in (own, true)
    )
    return float(np.linalg.norm(trajectory.triplets[steps] - truth.triplets[true_steps], axis=-1).max())


def way_error(trajectory: Trajectory, truth: Trajectory) -> float:
    """Largest distance, at any step, from the nearest point of the true path between the same two gripper changes,
    metres; infinite like `key_error`."""
    own, true = gripper_changes(trajectory), gripper_changes(truth)
    if len(own) != len(true) or trajectory.num_arms != truth.num_arms:
        return math.inf
    worst = 0.0
    for (start, stop), (true_start, true_stop) in zip(
        pairwise([-1, *own, len(trajectory) - 1]), pairwise([-1, *true, len(truth) - 1]), strict=True
    ):
        planned = trajectory.triplets[start + 1 : stop + 1, None]
        apart = np.linalg.norm(planned - truth.triplets[None, true_start + 1 : true_stop + 1], axis=-1)
        worst = max(worst, apart.max(axis=(-1, -2)).min(axis=1).max())
    return float(worst)


class Set:
    """Demonstrations of one set, and the methods fitted to them, each when it is first needed."""

    def __init__(self, family: Family, split: str, number: int, noise_mm: float, num_demos: int):
        self._draw = family.scenes(split, number, noise_mm / 1000)
        shown = [self._draw(index) for index in range(num_demos)]
        self._keypoints = np.stack([scene.keypoints for scene in shown])
        self._paths = [scene.path for scene in shown]
        self._contexts: dict[str, tuple[Context, float]] = {}
        self._fitted: dict[str, tuple[KeypointPolicy, float]] = {}

    def scene(self, number: int, condition: str) -> Scene:
        return self._draw(FIRST_NEW + number, exact=True, condition=condition)

    def context(self, settings: Settings) -> tuple[Context, float]:
        """The context, and the seconds that it took."""
        if settings.frames not in self._contexts:
            start = time.perf_counter()
            context = context_of_keypoints(self._keypoints, self._paths, settings)
            self._contexts[settings.frames] = context, time.perf_counter() - start
        return self._contexts[settings.frames]

    def fitted(self, name: str, policy: KeypointPolicy) -> tuple[KeypointPolicy, float]:
        if name not in self._fitted:
            context, seconds = self.context(policy.settings)
            start = time.perf_counter()
            policy.fit_context(context)
            self._fitted[name] = policy, seconds + time.perf_counter() - start
        return self._fitted[name]

    def plan(self, case: Case, model: LanguageModel | None, deadline_s: float) -> Iterator[tuple[str, Outcome]]:
        """Outcomes by method: that of ``case``, or of all of `ASKING` from the same samples."""
        scene = self.scene(case.scene, case.condition)
        located, truth = scene_of_keypoints(scene.keypoints), scene.path
        if case.method in ASKING:
            assert model is not None
            yield from self._plan_from_samples(located, truth, case, model, deadline_s)
            return
        if case.method == "median":
            context, fit_s = self.context(Settings())
            start = time.perf_counter()
            prompt = context.prompt.for_scene(scene.keypoints)
            assert isinstance(prompt, FactorisedPrompt)
            trajectory = prompt.median_trajectory(scene.keypoints)
            yield "median", judged([trajectory], truth, fit_s=fit_s, plan_s=time.perf_counter() - start)
            return
        policies: dict[str, type[Neighbours | KeypointRegression]]
        policies = {"neighbours": Neighbours, "gp": KeypointRegression, "gp-world": KeypointRegression}
        settings = Settings(frames="world" if case.method == "gp-world" else "adaptive")
        policy, fit_s = self.fitted(case.method, policies[case.method](settings))
        try:
            plan = policy.plan_scene(located)
        except PlanningError as error:
            yield case.method, unplanned(error, fit_s)
            return
        yield case.method, judged([plan.trajectory], truth, fit_s=fit_s, plan=plan)

    def _plan_from_samples(
        self, scene: LocatedScene, truth: Trajectory, case: Case, model: LanguageModel, deadline_s: float
    ) -> Iterator[tuple[str, Outcome]]:
        settings = Settings()
        context, fit_s = self.context(settings)
        robust = RobustInstantPolicy(model, settings, deadline_s=deadline_s).fit_context(context)
        gaussian = RobustInstantPolicy(model, replace(settings, dof=math.inf)).fit_context(context)
        samples = NO_SAMPLES
        try:
            plan, samples = robust.plan_from(scene, samples)
        except PlanningError as error:
            for method in ASKING:
                yield method, unplanned(error, fit_s)
            return
        yield "kat", judged(plan.candidates, truth, fit_s=fit_s, plan=plan, missing=settings.num_queries)
        yield "rip", judged([plan.trajectory], truth, fit_s=fit_s, plan=plan)
        plan, _ = gaussian.plan_from(scene, samples)
        yield "rip-gauss", judged([plan.trajectory], truth, fit_s=fit_s, plan=plan)


def judged(
    planned: Sequence[Trajectory],
    truth: Trajectory,
    *,
    fit_s: float,
    plan_s: float = 0.0,
    plan: Plan | None = None,
    missing: int = 0,
) -> Outcome:
    none = (math.inf,) * (missing - len(planned))
    stages = plan.usage.stages if plan is not None else ()
    return Outcome(
        errors=(*(key_error(one, truth) for one in planned), *none),
        ways=(*(way_error(one, truth) for one in planned), *none),
        confidence=None if plan is None else plan.confidence,
        evidence={} if plan is None else dict(plan.evidence),
        fit_s=fit_s,
        plan_s=plan_s if plan is None else plan.usage.seconds,
        read=sum(stage.prompt_tokens - stage.cached_tokens for stage in stages),
        written=sum(stage.completion_tokens for stage in stages),
        failure="",
    )


def unplanned(error: RipError, fit_s: float) -> Outcome:
    return Outcome((math.inf,), (math.inf,), 0.0, {}, fit_s, 0.0, 0, 0, str(error))


def read_rows(path: Path) -> list[Row]:
    """Rows of a file; a line that was cut off by a crash is left out."""
    rows = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            entry = json.loads(line)
        except ValueError:
            continue
        outcome = entry["outcome"] | {name: tuple(entry["outcome"][name]) for name in ("errors", "ways")}
        rows.append(Row(Case(**entry["case"]), entry["code"], Outcome(**outcome)))
    return rows


def keep(path: Path, row: Row) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(json.dumps(rounded(asdict(row))) + "\n")


def rounded(value: Any) -> Any:
    """``value`` with all its numbers to a hundredth of a millimetre, for short lines."""
    if isinstance(value, float):
        return round(value, 5) if math.isfinite(value) else value
    if isinstance(value, dict):
        return {name: rounded(one) for name, one in value.items()}
    return [rounded(one) for one in value] if isinstance(value, tuple | list) else value


def cases(options: argparse.Namespace) -> list[Case]:
    """Sorted so that all plans of one set follow each other."""
    found = []
    for model in ("", *options.llm):
        own = [m for m in options.methods if (m in ASKING) == bool(model)]
        methods = own[:1] if model else own  # one stands for all that plan from the same samples
        for noise in options.noise:
            for demos in options.demos:
                for name in options.families:
                    conditions = (USUAL, *FAMILIES[name].uncovered) if options.confidence else (USUAL,)
                    found += [
                        Case(name, options.split, noise, demos, number, scene, condition, method, model)
                        for number in range(options.sets)
                        for method in methods
                        for condition in conditions
                        for scene in range(options.scenes)
                    ]
    return found


def run(options: argparse.Namespace) -> None:
    """Make the plans that are missing."""
    code = code_digest()
    done = {row.case for row in read_rows(options.rows) if options.keep or row.code == code}
    missing = [case for case in cases(options) if case not in done]
    models: dict[str, LanguageModel] = {}
    current: tuple = ()
    with Progress() as progress:
        task = progress.add_task("plans", total=len(missing))
        for case in missing:
            key = (case.family, case.split, case.set, case.noise_mm, case.demos)
            if key != current:
                demos, current = Set(FAMILIES[case.family], *key[1:]), key
            progress.update(task, description=f"{case.family} {case.model or case.method}")
            if case.model and case.model not in models:
                models[case.model] = StandIn(1.0) if case.model == STAND_IN else connect(case.model)
            for method, outcome in demos.plan(case, models.get(case.model), options.deadline):
                keep(options.rows, Row(replace(case, method=method), code, outcome))
            progress.advance(task)
    for model in models.values():
        model.close()


def table(rows: Sequence[Row]) -> str:
    """Success and errors by family, method and model at `STANDARD`; success alone for other noise and numbers."""
    columns = sorted(
        {(row.case.method, row.case.model) for row in rows}, key=lambda one: (METHODS.index(one[0]), one[1])
    )
    by_case: dict[tuple, list[Row]] = defaultdict(list)
    for row in rows:
        for family in (row.case.family, "all"):
            by_case[family, row.case.method, row.case.model, row.case.noise_mm, row.case.demos].append(row)
    families = [name for name in (*FAMILIES, "all") if any(row.case.family == name or name == "all" for row in rows)]

    def lines(title: str, heads: Sequence[str], cells: Callable[[str], list[str]]) -> list[str]:
        head = ["", title, "", "| family | " + " | ".join(heads) + " |", "| --- " * (len(heads) + 1) + "|"]
        return head + [f"| {name} | " + " | ".join(cells(name)) + " |" for name in families]

    measured = {(row.case.noise_mm, row.case.demos) for row in rows}
    standard = STANDARD if STANDARD in measured or not measured else min(measured)
    noise, demos = standard
    text = lines(
        f"{demos} demonstrations, {noise:g} mm of noise: right, median error at key steps and along the way (mm).",
        [f"{method} {model}".strip() for method, model in columns],
        lambda name: [cell(by_case.get((name, *column, *standard), [])) for column in columns],
    )
    for column in columns:
        others = sorted({key[3:] for key in by_case if key[1:3] == column})
        if len(others) > 1:
            text += lines(
                f"`{' '.join(column).strip()}`: right, by demonstrations and keypoint noise.",
                [f"{demos}, {noise:g} mm" for noise, demos in others],
                lambda name, column=column, others=others: [
                    share(by_case.get((name, *column, *one), [])) for one in others
                ],
            )
    return "\n".join(text).strip() + "\n"


def share(rows: Sequence[Row]) -> str:
    errors = np.array([error for row in rows for error in row.outcome.errors])
    return f"{(errors <= WITHIN_M).mean():.0%}" if rows else "–"


def cell(rows: Sequence[Row]) -> str:
    """Share of right plans, median error at key steps and along the way."""
    if not rows:
        return "–"
    errors = np.array([error for row in rows for error in row.outcome.errors])
    ways = np.array([error for row in rows for error in row.outcome.ways])
    return f"{share(rows)} of {len(errors)}, {in_mm(np.median(errors))}, {in_mm(np.median(ways))}"


def confidence_table(rows: Sequence[Row]) -> str:
    """By method, kind of scene and family: how many plans pass the gate, how many of these are wrong, and AUROC: of the
    plans that no check refused, and of all."""
    columns = ("method", "plans for", "plans, right", "right ones that pass", "wrong among those that pass")
    columns = (*columns, "refused, of these right", "AUROC", "with refusals")
    lines = ["| " + " | ".join(columns) + " |", "| --- " * len(columns) + "|"]
    for method, model in sorted({(row.case.method, row.case.model) for row in rows}):
        mine = [row for row in rows if (row.case.method, row.case.model) == (method, model)]
        parts = {"usual scenes": [row for row in mine if row.case.condition == USUAL]}
        parts |= {name: [row for row in mine if row.case.condition == name] for name in UNCOVERED}
        parts["all"] = mine
        parts |= {f"all, {name}": [row for row in mine if row.case.family == name] for name in FAMILIES}
        for name, part in parts.items():
            if part:
                lines.append(f"| {f'{method} {model}'.strip()} | {name} | " + " | ".join(trust(part)) + " |")
    return "\n".join(lines) + "\n"


def trust(rows: Sequence[Row]) -> list[str]:
    confidence, right = judgements(rows)
    passed = confidence >= GATE
    wrong, through = int((passed & ~right).sum()), int(passed.sum())
    low, high = wilson_interval(wrong, through)
    refused = np.array([row.outcome.evidence.get("errors", 0) > 0 for row in rows])
    areas = [auroc(confidence[~refused], right[~refused]), auroc(confidence, right)]
    return [
        f"{len(rows)}, {int(right.sum())}",
        f"{passed[right].mean():.0%}" if right.any() else "–",
        f"{wrong} of {through}: {wrong / max(through, 1):.1%} ({low:.1%} to {high:.1%})",
        f"{int(refused.sum())}, {int(right[refused].sum())}",
        *(f"{area:.3f}" if np.isfinite(area) else "–" for area in areas),
    ]


def judgements(rows: Sequence[Row]) -> tuple[np.ndarray, np.ndarray]:
    """Confidence of each plan, by the present coefficients, and whether it is right."""
    confidence = np.array([confidence_of(row.outcome) for row in rows], dtype=float)
    return confidence, np.array([row.outcome.errors[0] <= WITHIN_M for row in rows], dtype=bool)


def confidence_of(outcome: Outcome) -> float | None:
    if not outcome.evidence:
        return outcome.confidence
    return plan_confidence(Evidence(**{one.name: outcome.evidence.get(one.name, np.nan) for one in fields(Evidence)}))


def draw_reliability(rows: Sequence[Row], path: Path) -> None:
    """Share of right plans against their confidence, with Wilson's 95% intervals, and how many there are."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(5, 4.5), layout="constrained")
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    for number, method in enumerate(dict.fromkeys(row.case.method for row in rows)):
        confidence, right = judgements([row for row in rows if row.case.method == method])
        for low, high in pairwise([0, 0.2, 0.4, 0.6, 0.8, GATE, 0.95, 1 + 1e-9]):
            inside = (confidence >= low) & (confidence < high)
            if inside.any():
                share, count = right[inside].mean(), int(inside.sum())
                least, most = wilson_interval(int(right[inside].sum()), count)
                at = confidence[inside].mean()
                label = method if low == 0 or not (confidence < low).any() else None
                axes.errorbar(
                    at, share, [[share - least], [most - share]], fmt="os"[number % 2], color=f"C{number}", label=label
                )
                axes.annotate(f" {count}", (at, share), fontsize=8)
    axes.set(xlabel="confidence", ylabel="share of right plans", xlim=(-0.02, 1.06), ylim=(-0.02, 1.02))
    axes.legend(fontsize=8)
    figure.savefig(path, metadata={"Date": None})


def in_mm(metres: float) -> str:
    return f"{1000 * metres:.1f}" if math.isfinite(metres) else "∞"


def millimetres(text: str) -> float:
    """A number, 0 or more."""
    if not 0 <= (number := float(text)) < math.inf:
        raise argparse.ArgumentTypeError("must be 0 or more")
    return number


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--families", nargs="+", choices=FAMILIES, default=list(FAMILIES))
    parser.add_argument("--methods", nargs="+", choices=METHODS)
    parser.add_argument("--llm", nargs="*", default=[], help=f"as for rip.connect, or {STAND_IN}")
    parser.add_argument("--noise", nargs="+", type=millimetres, default=[2.0], help="of the keypoints, mm")
    parser.add_argument("--demos", nargs="+", type=positive, default=[10])
    parser.add_argument("--sets", type=positive, default=4, help="of demonstrations, for each family")
    parser.add_argument("--scenes", type=positive, default=5, help="new ones for each set")
    parser.add_argument("--split", choices=("tune", "measure"), default="measure")
    parser.add_argument("--quick", action="store_true", help="a few families, one set, four scenes")
    parser.add_argument("--confidence", action="store_true", help="also scenes that no demonstration covers")
    parser.add_argument("--deadline", type=float, default=300.0, help="seconds a plan")
    parser.add_argument("--keep", action="store_true", help="do not repeat plans that another version of the code made")
    parser.add_argument("--rows", type=Path, help=f"default: {ROWS.relative_to(ROOT)}, or in {RUN} with --quick")
    parser.add_argument("--out", type=Path, help=f"folder of the tables (default: docs, or {RUN} with --quick)")
    parser.add_argument("--table", action="store_true", help="make no plans")
    options = parser.parse_args()
    for name, value in (QUICK if options.quick else {}).items():
        setattr(options, name, value)
    options.rows = options.rows or (RUN / ROWS.name if options.quick else ROWS)
    options.out = options.out or (RUN if options.quick else ROOT / "docs")
    if options.confidence:
        options.methods, options.llm = options.methods or CONFIDENT, options.llm or [STAND_IN]
    options.methods = options.methods or (CHEAP + (ASKING if options.llm else ()))
    if not options.llm and (asking := sorted(set(options.methods) & set(ASKING))):
        parser.error(f"methods that ask a language model need --llm: {', '.join(asking)}")
    if not options.table:
        try:
            run(options)
        except RipError as error:
            sys.exit(f"{parser.prog}: {error}")
    latest = {row.case: row for row in read_rows(options.rows) if row.case.split == options.split}
    rows = list(latest.values())
    usual = [row for row in rows if row.case.condition == USUAL]
    examined = {(row.case.family, row.case.noise_mm, row.case.demos) for row in rows if row.case.condition != USUAL}
    judged_rows = [
        row
        for row in rows
        if row.case.method in CONFIDENT and (row.case.family, row.case.noise_mm, row.case.demos) in examined
    ]
    write(options.out / "tables" / "relations.md", table(usual))
    if judged_rows:
        write(options.out / "tables" / "relations_confidence.md", confidence_table(judged_rows))
        (options.out / "images").mkdir(exist_ok=True)
        draw_reliability(judged_rows, options.out / "images" / "relations_confidence.svg")


def write(path: Path, text: str) -> None:
    print(text)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


if __name__ == "__main__":
    main()
