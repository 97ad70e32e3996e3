"""Measures `regression` on seeded contaminated trajectories and writes the tables of docs/regression-benchmark.md.

python benchmarks/regression.py            # everything, a few minutes on two cores
python benchmarks/regression.py --quick    # few scenes and no networks, to see that it runs; writes nothing
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from contaminated_trajectories import KINDS, STEPS, Scene, draw_modes, draw_scene, draw_single_steps

from robust_instant_policy.evaluation.statistics import auroc
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression import (
    StudentTMixture,
    StudentTNetwork,
    StudentTNumbers,
    StudentTRegression,
    diagnose,
    robust_gripper_trajectory,
)
from robust_instant_policy.regression.network import RECIPES

PAGE = Path(__file__).parents[1] / "docs" / "regression-benchmark.md"
STYLES = ("smooth", "piecewise")
SIZES = {3: 1, 5: 2, 10: 4}  # number of candidates: maximum number of hallucinated ones
SCENES = 24  # scenes of each kind for Q = 5; half as many for other Q
CLEAN_SCENES = 100  # with no candidate hallucinated
MODE_SCENES = 100
NETWORK_SCENES = 2  # of every style and number of hallucinated ones: a fit takes seconds
TOLERANCE_M = 0.015
POINTS = np.zeros(9)  # nine coordinates of points, which share one scale
LIMITS = {"smooth": (0.95, 1.0, 1.3), "piecewise": (1.15, 1.2, 1.5)}  # of the relative error, for 0, 1, 2 of 5

Method = Callable[[list[FloatArray], FloatArray], FloatArray]


class Case(NamedTuple):
    style: str
    num: int
    hallucinated: int
    kind: str
    seed: int


class Outcome(NamedTuple):
    case: Case
    relative: dict[str, float]  # error by method, in that of the mean of the clean candidates
    key_steps: float  # error at the steps where the gripper changes, likewise
    scores: FloatArray
    flagged: np.ndarray
    wrong: np.ndarray
    coverage: float
    confidence: float
    noise: float  # of a clean candidate's points, metres
    within: bool  # whether every step's points lie within the tolerance


def resampled(candidates: list[FloatArray], times: FloatArray) -> FloatArray:
    grids = [np.linspace(0, 1, len(candidate)) for candidate in candidates]
    return np.stack(
        [
            np.stack([np.interp(times, grid, column) for column in candidate.T], axis=1)
            for grid, candidate in zip(grids, candidates, strict=True)
        ]
    )


def step_errors(trajectory: FloatArray, truth: FloatArray) -> FloatArray:
    """Mean distance ``(T,)`` of the three points, metres."""
    return np.linalg.norm((trajectory - truth).reshape(len(truth), 3, 3), axis=-1).mean(axis=1)


METHODS: dict[str, Method] = {
    "t, EM": lambda c, t: StudentTRegression(groups=POINTS).fit(c).mean(t),
    "t, EM, by number": lambda c, t: StudentTNumbers().fit(c).mean(t),
    "t-mixture": lambda c, t: StudentTMixture(groups=POINTS).fit(c).mean(t),
    "mean": lambda c, t: np.mean(resampled(c, t), axis=0),
    "median": lambda c, t: np.median(resampled(c, t), axis=0),
}
NETWORK_METHODS: dict[str, Method] = {
    "t, EM": METHODS["t, EM"],
    "t, network": lambda c, t: StudentTNetwork().fit(c).mean(t),
    "Gaussian, network": lambda c, t: StudentTNetwork(dof=np.inf).fit(c).mean(t),
}


def relative_errors(scene: Scene, methods: dict[str, Method]) -> dict[str, float]:
    points = [candidate[:, :9] for candidate in scene.candidates]
    truth = scene.truth(scene.times)[:, :9]
    oracle = step_errors(oracle_mean(scene), truth).mean()
    return {name: step_errors(fit(points, scene.times), truth).mean() / oracle for name, fit in methods.items()}


def oracle_mean(scene: Scene) -> FloatArray:
    clean = [c[:, :9] for c, wrong in zip(scene.candidates, scene.hallucinated, strict=True) if not wrong]
    return resampled(clean, scene.times).mean(axis=0)


def measure(case: Case) -> Outcome:
    scene = draw_scene(case.seed, case.style, case.num, case.hallucinated, case.kind)
    methods = METHODS if case.num == 5 else {name: METHODS[name] for name in ("t, EM", "mean", "median")}
    truth = scene.truth(scene.times)
    points = [candidate[:, :9] for candidate in scene.candidates]
    fit = StudentTRegression(groups=POINTS).fit(points)
    verdict = diagnose(fit, points)
    low, high = fit.interval(0.9, scene.times)
    change = np.flatnonzero(np.diff(truth[:, 9]))
    key = np.concatenate([change, change + 1])
    errors = step_errors(fit.mean(scene.times), truth[:, :9])
    gripper = robust_gripper_trajectory(scene.candidates, num_steps=STEPS)
    off = np.linalg.norm((gripper.actions - truth)[:, :9].reshape(STEPS, 3, 3), axis=-1).max()
    return Outcome(
        case,
        relative_errors(scene, methods),
        errors[key].mean() / step_errors(oracle_mean(scene), truth[:, :9])[key].mean(),
        verdict.scores,
        verdict.hallucinated,
        scene.hallucinated,
        float(((low <= truth[:, :9]) & (truth[:, :9] <= high)).mean()),
        gripper.confidence,
        float(np.mean([step_errors(c, truth[:, :9]).mean() for c in resampled(points, scene.times)])),
        bool(off < TOLERANCE_M),
    )


def measure_modes(job: tuple[str, tuple[int, ...], int]) -> tuple[bool, bool, bool]:
    """Whether the number of modes is correct, one mode is followed throughout, and it is one of the largest."""
    style, sizes, seed = job
    scene = draw_modes(seed, style, sizes)
    mixture = StudentTMixture(groups=POINTS).fit([candidate[:, :9] for candidate in scene.candidates])
    ways = [way(scene.times)[:, :9] for way in scene.ways]
    if len(ways) == 1:
        return mixture.num_modes == 1, mixture.num_modes == 1, True
    worst = [step_errors(mixture.mean(scene.times), way).max() for way in ways]
    chosen = int(np.argmin(worst))
    apart = min(step_errors(ways[chosen], way).max() for k, way in enumerate(ways) if k != chosen)
    return mixture.num_modes == len(sizes), bool(worst[chosen] < 0.25 * apart), sizes[chosen] == max(sizes)


def measure_single_steps(job: tuple[str, float, int]) -> dict[str, float]:
    """Share of steps further than the tolerance from the truth, when single steps of all candidates are bad."""
    style, rate, seed = job
    scene = draw_single_steps(seed, style, 5, rate)
    truth = scene.truth(scene.times)[:, :9]
    points = [candidate[:, :9] for candidate in scene.candidates]
    errors = {
        name: step_errors(fit(points, scene.times), truth) for name, fit in METHODS.items() if name != "t-mixture"
    }
    errors["one candidate"] = step_errors(resampled(points[:1], scene.times)[0], truth)
    return {name: float((error > TOLERANCE_M).mean()) for name, error in errors.items()}


def table(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def figure(value: float) -> str:
    return f"{value:.2f}" if value < 100 else f"{value:.0f}"


def cases(scenes: int, clean: int) -> list[Case]:
    result = []
    for style in STYLES:
        for num, most in SIZES.items():
            count = scenes if num == 5 else scenes // 2
            result += [Case(style, num, 0, "offset", seed) for seed in range(clean if num == 5 else clean // 2)]
            result += [
                Case(style, num, wrong, kind, seed)
                for wrong in range(1, most + 1)
                for kind in KINDS
                for seed in range(count)
            ]
    return result


def error_tables(outcomes: list[Outcome]) -> str:
    groups: dict[tuple, list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        case = outcome.case
        groups[case.style, case.num, case.hallucinated, case.kind if case.hallucinated else "none"].append(outcome)
    text = ""
    for style in STYLES:
        rows = []
        for (cell_style, num, wrong, kind), cell in groups.items():
            if (cell_style, num) == (style, 5):
                median = {name: np.median([outcome.relative[name] for outcome in cell]) for name in METHODS}
                limit = LIMITS[style][wrong]
                mark = "" if median["t, EM"] <= limit else " ✗"
                key = figure(float(np.median([outcome.key_steps for outcome in cell])))
                values = [figure(float(value)) for value in median.values()]
                rows.append([f"{wrong} of 5", kind, f"{limit:.2f}{mark}", *values, key])
        text += f"\n### {style.capitalize()} truths, Q = 5\n\n"
        text += table(["hallucinated", "kind", "goal", *METHODS, "t, EM, at grasps"], rows)
    rows = []
    for style in STYLES:
        for num in SIZES:
            for wrong in range(SIZES[num] + 1):
                cell = [o for key, group in groups.items() if key[:3] == (style, num, wrong) for o in group]
                median = [figure(float(np.median([o.relative[n] for o in cell]))) for n in ("t, EM", "mean", "median")]
                rows.append([style, f"{wrong} of {num}", *median])
    text += "\n### All kinds together\n\n" + table(["truths", "hallucinated", "t, EM", "mean", "median"], rows)
    return text


def diagnosis_table(outcomes: list[Outcome]) -> str:
    rows = []
    for num in (*SIZES, "all"):
        for kind in (*KINDS, "all") if num == "all" else ("all",):
            chosen = [
                o
                for o in outcomes
                if (num in ("all", o.case.num)) and (kind == "all" or not o.case.hallucinated or o.case.kind == kind)
            ]
            wrong = np.concatenate([o.wrong for o in chosen])
            scores = np.concatenate([o.scores for o in chosen])
            flagged = np.concatenate([o.flagged for o in chosen])
            rows.append(
                [
                    str(num),
                    kind,
                    f"{auroc(scores, wrong):.4f}",
                    f"{flagged[wrong].mean():.1%}",
                    f"{flagged[~wrong].mean():.1%}",
                ]
            )
    return table(["Q", "kind", "AUROC", "hallucinated ones flagged", "clean ones flagged"], rows)


def coverage_table(outcomes: list[Outcome]) -> str:
    rows = []
    for num, most in SIZES.items():
        for wrong in range(most + 1):
            covered = [[o.coverage for o in outcomes if o.case[:3] == (style, num, wrong)] for style in STYLES]
            rows.append([f"{wrong} of {num}", *[f"{np.mean(cell):.1%}" for cell in covered]])
    return table(["hallucinated", *[f"{style} truths" for style in STYLES]], rows)


def confidence_table(outcomes: list[Outcome]) -> str:
    edges = [0.0, 0.5, 0.9, 0.99, 0.999, 1.0 + 1e-9]
    rows = []
    for low, high in pairwise(edges):
        cell = [o.within for o in outcomes if low <= o.confidence < high]
        if cell:
            rows.append([f"{low:g} to {min(high, 1):g}", str(len(cell)), f"{np.mean(cell):.1%}"])
    return table(["confidence", "trajectories", f"within {TOLERANCE_M * 1e3:.0f} mm at every step"], rows)


def modes_table(pool: ProcessPoolExecutor, scenes: int) -> str:
    rows = []
    for sizes in ((5,), (10,), (3, 2), (5, 5), (4, 3, 3)):
        jobs = [(style, sizes, seed) for style in STYLES for seed in range(scenes)]
        found, coherent, largest = np.mean(list(pool.map(measure_modes, jobs, chunksize=8)), axis=0)
        rows.append(["+".join(map(str, sizes)), str(len(jobs)), f"{found:.1%}", f"{coherent:.1%}", f"{largest:.1%}"])
    header = ["candidates per mode", "scenes", "number of modes found", "one coherent mode", "a mode with most support"]
    return table(header, rows)


def single_steps_table(pool: ProcessPoolExecutor, scenes: int) -> str:
    rows, names = [], []
    for style in STYLES:
        for rate in (0.1, 0.3, 0.5):
            jobs = [(style, rate, seed) for seed in range(scenes)]
            shares = list(pool.map(measure_single_steps, jobs, chunksize=8))
            names = list(shares[0])
            rows.append(
                [style, f"{rate:.0%}", *[f"{np.mean([share[name] for share in shares]):.1%}" for name in names]]
            )
    return table(["truths", "bad steps", *names], rows)


def network_tables(scenes: int) -> str:
    rows = []
    for style in STYLES:
        for wrong in range(3):
            kinds = list(KINDS)
            drawn = [draw_scene(seed, style, 5, wrong, kinds[seed % len(kinds)]) for seed in range(scenes)]
            ratios = [relative_errors(scene, NETWORK_METHODS) for scene in drawn]
            median = [figure(float(np.median([ratio[name] for ratio in ratios]))) for name in NETWORK_METHODS]
            rows.append([style, f"{wrong} of 5", *median])
    return table(["truths", "hallucinated", *NETWORK_METHODS], rows)


def seconds(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Fastest and median wall time."""
    spent = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        spent.append(time.perf_counter() - start)
    return min(spent), float(np.median(spent))


def time_table() -> str:
    rng = np.random.default_rng(0)
    scene = next(
        scene
        for scene in (draw_scene(seed, "piecewise", 5, 1, "offset") for seed in range(100))
        if {len(candidate) for candidate in scene.candidates} == {STEPS}
    )
    walk = np.cumsum(np.cumsum(rng.normal(size=(1000, 10)), axis=0), axis=0) * 3e-4
    many = list(walk + rng.normal(0, 0.003, (100, 1000, 10)))
    many[0] = many[0] + 0.05
    entries = {
        "t, EM: Q=5, T=30, D=10": (lambda: StudentTRegression().fit(scene.candidates), 200),
        "robust_gripper_trajectory: Q=5, T=30, one arm": (lambda: robust_gripper_trajectory(scene.candidates), 100),
        "t-mixture: Q=5, T=30, D=10": (lambda: StudentTMixture().fit(scene.candidates), 100),
        "t, EM: Q=100, T=1000, D=10": (lambda: StudentTRegression().fit(many), 5),
    }
    measured = {name: seconds(work, repeats) for name, (work, repeats) in entries.items()}
    rows = [[name, f"{best * 1e3:.2f} ms", f"{median * 1e3:.2f} ms"] for name, (best, median) in measured.items()]

    losses = []
    plain_start = time.perf_counter()
    plain = StudentTNetwork(recipe="sim").fit(scene.candidates)
    plain_seconds = time.perf_counter() - plain_start
    losses.append(plain.loss)
    fast_start = time.perf_counter()
    fast = StudentTNetwork(target=plain.loss).fit(scene.candidates)
    fast_seconds = time.perf_counter() - fast_start
    rows += [
        [
            f"network, the paper's recipe ({RECIPES['sim'].steps} steps of Adam), loss {plain.loss:.3f}",
            "",
            f"{plain_seconds:.1f} s",
        ],
        [f"network, fast, to loss {fast.loss:.3f} ({fast.num_iterations} steps)", "", f"{fast_seconds:.1f} s"],
    ]
    _, usual = measured["t, EM: Q=5, T=30, D=10"]
    return table(["", "fastest", "median"], rows) + (
        f"\nIn this run the paper's recipe took {plain_seconds / usual:,.0f} times as long as the EM (median), and "
        f"{plain_seconds / fast_seconds:.1f} times as long as the fast training "
        f"{'to' if fast.loss <= plain.loss else 'that did not quite reach'} the same loss.\n"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few scenes, no networks, tables to the terminal only")
    quick = parser.parse_args().quick
    scenes, clean, modes = (1, 2, 1) if quick else (SCENES, CLEAN_SCENES, MODE_SCENES)
    start = time.perf_counter()
    parts = {}
    if not quick:
        parts["time"] = time_table()
        parts["networks"] = network_tables(NETWORK_SCENES)
    with ProcessPoolExecutor() as pool:
        outcomes = list(pool.map(measure, cases(scenes, clean), chunksize=16))
        parts["modes"] = modes_table(pool, modes)
        parts["single"] = single_steps_table(pool, scenes)
    page = PAGE_TEMPLATE.format(
        errors=error_tables(outcomes),
        diagnosis=diagnosis_table(outcomes),
        coverage=coverage_table(outcomes),
        confidence=confidence_table(outcomes),
        modes=parts["modes"],
        single=parts["single"],
        networks=parts.get("networks", ""),
        time=parts.get("time", ""),
        scenes=len(outcomes),
        noise=np.quantile([o.noise for o in outcomes if not o.case.hallucinated], [0.5, 0.1, 0.9]) * 1e3,
    )
    if quick:
        print(page)
    else:
        PAGE.write_text(page)
        print(f"wrote {PAGE} after {(time.perf_counter() - start) / 60:.1f} minutes")


PAGE_TEMPLATE = """# Regression, measured

Written by `python benchmarks/regression.py` from {scenes}
scenes, with more scenes for the later tables. The scenes are those of `benchmarks/contaminated_trajectories.py`:
gripper triplets, candidates with noise per number, per step and slowly varying along the candidate (a point of a clean
candidate is {noise[0]:.1f} mm from the truth in the median scene, {noise[1]:.1f} and {noise[2]:.1f} mm in the tenth
with least and most noise), rounded to millimetres. In a quarter of the scenes the candidates have different lengths. A
hallucination moves at least one point by 15 mm or more.

## Error against the truth

Mean distance of the three gripper points to the truth, relative to that of the oracle, which is the mean of the clean
candidates; medians over scenes. "Goal" is the limit for the default, `t, EM`; ✗ marks a missed goal. The last
column is its error at the steps where the gripper closes or opens, relative to the oracle's.
{errors}
### Networks

Fewer scenes, of mixed kinds, because each fit takes seconds. The networks use the fast recipe.

{networks}
### Single bad steps

When each step is queried separately, single steps of any candidate are wrong independently (here 3 to 10 cm off).
Share of steps more than 15 mm from the truth, Q = 5:

{single}
## Diagnosis

{diagnosis}
## Intervals

Share of steps and dimensions in which the 90% interval covers the truth:

{coverage}
## Confidence

`robust_gripper_trajectory(...).confidence` and the measured share of correct trajectories:

{confidence}
## Several modes

One coherent mode: at every step the distance to one mode is less than a quarter of the distance to the next one.

{modes}
## Time

{time}"""


if __name__ == "__main__":
    main()
