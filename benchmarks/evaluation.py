"""Speed of an evaluation with stored samples: time per part, and the gain of a second worker.

python benchmarks/evaluation.py --samples runs/speed/samples.sqlite --out docs/tables/evaluation_speed.md [--scaling]

The samples must contain the scenes of `rip eval` for the measured tasks and methods. Shares are of processor time, so
that other programs do not change them; --scaling compares the wall time of one and of two workers and needs a machine
with two idle cores.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from statistics import mean
from typing import Any

# As in the workers, otherwise prompts may differ in their last digits; must precede the import of numpy.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

from robust_instant_policy.evaluation import (
    STORE_FILE,
    Choice,
    Progress,
    Setup,
    Suite,
    Variant,
    make_suites,
    run_suites,
)
from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.evaluation.processes import LocalWorkers
from robust_instant_policy.evaluation.work import SceneWork
from robust_instant_policy.evaluation.workbench import Workbench
from robust_instant_policy.llm import model_name

METHODS = ("rip", "rip-gauss", "mean", "kat")
PARTS = ("planning", "building scenes", "rendering", "physics")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("data"))
    parser.add_argument("--samples", type=Path, required=True)
    parser.add_argument("--tasks", nargs="+", default=["push-cube", "turn-faucet", "pick-banana"])
    parser.add_argument("--objects", choices=("seen", "unseen"), default="seen")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--scaling", action="store_true")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    base = Variant("rip", model=model_name("embedded"))
    choice = Choice(base, options.tasks, METHODS, options.episodes, objects=options.objects)
    (suite,) = make_suites(["table1"], choice)
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / STORE_FILE
        shutil.copy(options.samples, store)
        setup = Setup("embedded", True, store, options.data, 300.0, films=False)
        lines = _shares(suite, setup)
        if options.scaling:
            lines += ["", *_scaling(suite, setup, Path(folder))]
    lines += ["", f"{os.cpu_count()} cores; load of the machine while measuring {os.getloadavg()[1]:.1f}."]
    text = "\n".join(lines) + "\n"
    print(text)
    if options.out:
        options.out.write_text(text)


def _shares(suite: Suite, setup: Setup) -> list[str]:
    """One worker with timed parts; the time before the second scene of a task (simulator, fitting) is excluded."""
    lines = [
        f"| task | executions | in a minute of a core | {' | '.join(PARTS)} | rest |",
        f"| --- | --- | --- | {' | '.join('---' for _ in PARTS)} | --- |",
    ]
    bench = Workbench(setup)
    for task in suite.tasks:
        first, *others = [scene for scene in suite.scenes if scene.task == task]
        list(bench.run(SceneWork(first, suite.variants)))
        spent: dict[str, float] = defaultdict(float)
        undo = _time_parts(bench, spent)
        start = time.process_time()
        rows = [row for scene in others for row in bench.run(SceneWork(scene, suite.variants)) if _is_episode(row)]
        seconds = time.process_time() - start
        undo()
        shares = [spent[part] / seconds for part in PARTS]
        cells = " | ".join(f"{share:.0%}" for share in (*shares, 1 - sum(shares)))
        lines.append(f"| {task} | {len(rows)} | {60 * len(rows) / seconds:.0f} | {cells} |")
    bench.close()
    return lines


def _is_episode(outcome: object) -> bool:
    return isinstance(outcome, Episode)


def _time_parts(bench: Workbench, spent: dict[str, float]) -> Callable[[], None]:
    """Make the parts of `bench` add their time to ``spent``; returns a function that undoes it."""
    task: Any = bench._task
    cell = next(value for value in vars(task).values() if hasattr(value, "photograph"))
    undo = []

    def timed(owner: Any, name: str, part: str, without: str | None = None) -> None:
        original = getattr(owner, name)

        def call(*arguments: Any, **named: Any) -> Any:
            start, before = time.process_time(), spent[without] if without else 0.0
            result = original(*arguments, **named)
            inner = spent[without] - before if without else 0.0
            spent[part] += time.process_time() - start - inner
            return result

        setattr(owner, name, call)
        undo.append((owner, name))

    timed(cell, "photograph", "rendering")
    timed(task, "reset", "building scenes", without="rendering")
    timed(task, "execute", "physics")
    for policy in bench._policies.values():
        timed(policy, "plan", "planning")

    def restore() -> None:
        for owner, name in undo:
            delattr(owner, name)

    return restore


def _scaling(suite: Suite, setup: Setup, folder: Path) -> list[str]:
    """The whole suite with 1, 2, 2 and 1 workers, so that a drift of the machine's speed affects both equally."""
    lines = ["| workers | executions | seconds | a minute, from the first row on |", "| --- | --- | --- | --- |"]
    rates: dict[int, list[float]] = {1: [], 2: []}
    for turn, workers in enumerate((1, 2, 2, 1)):
        arrivals: list[float] = []

        def outcome(done: int, total: int, what: object, arrivals: list[float] = arrivals) -> None:
            if _is_episode(what):
                arrivals.append(time.perf_counter())

        start = time.perf_counter()
        progress = Progress(outcome=outcome)
        run_suites([suite], setup, folder / f"turn-{turn}", LocalWorkers(workers), progress)
        rates[workers].append(60 * (len(arrivals) - 1) / (arrivals[-1] - arrivals[0]))
        lines.append(f"| {workers} | {len(arrivals)} | {arrivals[-1] - start:.0f} | {rates[workers][-1]:.0f} |")
    ratio = mean(rates[2]) / mean(rates[1])
    return [*lines, "", f"Two workers execute {ratio:.2f} times as much in a minute as one."]


if __name__ == "__main__":
    main()
