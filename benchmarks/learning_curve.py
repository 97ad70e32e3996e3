"""Success of trained methods over the number of training steps, from runs of `rip eval` with several `--steps`.

python benchmarks/learning_curve.py results/baselines/curve --table docs/tables/learning_curve.md --figure FILE.svg

`training.json` in the folder says where each training ran and for how long.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import matplotlib
import matplotlib.ticker
from matplotlib.figure import Figure

from robust_instant_policy.evaluation import Episode, read_results
from robust_instant_policy.evaluation.statistics import Rate, Summary
from robust_instant_policy.evaluation.suites import Suite
from robust_instant_policy.policies import METHOD_NAMES
from robust_instant_policy.reporting.figures import PARAMETERS, STYLES, encode

Point = tuple[str, str, int]  # task, method, training steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder written by rip eval, with training.json")
    parser.add_argument("--table", type=Path, required=True)
    parser.add_argument("--figure", type=Path, required=True)
    options = parser.parse_args()
    curve = rates(read_results(options.run).episodes)
    trained = {
        (one["task"], one["method"], one["steps"]): f"{one['seconds']} s on one {one['device']}"
        for one in json.loads((options.run / "training.json").read_text())
    }
    head = ("task", "method", "training steps", "success", "95% interval", "training")
    lines = [f"| {' | '.join(head)} |", "|" + " --- |" * len(head)]
    for (task, method, steps), rate in curve.items():
        low, high = rate.interval
        shown = f"{rate.value:.0%} | {low:.0%} to {high:.0%} | {trained[task, method, steps]}"
        lines.append(f"| {task} | {method} | {steps} | {shown} |")
    options.table.write_text("\n".join(lines) + "\n")
    options.figure.write_bytes(encode(figure(curve), "svg"))
    print(options.table.read_text())


def rates(episodes: tuple[Episode, ...]) -> dict[Point, Rate]:
    """By task, method and steps, in the order of the table."""
    points: dict[Point, list[Episode]] = defaultdict(list)
    for row in episodes:
        if row.variant.steps is not None:
            points[row.scene.task, row.variant.method, row.variant.steps].append(row)
    found = {}
    for point in sorted(points, key=lambda one: (one[0], METHOD_NAMES.index(one[1]), one[2])):
        rows = points[point]
        scenes = tuple(dict.fromkeys(row.scene.seed for row in rows))
        variant = replace(rows[0].variant, demonstrations="")
        rate = Summary(Suite("chosen", (point[0],), (variant,), scenes), rows).rate(variant)
        if rate is not None:
            found[point] = rate
    return found


def figure(curve: dict[Point, Rate]) -> Figure:
    """Success in percent with its interval, one panel a task."""
    tasks = list(dict.fromkeys(task for task, _, _ in curve))
    with matplotlib.rc_context(PARAMETERS):
        drawing = Figure(figsize=(3.5 * len(tasks), 2.6), layout="constrained")
        for axes, task in zip(drawing.subplots(1, len(tasks), sharey=True, squeeze=False)[0], tasks, strict=True):
            for method in dict.fromkeys(method for own, method, _ in curve if own == task):
                steps = [count for own, other, count in curve if (own, other) == (task, method)]
                own = [curve[task, method, count] for count in steps]
                values = [100 * rate.value for rate in own]
                low = [100 * (rate.value - rate.interval[0]) for rate in own]
                high = [100 * (rate.interval[1] - rate.value) for rate in own]
                style = STYLES[method]
                look = {"color": "black", "markerfacecolor": style.colour, "marker": style.marker}
                axes.errorbar(steps, values, yerr=[low, high], label=method, ls=style.line, lw=1, capsize=2, **look)
            axes.set(title=task, xscale="log", xlabel="training steps", ylim=(-3, 103))
            axes.set_xticks(sorted({count for _, _, count in curve}), minor=False)
            axes.get_xaxis().set_major_formatter(matplotlib.ticker.ScalarFormatter())
            axes.minorticks_off()
        drawing.axes[0].set_ylabel("success in %")
        drawing.axes[0].legend()
    return drawing


if __name__ == "__main__":
    main()
