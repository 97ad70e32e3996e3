"""Adaptive and fixed Q: share of correct plans, and their cost.

    python benchmarks/adaptive_queries.py                           # simulated keypoints, embedded model; docs/tables/
    python benchmarks/adaptive_queries.py --run runs/simulation     # also the executions of `rip eval`

Scenes with simulated keypoints (`pick_and_place.py`): ten samples each are stored in `runs/adaptive_queries.sqlite`.
Some are then replaced by hallucinations: the same answer, decoded in the scene of a demonstration, a different one for
each, so that the whole candidate is wrong. Adaptive Q starts with three samples and adds one while the agreement is too
low, ten at most. A run of `rip eval` must hold the methods `rip` and `rip-adaptive`.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from pick_and_place import WITHIN_M, PickAndPlace, Scene, key_error
from prompting import FIRST_NEW_SEED, NUM_DEMOS, fitted

from robust_instant_policy.llm import Listener, RecordedModel, SampleStore, Sampling, connect
from robust_instant_policy.policies.rip import ENOUGH_AGREEMENT
from robust_instant_policy.policies.sampling import MIN_CANDIDATES as FIRST_QUERIES
from robust_instant_policy.regression import robust_gripper_trajectory
from robust_instant_policy.trajectory import Trajectory

ROOT = Path(__file__).parents[1]
STORE, TABLE = ROOT / "runs" / "adaptive_queries.sqlite", ROOT / "docs" / "tables" / "adaptive_queries.md"
MOST = 10  # samples per scene
TEMPERATURE = 0.7
SHARES = (0.0, 0.2, 0.4)  # of the candidates that are hallucinated
DRAWS = 10  # of the hallucinated candidates, per scene
THRESHOLDS = tuple(sorted({0.2, 0.3, 0.4, 0.6, 0.8, ENOUGH_AGREEMENT}))


@dataclass(frozen=True, eq=False)
class Sampled:
    """A scene, its candidates, the same answers decoded in another scene, and the cost of each further candidate."""

    scene: Scene
    candidates: Sequence[Trajectory]
    elsewhere: Sequence[Trajectory]
    tokens: Sequence[int]
    curvature: np.ndarray


@dataclass(frozen=True)
class Planned:
    error: float
    confidence: float


def sampled(scenes: int) -> list[Sampled]:
    world = PickAndPlace()
    demos = [world.scene(seed) for seed in range(NUM_DEMOS)]
    prompt = fitted(demos, "adaptive", "factorised")
    model = RecordedModel(connect("embedded"), SampleStore(STORE))
    result = []
    for number in range(scenes):
        scene = world.scene(FIRST_NEW_SEED + number, exact=True)
        sampling = Sampling(MOST, TEMPERATURE, seed=number, deadline_s=600.0)
        answers = model.sample(prompt.queries(scene.keypoints), sampling, Listener(prompt.read))
        values = [[of_query[index].value for of_query in answers] for index in range(min(map(len, answers)))]
        costs = [
            sum(a.prompt_tokens - a.cached_tokens + a.completion_tokens for a in (q[index] for q in answers))
            for index in range(len(values))
        ]
        result.append(
            Sampled(
                scene,
                [prompt.trajectory(read, scene.keypoints) for read in values],
                [prompt.trajectory(read, demo.keypoints) for read, demo in zip(values, demos, strict=False)],
                costs,
                prompt.curvature,
            )
        )
        print(f"scene {number + 1} of {scenes}", flush=True)
    model.close()
    return result


def planned(scene: Scene, candidates: Sequence[Trajectory], curvature: np.ndarray) -> Planned:
    robust = robust_gripper_trajectory([candidate.actions for candidate in candidates], curvature=curvature)
    return Planned(key_error(Trajectory.from_actions(robust.actions), scene.trajectory), robust.confidence)


@dataclass(frozen=True)
class Line:
    share: float
    asking: str
    right: float
    queries: float
    more: float
    tokens: float


def made_up(scenes: int) -> list[Line]:
    lines = []
    drawn = sampled(scenes)
    for share in SHARES:
        cases = []
        for number, one in enumerate(drawn):
            for draw in range(DRAWS if share else 1):
                wrong = np.random.default_rng([number, draw]).random(len(one.candidates)) < share
                mixed = [e if w else c for c, e, w in zip(one.candidates, one.elsewhere, wrong, strict=True)]
                plans = {
                    count: planned(one.scene, mixed[:count], one.curvature) for count in range(FIRST_QUERIES, MOST + 1)
                }
                cases.append((one, plans))

        def line(asking: str, choose: Callable[[dict[int, Planned]], int], of=cases, share=share) -> Line:
            counts = [choose(plans) for _, plans in of]
            return Line(
                share,
                asking,
                float(np.mean([plans[n].error <= WITHIN_M for n, (_, plans) in zip(counts, of, strict=True)])),
                float(np.mean(counts)),
                float(np.mean(np.array(counts) > FIRST_QUERIES)),
                float(np.mean([sum(one.tokens[:n]) for n, (one, _) in zip(counts, of, strict=True)])),
            )

        for count in (FIRST_QUERIES, 5, MOST):
            lines.append(line(f"Q = {count}", lambda plans, count=count: count))
        for threshold in THRESHOLDS:
            name = f"adaptive, until {threshold:g}" + (" (the default)" if threshold == ENOUGH_AGREEMENT else "")
            lines.append(
                line(
                    name,
                    lambda plans, threshold=threshold: next(
                        (n for n in sorted(plans) if plans[n].confidence >= threshold), MOST
                    ),
                )
            )
    return lines


def executed(folder: Path) -> list[str]:
    """Success and tokens of the two methods over the scenes in which both were executed."""
    columns = ["task", "objects", "seed", "method", "success", "tokens"]
    rows = pq.read_table(folder / "episodes.parquet", columns=columns).to_pylist()
    by_task: dict[str, dict[str, dict[tuple[str, int], dict]]] = defaultdict(lambda: defaultdict(dict))
    for row in rows:
        by_task[row["task"]][row["method"]][row["objects"], row["seed"]] = row
    lines = [
        "| task | scenes | success, Q = 5 | success, adaptive | tokens, Q = 5 | tokens, adaptive "
        "| plans with fewer than five |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for task, methods in by_task.items():
        fixed, adaptive = methods["rip"], methods["rip-adaptive"]
        both = sorted(fixed.keys() & adaptive.keys())
        if not both:
            continue
        # Both use the same samples, so fewer tokens mean fewer samples.
        fewer = np.mean([adaptive[scene]["tokens"] < fixed[scene]["tokens"] for scene in both])
        lines.append(
            f"| {task} | {len(both)} "
            + "".join(f"| {np.mean([own[scene]['success'] for scene in both]):.0%} " for own in (fixed, adaptive))
            + "".join(f"| {np.mean([own[scene]['tokens'] for scene in both]):.0f} " for own in (fixed, adaptive))
            + f"| {fewer:.0%} |"
        )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--run", type=Path, help="folder of a `rip eval` with rip and rip-adaptive")
    args = parser.parse_args()
    text = (
        f"Simulated keypoints, embedded model at temperature {TEMPERATURE:g}, {args.scenes} scenes, "
        f"{DRAWS} draws of the hallucinations in each.\n\n"
        f"| hallucinated | asked | within {1000 * WITHIN_M:.0f} mm | queries a plan | plans with more than "
        f"{FIRST_QUERIES} | tokens a plan |\n| --- | --- | --- | --- | --- | --- |\n"
    )
    for line in made_up(args.scenes):
        text += (
            f"| {line.share:.0%} | {line.asking} | {line.right:.0%} | {line.queries:.1f} | {line.more:.0%} "
            f"| {line.tokens:.0f} |\n"
        )
    if args.run is not None:
        text += "\nExecutions in the simulated tasks.\n\n" + "\n".join(executed(args.run)) + "\n"
    TABLE.write_text(text)
    print(text)


if __name__ == "__main__":
    main()
