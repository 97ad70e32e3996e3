"""Is `Plan.confidence` the probability that a plan is right? Sound and faulty scenes, planned for and executed.

    python benchmarks/confidence.py run --out runs/confidence            # resumable; hours for all faults
    python benchmarks/confidence.py run --out runs/confidence --faults none shuffled:demos --tasks push-cube
    python benchmarks/confidence.py fit runs/confidence --relations runs/relations.jsonl    # coefficients, see `fit`
    python benchmarks/confidence.py report runs/confidence               # table and diagram from the others

A row is what a user would see, refused while fitting or planning, or a plan with its confidence; and whether the plan
succeeds in the simulator, with the checks switched off where they refuse. Faults are those of `benchmarks/faults.py`,
and models that hallucinate. Plans are made with `stand_in.StandIn`, no language model: its answers agree
(``--spread 0``) or are drawn from bootstraps of the prompt's examples (``--spread 1``).

Demonstrations and scenes of the two splits share no seed: "tune" is for `fit`, "test" for `report`.
"""

from __future__ import annotations

import argparse
import json
import sys
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any
from unittest.mock import patch

import numpy as np
from faults import FAULTS, Fault
from pick_and_place import WITHIN_M
from rich.progress import track
from scipy.optimize import minimize
from stand_in import StandIn

from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import InvalidValueError, KeypointError, PlanningError, RipError
from robust_instant_policy.evaluation.statistics import auroc, wilson_interval
from robust_instant_policy.policies import RobustInstantPolicy
from robust_instant_policy.policies.confidence import COEFFICIENTS, GOOD_AGREEMENT, Evidence, plan_confidence
from robust_instant_policy.policies.context import Context, locate
from robust_instant_policy.sanity import SetReport, errors
from robust_instant_policy.tasks import TASK_NAMES, make_task
from robust_instant_policy.tasks.camera_noise import CameraNoise
from robust_instant_policy.tasks.record import record

TABLES = Path(__file__).parent.parent / "docs" / "tables"
SPLITS = {"tune": (700_000, 710_000), "test": (720_000, 730_000)}  # first seeds of demonstrations and of new scenes
HALLUCINATED = {"hallucinated-40%": 0.4, "hallucinated-60%": 0.6, "hallucinated-80%": 0.8}  # of the candidates
NUM_DEMOS = 10
GATE = 0.9
PRIOR_WEIGHT = 0.5  # of a coefficient's squared distance from 1, in units of the log-likelihood
RELATIONS = "relations"
NAMES = [field.name for field in fields(Evidence)]
REFUSALS = (InvalidValueError, KeypointError, PlanningError)
Row = dict[str, Any]
Coefficients = Mapping[str, float]


def demonstrations(folder: Path, task: Any, first_seed: int) -> list[Demonstration]:
    from robust_instant_policy.datasets import DatasetWriter

    with DatasetWriter(folder, task=task.name, description=task.description, rate_hz=task.record_hz) as writer:
        record(task, writer, NUM_DEMOS, seed=first_seed)
    return load_demonstrations(folder, limit=NUM_DEMOS)


def keep(rows: Path, row: Row) -> None:
    with rows.open("a") as file:
        file.write(json.dumps(row) + "\n")


def cases(options: argparse.Namespace, task: str) -> list[tuple[str, str, str]]:
    """(split, fault, camera) in an order that covers every fault early."""
    names = options.faults or ["none", *FAULTS, *HALLUCINATED]
    found = [(split, name, camera) for name in names for split in options.splits for camera in options.cameras]

    # a part of the faults, another one for each task, and the same whatever else is asked for
    def drawn(case: tuple[str, str, str]) -> float:
        return zlib.crc32(repr((task, *case)).encode()) / 2**32

    return [case for case in found if case[1] == "none" or drawn(case) < options.share]


def run(options: argparse.Namespace) -> None:
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.tasks:
        rows = options.out / f"{name}.jsonl"
        done = {key(row) for row in read(rows)}
        task: Any = make_task(name)
        try:
            shown = {
                split: demonstrations(options.out / "data" / f"{name}-{split}", task, SPLITS[split][0])
                for split in options.splits
            }
            sound: dict[tuple[str, str], Context] = {}
            for split, fault, camera in track(cases(options, name), description=name):
                wanted = range(options.scenes * (options.sound if fault == "none" else 1))
                left = [index for index in wanted if (name, split, fault, camera, index, options.spread) not in done]
                if left:
                    for row in examine(task, shown[split], split, fault, camera, left, options.spread, sound):
                        keep(rows, row)
        finally:
            task.close()


def key(row: Row) -> tuple:
    return tuple(row[name] for name in ("task", "split", "fault", "camera", "scene", "spread"))


def examine(
    task: Any,
    shown: Sequence[Demonstration],
    split: str,
    name: str,
    camera: str,
    scenes: Sequence[int],
    spread: float,
    sound: dict[tuple[str, str], Context],
) -> Iterator[Row]:
    """One row a scene: planned and executed, also where a check refuses that.

    ``sound`` keeps the contexts of demonstrations without a fault, by split and camera.
    """
    fault = FAULTS.get(name, Fault("none", ()))
    noise = CameraNoise() if camera == "noisy" else None

    def photograph(observation: Observation, seed: int) -> Observation:
        return observation if noise is None else noise.photograph(observation, seed)

    base: Row = {"task": task.name, "split": split, "fault": name, "camera": camera, "spread": spread}
    policy = RobustInstantPolicy(StandIn(spread, HALLUCINATED.get(name, 0.0)), workspace=task.workspace)
    seen = [replace(d, observation=photograph(d.observation, i)) for i, d in enumerate(shown)]
    try:
        with unchecked():
            if fault.demonstrations is not None:
                policy.fit(fault.demonstrations(seen))
            elif (split, camera) in sound:
                policy.fit_context(sound[split, camera])
            else:
                sound[split, camera] = policy.fit(seen).context_
    except RipError as error:
        for index in scenes:
            yield {**base, "scene": index, **no_plan("fit", error)}
        return
    for index in scenes:
        seed = SPLITS[split][1] + index
        observation = photograph(task.reset(seed), seed)
        try:
            with unchecked():
                scene = locate(policy.context_, fault.scene(observation, seen) if fault.scene else observation)
            plan = policy.plan_scene(scene)
        except RipError as error:
            yield {**base, "scene": index, **no_plan("plan", error)}
            continue
        trajectory, report = plan.trajectory, policy.context_.report
        if fault.plan is not None:
            trajectory = fault.plan(trajectory)
            outside = report.envelope.check(trajectory)
            plan = replace(plan, confidence=0.0 if outside else plan.confidence, notes=tuple(map(str, outside)))
        try:
            execution = task.execute(trajectory)
            outcome, why = ("success", "") if execution.success else ("failure", execution.failure)
        except RipError as error:  # such as a pose that the arm cannot reach
            outcome, why = "failure", str(error)
        at_fit, at_plan = errors(report.findings), errors(scene.findings)
        yield {
            **base,
            "scene": index,
            "refused": "fit" if at_fit else "plan" if at_plan else "",
            "outcome": outcome,
            "confidence": plan.confidence,
            "why": why,
            "evidence": {name: round(float(value), 5) for name, value in plan.evidence.items()},
            "notes": [note for note in plan.notes if not note.startswith("features")],
        }


@contextmanager
def unchecked() -> Iterator[None]:
    """The checks find what they find, and nothing is refused for it."""
    with (
        patch.object(SetReport, "raise_if_wrong", lambda report: None),
        patch.object(SetReport, "require_observation", SetReport.check_observation),
    ):
        yield


def no_plan(stage: str, error: RipError) -> Row:
    if not isinstance(error, REFUSALS):
        print(f"  {type(error).__name__} at {stage}: {error}", file=sys.stderr)
    return {"refused": stage, "outcome": "no plan", "confidence": 0.0, "why": str(error)}


def read(path: Path) -> list[Row]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def all_rows(folder: Path, split: str) -> list[Row]:
    return [row for path in sorted(folder.glob("*.jsonl")) for row in read(path) if row["split"] == split]


def executed(rows: Sequence[Row]) -> list[Row]:
    """The rows in which a plan was made."""
    return [row for row in rows if not row["refused"]]


def evidence_of(row: Row) -> Evidence:
    return Evidence(**{name: row["evidence"].get(name, np.nan) for name in NAMES})


def confidence_of(row: Row, coefficients: Coefficients = COEFFICIENTS) -> float:
    """By ``coefficients``; 0 where it was refused, or a fault applied to the plan was noticed."""
    return 0.0 if row["refused"] or is_noticed(row) else plan_confidence(evidence_of(row), coefficients)


def is_noticed(row: Row) -> bool:
    """Whether a check of the plan found the fault that was put into it, of which its evidence does not know."""
    return bool(row["fault"].endswith(":plan") and row["confidence"] == 0)


def fit(options: argparse.Namespace) -> None:
    """Coefficients from the tuning rows: logistic regression, not negative, with a prior about 1.

    The prior decides where rows do not: most faults are refused, so few plans are wrong. ``--relations`` are rows of
    ``benchmarks/relations.py --confidence --split tune``; both kinds count alike, and have a constant each, of which
    that of the simulated tasks is kept. Each task is then left out.
    """
    rows = [row for row in executed(all_rows(options.folder, "tune")) if not is_noticed(row)]
    judged_rows = [(evidence_of(row), row["outcome"] == "success", row["task"]) for row in rows]
    related = [row["outcome"] for row in read(options.relations) if row["case"]["split"] == "tune"]
    judged_rows += [
        (evidence_of(outcome), outcome["errors"][0] <= WITHIN_M, RELATIONS)
        for outcome in related
        if outcome["evidence"]
    ]
    # the other factors of the model are 0 or less than 1
    known = [
        row
        for row in judged_rows
        if row[0].is_known
        and not row[0].errors
        and row[0].agreement >= GOOD_AGREEMENT
        and not row[0].doubled > 0
        and not row[0].carried > 0
    ]
    names = [name for name in COEFFICIENTS if name != "constant"]
    found = [evidence.features() for evidence, *_ in known]
    features = np.array([[1.0, *(values[name] for name in names), 0.0] for values in found])
    right, tasks = np.array([row[1] for row in known]), np.array([row[2] for row in known])
    made_up = tasks == RELATIONS
    features[made_up, -1] = 1.0
    weight = np.where(made_up, (~made_up).sum() / max(made_up.sum(), 1), 1.0)

    def solve(chosen: np.ndarray) -> dict[str, float]:
        def loss(b: np.ndarray) -> float:
            score = features[chosen] @ b
            likelihood = -(weight[chosen] * np.logaddexp(0, np.where(right[chosen], -score, score))).sum()
            return float(PRIOR_WEIGHT * ((b[1:-1] - 1) ** 2).sum() - likelihood)

        bounds = [(None, None), *[(0, None)] * len(names), (None, None)]
        best = minimize(loss, np.ones(len(bounds)), bounds=bounds).x
        return {name: round(float(b), 2) for name, b in zip(["constant", *names], best[:-1], strict=True)}

    print(f"{(~made_up).sum()} plans in simulated tasks, {right[~made_up].mean():.1%} right;", end=" ")
    print(f"{made_up.sum()} in made-up scenes, {right[made_up].mean() if made_up.any() else 0:.1%} right")
    print("COEFFICIENTS =", solve(np.ones(len(known), dtype=bool)))
    without = {task: solve(tasks != task) for task in sorted(set(tasks) - {RELATIONS})}
    print("each task with the coefficients that the others give:")
    print(table({"all": all_rows(options.folder, "tune")}, without))


def summary(rows: Sequence[Row], of_tasks: Mapping[str, Coefficients]) -> dict[str, str]:
    made = executed(rows)
    confidence, right = judged(made, of_tasks)
    passed = confidence >= GATE
    wrong, through = int((passed & ~right).sum()), int(passed.sum())
    low, high = wilson_interval(wrong, through)
    return {
        "cases": f"{len(rows)}",
        "refused": f"{len(rows) - len(made)}",
        "plans, right": f"{len(made)}, {int(right.sum())}",
        "right ones that pass": f"{passed[right].mean():.0%}" if right.any() else "–",
        "wrong among those that pass": f"{wrong} of {through}: {wrong / max(through, 1):.1%} ({low:.1%} to {high:.1%})",
        "AUROC": f"{auroc(confidence, right):.3f}",
        "with refusals": f"{auroc(*judged(rows, of_tasks)):.3f}",
    }


def table(parts: Mapping[str, Sequence[Row]], of_tasks: Mapping[str, Coefficients] = MappingProxyType({})) -> str:
    """Markdown: the `summary` of each part; ``of_tasks`` are coefficients for single tasks."""
    lines = {name: summary(rows, of_tasks) for name, rows in parts.items() if rows}
    columns = list(next(iter(lines.values())))
    head = ["| | " + " | ".join(columns) + " |", "| --- " * (len(columns) + 1) + "|"]
    return "\n".join(head + [f"| {name} | " + " | ".join(line.values()) + " |" for name, line in lines.items()])


def judged(
    rows: Sequence[Row], of_tasks: Mapping[str, Coefficients] = MappingProxyType({})
) -> tuple[np.ndarray, np.ndarray]:
    """Confidence of each row, and whether its plan is right; a refused one's is the plan made without checks."""
    confidence = np.array([confidence_of(row, of_tasks.get(row["task"], COEFFICIENTS)) for row in rows])
    return confidence, np.array([row["outcome"] == "success" for row in rows], dtype=bool)


def report(options: argparse.Namespace) -> None:
    rows = all_rows(options.folder, options.split)
    sound = [row for row in rows if row["fault"] == "none"]
    parts = {
        "sound scenes, usual camera": [row for row in sound if row["camera"] == "usual"],
        "sound scenes, noisy camera": [row for row in sound if row["camera"] == "noisy"],
        "faults": [row for row in rows if row["fault"] != "none"],
        "all": rows,
    }
    parts |= {f"all, {task}": [row for row in rows if row["task"] == task] for task in TASK_NAMES}
    text = table(parts)
    print(text)
    print("\nwrong plans that pass:")
    for row in executed(rows):
        if confidence_of(row) >= GATE and row["outcome"] == "failure":
            print(f"  {row['task']} {row['fault']} {row['camera']} {confidence_of(row):.2f}: {row['why']}")
    if options.write:
        (TABLES / "confidence.md").write_text(text + "\n")
        draw(executed(rows), TABLES.parent / "images" / "confidence.svg")


def draw(rows: Sequence[Row], path: Path) -> None:
    """Reliability diagram: the share of right plans against their confidence, with Wilson's 95% intervals."""
    import matplotlib.pyplot as plt

    confidence, right = judged(rows)
    edges = np.array([0, 1e-9, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 1.0 + 1e-9])
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(5, 6), height_ratios=(3, 1), sharex=True, layout="constrained")
    top.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    for low, high in pairwise(edges):
        inside = (confidence >= low) & (confidence < high)
        if inside.any():
            share, (least, most) = right[inside].mean(), wilson_interval(int(right[inside].sum()), int(inside.sum()))
            top.errorbar(confidence[inside].mean(), share, [[share - least], [most - share]], fmt="o", color="C0")
            top.annotate(f" {int(inside.sum())}", (confidence[inside].mean(), share), fontsize=8)
    top.set(ylabel="share of plans that succeed", ylim=(-0.02, 1.02))
    bottom.hist([confidence[right], confidence[~right]], bins=20, range=(0, 1), stacked=True, label=["right", "wrong"])
    bottom.set(xlabel="confidence", ylabel="plans", yscale="log")
    bottom.legend(fontsize=8)
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    running = commands.add_parser("run")
    running.add_argument("--out", type=Path, required=True)
    running.add_argument("--tasks", nargs="+", default=list(TASK_NAMES))
    running.add_argument("--faults", nargs="+", help="default: none and all of benchmarks/faults.py")
    running.add_argument("--share", type=float, default=1.0, help="of the faults, chosen by their names")
    running.add_argument("--scenes", type=int, default=2, help="new scenes for each fault")
    running.add_argument("--sound", type=int, default=8, help="times as many where nothing is wrong")
    running.add_argument("--splits", nargs="+", default=list(SPLITS), choices=SPLITS)
    running.add_argument("--cameras", nargs="+", default=["usual", "noisy"], choices=["usual", "noisy"])
    running.add_argument("--spread", type=float, default=0.0)
    running.set_defaults(run=run)
    fitting = commands.add_parser("fit")
    fitting.add_argument("folder", type=Path)
    fitting.add_argument("--relations", type=Path, default=Path("-"), help="rows of benchmarks/relations.py")
    fitting.set_defaults(run=fit)
    reporting = commands.add_parser("report")
    reporting.add_argument("folder", type=Path)
    reporting.add_argument("--split", default="test", choices=SPLITS)
    reporting.add_argument("--write", action="store_true", help="into docs/")
    reporting.set_defaults(run=report)
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
