"""Success in the simulator against hallucinations, in the paper's configuration, with a stand-in for a language model.

    python benchmarks/hallucinations.py run --scenes 20 --out runs/hallucinations    # goes on where it stopped
    python benchmarks/hallucinations.py report runs/hallucinations

The trajectories come from `stand_in.Server`, which is no language model: it answers the paper's prompts at a rate of
hallucinations that is set. Everything else is the paper's configuration, with two parts that can be had offline:
EfficientNet's descriptors instead of DINO's, and Eq. 2 minimised by EM instead of by training the networks.

- the rate: 0 to 60%, by `kat`, `mean`, `rip-gauss` and `rip` (compare Fig. 5b of Oh et al. 2025);
- at 30%: Q, ν and downsampling (their Fig. 6).

A sound answer is the same at every rate, so many plans of a scene are equal. The simulator is deterministic: equal
trajectories in one scene are executed once, and the rows of all of them tell the outcome.

`report` copies the rows to `results/hallucinations` and writes the table and the figure of the documentation.
"""

from __future__ import annotations

import argparse
import math
import shutil
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from stand_in import NAME, Server

from robust_instant_policy.commands.options import natural, positive
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.evaluation import (
    Scene,
    Setup,
    Suite,
    Variant,
    read_results,
    run_suites,
    scene_seed,
    workbench,
)
from robust_instant_policy.evaluation.experiment import Progress
from robust_instant_policy.evaluation.statistics import Summary
from robust_instant_policy.evaluation.store import EPISODES_FILE
from robust_instant_policy.evaluation.suites import SIMULATION_TASKS
from robust_instant_policy.evaluation.work import Outcome, SceneWork
from robust_instant_policy.files import write_whole
from robust_instant_policy.llm import connect
from robust_instant_policy.policies import Settings
from robust_instant_policy.reporting.figures import PARAMETERS, STYLES, encode
from robust_instant_policy.reporting.tables import NONE, Table
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.task import Execution, FrameSink
from robust_instant_policy.trajectory import Trajectory

ROOT = Path(__file__).parents[1]
KEPT = ROOT / "results" / "hallucinations"
TABLE, FIGURE = ROOT / "docs/tables/hallucinations.md", ROOT / "docs/images/hallucinations.svg"
RATES = (0, 10, 20, 30, 40, 50, 60)  # percent
METHODS = ("kat", "mean", "rip-gauss", "rip")
SWEEP_RATE = 30  # percent, at which Q, ν and downsampling are varied
QUERIES, DOFS, WAYS = (2, 3, 5, 10), (1.25, 1.5, 3.0, math.inf), ("uniform", "masked")
BLOCKS = (1, 2, 4, 7, 10, 15, 20)  # scenes after which every cell has equally many
TITLE = "Trajectories from a stand-in (no language model) that hallucinates at a given rate"


class RememberingTask:
    """A task that executes equal trajectories in a scene once."""

    def __init__(self, task: Any):
        self._task, self._seed = task, 0
        self._known: dict[tuple[int, bytes], Execution] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._task, name)

    def reset(self, seed: int) -> Observation:
        self._seed = seed
        return self._task.reset(seed)

    def execute(self, trajectory: Trajectory, on_frame: FrameSink | None = None) -> Execution:
        """Raises `UnreachableError` again where it was raised before: nothing is remembered of that."""
        key = self._seed, trajectory.times.tobytes() + trajectory.actions.tobytes()
        if key not in self._known:
            self._known[key] = self._task.execute(trajectory, on_frame)
        return self._known[key]


def base(rate: int) -> Variant:
    settings = Settings.of("paper")
    return Variant(
        "rip",
        frames=settings.frames,
        layout=settings.layout,
        keypoints=settings.keypoints,
        column=settings.column,
        estimator="em-number",
        features="efficientnet",
        model=f"{NAME}-{rate}",
    )


def of_rate(rate: int) -> tuple[Variant, ...]:
    return tuple(replace(base(rate), method=method) for method in METHODS)


def sweeps() -> dict[str, dict[str, Variant]]:
    """What is varied at `SWEEP_RATE`, by name and value."""
    rip = base(SWEEP_RATE)
    return {
        "queries Q": {str(queries): replace(rip, queries=queries) for queries in QUERIES},
        "degrees of freedom ν": {"∞" if math.isinf(dof) else f"{dof:g}": replace(rip, dof=dof) for dof in DOFS},
        "downsampling": {way: replace(rip, downsampling=way) for way in WAYS},
    }


def suites(rate: int, tasks: Sequence[str], scenes: int) -> list[Suite]:
    seeds = tuple(scene_seed(0, index, "test") for index in range(scenes))
    own = [of_rate(rate)]
    if rate == SWEEP_RATE:
        own += [tuple(varied.values()) for varied in sweeps().values()]
    return [Suite("chosen", tuple(tasks), tuple(dict.fromkeys(one for part in own for one in part)), seeds)]


def run(out: Path, data: Path, tasks: Sequence[str], rates: Sequence[int], scenes: int) -> None:
    """Every cell for a few scenes, then for more: one simulator serves all rates of a task."""
    server = Server()
    threading.Thread(target=server.serve_forever, daemon=True).start()

    def setup(rate: int) -> Setup:
        spec = f"{server.url}#{NAME}-{rate}"
        return Setup(spec, False, out / "samples.sqlite", data, 300.0, films=False, analyses=False)

    workbench.make_task = lambda *arguments: RememberingTask(make_task(*arguments))
    with closing(workbench.Workbench(setup(0))) as bench:

        def here(setup: Setup, works: list[SceneWork]) -> Iterator[Outcome]:
            bench.model = connect(setup.llm)  # a cached property
            for work in works:
                yield from bench.run(work)

        for until in [*(block for block in BLOCKS if block < scenes), scenes]:
            for task in tasks:
                for rate in rates:
                    run_suites(suites(rate, [task], until), setup(rate), out, here, Progress(), sys.argv, keep=True)
                print(f"{task}: {until} scenes", flush=True)
    server.shutdown()


@dataclass(frozen=True)
class Cell:
    """The success of a variant over all tasks: rate, interval by scene, number of scenes."""

    value: float
    low: float
    high: float
    scenes: int

    def __str__(self) -> str:
        return f"{100 * self.value:.0f} ({100 * self.low:.0f} to {100 * self.high:.0f})"


class Cells:
    """The cells of a run, in the scenes in which every variant was tried in every task."""

    def __init__(self, out: Path):
        episodes = [row for row in read_results(out).episodes if row.variant.model.startswith(NAME)]
        plain = [
            replace(row, variant=replace(row.variant, code="", demonstrations="", deadline_s=None)) for row in episodes
        ]
        wanted = {one for rate in RATES for suite in suites(rate, SIMULATION_TASKS, 1) for one in suite.variants}
        tried: dict[Scene, set[Variant]] = {}
        for row in plain:
            tried.setdefault(row.scene, set()).add(row.variant)
        whole = {(scene.task, scene.seed) for scene, variants in tried.items() if wanted <= variants}
        seeds = [
            seed
            for seed in dict.fromkeys(scene.seed for scene in tried)
            if all((task, seed) in whole for task in SIMULATION_TASKS)
        ]
        suite = Suite("chosen", SIMULATION_TASKS, tuple(wanted), tuple(seeds))
        self.scenes_a_task = len(seeds)
        self._summary = Summary(suite, [row for row in plain if row.scene.seed in seeds])
        self.executions = len(self._summary.rows)

    def __getitem__(self, variant: Variant) -> Cell | None:
        rate = self._summary.rate(variant)
        return None if rate is None else Cell(rate.value, *rate.interval, rate.scenes)


def table(cells: Cells) -> Table:
    rows = [(f"{rate}% hallucinated", *(str(cells[one] or NONE) for one in of_rate(rate))) for rate in RATES]
    for name, varied in sweeps().items():
        for value, variant in varied.items():
            rows.append((f"{SWEEP_RATE}%, {name} = {value}", *[NONE] * (len(METHODS) - 1), str(cells[variant] or NONE)))
    return Table(
        (TITLE, *METHODS),
        tuple(rows),
        "Success in percent over all scenes; in parentheses the 95% interval by scene (Wilson's, one trial a scene). "
        "Configuration: paper, but for descriptors of EfficientNet-lite0 and Eq. 2 by EM; ten demonstrations, Q = 5, "
        "ν = 1.5 and masked downsampling unless varied. kat executes each of its five answers. With Eq. 2 by EM "
        f"rip-gauss and mean are the same trajectory. {cells.scenes_a_task} scenes of each of "
        f"{', '.join(SIMULATION_TASKS)}; {cells.executions} executions.",
    )


def draw(cells: Cells) -> Figure:
    with matplotlib.rc_context(PARAMETERS):
        figure = Figure(figsize=(7.0, 4.6), layout="constrained")
        wide, *narrow = figure.subplot_mosaic([["rate"] * 3, list(sweeps())], height_ratios=(1.3, 1)).values()
        for number, method in enumerate(METHODS):
            known = [(rate, cell) for rate in RATES if (cell := cells[replace(base(rate), method=method)])]
            _line(wide, [rate + 0.4 * (number - 1.5) for rate, _ in known], [cell for _, cell in known], method)
        wide.set_xlabel("answers that are hallucinated [%]")
        wide.set_ylabel("success [%]")
        wide.legend(loc="lower left")
        for axes, (name, varied) in zip(narrow, sweeps().items(), strict=True):
            known = [(value, cell) for value, variant in varied.items() if (cell := cells[variant])]
            _line(axes, list(range(len(known))), [cell for _, cell in known], "rip")
            axes.set_xticks(range(len(known)), [value for value, _ in known])
            axes.set_xlabel(f"{name}, at {SWEEP_RATE}%")
            axes.set_xlim(-0.4, len(known) - 0.6)
        narrow[0].set_ylabel("success of rip [%]")
        for axes in (wide, *narrow):
            axes.set_ylim(0, 104)
            axes.grid(axis="y", linewidth=0.3, color="#bbbbbb")
            axes.set_axisbelow(True)
        figure.suptitle(
            f"{TITLE};\n{cells.scenes_a_task} scenes of each of five tasks, 95% intervals by scene", fontsize=8
        )
        return figure


def _line(axes: Axes, places: Sequence[float], cells: Sequence[Cell], method: str) -> None:
    style = STYLES[method]
    values = [100 * cell.value for cell in cells]
    whiskers = [[100 * (cell.value - cell.low) for cell in cells], [100 * (cell.high - cell.value) for cell in cells]]
    axes.errorbar(places, values, whiskers, fmt="none", ecolor="#777777", elinewidth=0.6, capsize=1.5)
    axes.plot(
        places, values, style.marker, linestyle=style.line, color="black", markerfacecolor=style.colour,
        markeredgewidth=0.5, markersize=5, linewidth=0.9, label=method,
    )  # fmt: skip


def report(out: Path) -> None:
    if out.resolve() != KEPT.resolve():
        KEPT.mkdir(parents=True, exist_ok=True)
        for name in ("episodes.parquet", "failures.parquet", "run.json"):
            shutil.copy(out / name, KEPT / name)
    cells = Cells(KEPT)
    TABLE.write_text(table(cells).markdown())
    write_whole(FIGURE, encode(draw(cells), "svg"))
    print(TABLE.read_text())


def percent(text: str) -> int:
    """A whole number from 0 to 100."""
    if (number := natural(text)) > 100:
        raise argparse.ArgumentTypeError("must be at most 100")
    return number


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    running = commands.add_parser("run")
    running.add_argument("--out", type=Path, default=Path("runs/hallucinations"))
    running.add_argument("--data", type=Path, default=Path("data"))
    running.add_argument("--tasks", nargs="+", default=list(SIMULATION_TASKS))
    running.add_argument("--rates", nargs="+", type=percent, metavar="PERCENT", default=list(RATES))
    running.add_argument("--scenes", type=positive, default=20)
    commands.add_parser("report").add_argument("out", type=Path)
    options = parser.parse_args()
    if options.command == "run":
        run(options.out, options.data, options.tasks, options.rates, options.scenes)
    else:
        if not (options.out / EPISODES_FILE).exists():
            parser.error(f"{options.out} holds no rows; write them with: hallucinations.py run --out {options.out}")
        report(options.out)


if __name__ == "__main__":
    main()
