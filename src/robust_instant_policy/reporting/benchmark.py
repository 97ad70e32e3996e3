"""Tables and figure of a benchmark of other people: by group of difficulty beside published numbers, and by task."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from robust_instant_policy.evaluation.statistics import Summary
from robust_instant_policy.evaluation.variant import REPLAY, Variant, labels
from robust_instant_policy.reporting.figures import HEIGHT_IN, PARAMETERS, WIDTH_IN, style_of, success_axis
from robust_instant_policy.reporting.tables import NONE, Table
from robust_instant_policy.tasks.benchmark import Benchmark
from robust_instant_policy.tasks.level import PAPER

TUNED = " †"  # marks tasks on which this package was tuned
PUBLISHED_GREYS = ("0.90", "0.80", "0.70", "0.60", "0.50", "0.40")


def benchmark_tables(benchmark: Benchmark, summary: Summary) -> list[Table]:
    """The table by groups, then that by tasks."""
    return [group_table(benchmark, summary), task_table(benchmark, summary)]


def group_table(benchmark: Benchmark, summary: Summary) -> Table:
    """One row a method, ours and published; one column a group of difficulty, then averages."""
    groups = {f"{name} ({len(tasks)})": tasks for name, tasks in benchmark.groups.items()}
    measured = [task for task in benchmark.tasks if task not in benchmark.tuning]
    parts = {f"tuning ({len(benchmark.tuning)})": benchmark.tuning, f"measuring ({len(measured)})": measured}
    if not benchmark.tuning:
        parts = {}
    rows = []
    for variant, label in zip(summary.variants, labels(summary.variants), strict=True):
        rates = [_mean(summary, variant, tasks) for tasks in groups.values()]
        known = [rate for rate in rates if rate is not None]
        cells = [_cell(summary, variant, tasks) for tasks in groups.values()]
        of_groups = f"{fmean(known):.1f}" if len(known) == len(rates) else NONE
        others = [_cell(summary, variant, tasks) for tasks in (benchmark.tasks, *parts.values())]
        rows.append((label, *cells, of_groups, *others))
    sizes = [len(tasks) for tasks in benchmark.groups.values()]
    for name, percents in benchmark.published.items():
        weighted = float(np.average(percents, weights=sizes))
        cells = [f"{percent:.1f}" for percent in percents]
        rows.append((f"{name}, published", *cells, f"{fmean(percents):.1f}", f"{weighted:.1f}", *(NONE for _ in parts)))
    head = ("method", *groups, "mean of the groups", f"mean of the {sum(sizes)} tasks", *parts)
    return Table(head, tuple(rows), f"{_conditions(summary)} {_reading(benchmark, summary)} {benchmark.protocol}")


def task_table(benchmark: Benchmark, summary: Summary) -> Table:
    """One row a task, one column a method; replays of the demonstrator come first."""
    rows = []
    for group, tasks in benchmark.groups.items():
        for task in tasks:
            if task not in summary.tasks:
                continue
            name = task.removeprefix(f"{benchmark.name}/") + (TUNED if task in benchmark.tuning else "")
            cells = []
            for variant in summary.variants:
                rate = summary.rate(variant, task)
                cells.append(NONE if rate is None else f"{100 * rate.value:.0f}")
            rows.append((name, group, *cells))
    counts = []
    for variant, label in zip(summary.variants, labels(summary.variants), strict=True):
        trials = [rate.trials for task in summary.tasks if (rate := summary.rate(variant, task)) is not None]
        counts.append(f"{label} {min(trials)}" + (f" to {max(trials)}" if max(trials) > min(trials) else ""))
    note = f"Success in percent. {_conditions(summary)} {_reading(benchmark, summary)}"
    note += f" Executions a task: {', '.join(counts)}."
    return Table(("task", "group", *labels(summary.variants)), tuple(rows), note)


def benchmark_figure(benchmark: Benchmark, summary: Summary) -> Figure:
    """Bars of ours and of published policies in each group of difficulty, and on average over the groups."""
    with matplotlib.rc_context(PARAMETERS):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
        axes = figure.add_subplot()
        bars: list[tuple[str, Sequence[float], dict[str, Any]]] = []
        for name, grey in zip(benchmark.published, PUBLISHED_GREYS, strict=False):
            bars.append((f"{name}, published", benchmark.published[name], {"color": grey}))
        for variant, label in zip(summary.variants, labels(summary.variants), strict=True):
            rates = [_mean(summary, variant, tasks) for tasks in benchmark.groups.values()]
            style = style_of(variant)
            look: dict[str, Any] = {"color": style.colour, "hatch": style.hatch, "edgecolor": "black", "linewidth": 0.5}
            if variant.method == REPLAY:
                look = {"color": "white", "edgecolor": "black", "linewidth": 0.8, "linestyle": ":"}
            bars.append((label, [np.nan if rate is None else rate for rate in rates], look))
        width = 0.86 / len(bars)
        for index, (label, values, look) in enumerate(bars):
            places = np.arange(len(values) + 1) + (index - (len(bars) - 1) / 2) * width
            axes.bar(places, [*values, float(np.mean(values))], width, label=label, **look)
        names = [f"{name} ({len(tasks)})" for name, tasks in benchmark.groups.items()]
        axes.set_xticks(range(len(names) + 1), [*names, "mean of the groups"])
        success_axis(axes)
        figure.legend(loc="outside upper center", ncols=3)
        return figure


def _mean(summary: Summary, variant: Variant, tasks: Sequence[str]) -> float | None:
    """Success in percent, averaged over those of ``tasks`` that were tried; None without any."""
    rates = [rate.value for task in tasks if (rate := summary.rate(variant, task)) is not None]
    return 100 * fmean(rates) if rates else None


def _cell(summary: Summary, variant: Variant, tasks: Sequence[str]) -> str:
    """`_mean`, and in parentheses of how many tasks where it is not of all."""
    mean = _mean(summary, variant, tasks)
    if mean is None:
        return NONE
    tried = sum(summary.rate(variant, task) is not None for task in tasks)
    return f"{mean:.1f}" + (f" (of {tried})" if tried < len(tasks) else "")


def _conditions(summary: Summary) -> str:
    shown = sorted({variant.demos for variant in summary.variants if variant.method != REPLAY})
    features = sorted({one.features for one in summary.variants if one.features and one.keypoints} - {"auto"})
    words = [f"{' or '.join(map(str, shown))} demonstrations"] if shown else []
    words += [f"descriptors: {', '.join(features)}"] if features else []
    words += [] if summary.suite.level == PAPER.name else [f"level {summary.suite.level}"]
    return f"{'; '.join(words)}." if words else ""


def _reading(benchmark: Benchmark, summary: Summary) -> str:
    replay = (
        "*Replay* is the demonstrator's own trajectory for the scene, thinned out to 30 waypoints and executed open "
        "loop like a plan: where it fails, open loop cannot do it, or the demonstrator cannot."
    )
    tuned = (
        "Tasks marked †, the tuning tasks, are those on which this package was tuned; the others were only measured."
    )
    replayed = any(variant.method == REPLAY for variant in summary.variants)
    return " ".join([replay] * replayed + [tuned] * bool(benchmark.tuning))
