"""Tables and figure of a published benchmark: success by group of difficulty beside published numbers and by task, and
failures by stage."""

from collections.abc import Sequence
from statistics import fmean
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from robust_instant_policy.evaluation.failures import Failure
from robust_instant_policy.evaluation.statistics import Summary
from robust_instant_policy.evaluation.variant import REPLAY, Variant
from robust_instant_policy.reporting.figures import HEIGHT_IN, PARAMETERS, WIDTH_IN, style_of, success_axis
from robust_instant_policy.reporting.tables import NONE, Table
from robust_instant_policy.tasks.benchmark import Benchmark
from robust_instant_policy.tasks.level import PAPER

TUNED = " †"  # marks tasks on which this package was tuned
LOST = {  # column of the table of failures: the stages of the failure analysis that it counts
    "replay fails": ("execution",),
    "keypoints": ("keypoints",),
    "plan": ("samples", "regression"),
}
PUBLISHED_GREYS = ("0.90", "0.80", "0.70", "0.60", "0.50", "0.40")


def benchmark_tables(benchmark: Benchmark, summary: Summary, failures: Sequence[Failure] = ()) -> list[Table]:
    """The table by groups, that by tasks, and, where some were examined, that of ``failures`` by stage."""
    lost = loss_table(benchmark, summary, failures)
    return [group_table(benchmark, summary), task_table(benchmark, summary), *([lost] if lost else [])]


def group_table(benchmark: Benchmark, summary: Summary) -> Table:
    """One row a method, ours and published; one column a group of difficulty, then averages."""
    groups = {f"{name} ({len(tasks)})": tasks for name, tasks in benchmark.groups.items()}
    measured = [task for task in benchmark.tasks if task not in benchmark.tuning]
    parts = {f"tuning ({len(benchmark.tuning)})": benchmark.tuning, f"measuring ({len(measured)})": measured}
    parts = parts if benchmark.tuning else {}
    sets = {variant: summary.of_sets(variant) for variant in summary.variants}
    several = any(len(rates) > 1 for rates in sets.values())
    rows = []
    for variant, label in summary.labels.items():
        rates = [_mean(summary, variant, tasks) for tasks in groups.values()]
        known = [rate for rate in rates if rate is not None]
        cells = [_cell(summary, variant, tasks) for tasks in groups.values()]
        of_groups = f"{fmean(known):.1f}" if len(known) == len(rates) else NONE
        low, high = summary.interval_over_tasks(variant)
        overall = f"{_cell(summary, variant, benchmark.tasks)} ({100 * low:.1f} to {100 * high:.1f})"
        each = [", ".join(f"{100 * rate:.1f}" for rate in sets[variant].values())] if several else []
        others = [_cell(summary, variant, tasks) for tasks in parts.values()]
        rows.append((label, *cells, of_groups, overall, *each, *others))
    sizes = [len(tasks) for tasks in benchmark.groups.values()]
    for name, percents in benchmark.published.items():
        weighted = float(np.average(percents, weights=sizes))
        cells = [f"{percent:.1f}" for percent in percents]
        blank = [NONE] * (several + len(parts))
        rows.append((f"{name}, published", *cells, f"{fmean(percents):.1f}", f"{weighted:.1f}", *blank))
    each_set = ["with each set"] * several
    head = ("method", *groups, "mean of the groups", f"mean of the {sum(sizes)} tasks", *each_set, *parts)
    interval = (
        "In parentheses Wilson's 95% interval of the mean over the tasks, with one trial a task and set of "
        "demonstrations."
    )
    note = (_conditions(summary), _extent(summary), interval, _reading(benchmark, summary), benchmark.protocol)
    return Table(head, tuple(rows), " ".join(filter(None, note)))


def task_table(benchmark: Benchmark, summary: Summary) -> Table:
    """One row a task, one column a method; replays of the demonstrator come first."""
    rows = []
    for group, tasks in benchmark.groups.items():
        for task in tasks:
            if task not in summary.tasks:
                continue
            rates = (summary.rate(variant, task) for variant in summary.variants)
            cells = [NONE if rate is None else f"{100 * rate.value:.0f}" for rate in rates]
            rows.append((_name(benchmark, task), group, *cells))
    note = ("Success in percent.", _conditions(summary), _extent(summary), _reading(benchmark, summary))
    return Table(("task", "group", *summary.labels.values()), tuple(rows), " ".join(filter(None, note)))


def loss_table(benchmark: Benchmark, summary: Summary, failures: Sequence[Failure]) -> Table | None:
    """One row a task and method that failed: how many failures each stage caused; None if none was examined."""
    known = {failure.key: failure for failure in failures}
    rows, examined = [], False
    for task in summary.tasks:
        for variant, label in summary.labels.items():
            own = [row for row in summary.rows_of(variant, task) if not row.success]
            if variant.method == REPLAY or not own:
                continue
            moved = [known.get(row.key) for row in own if row.executed_seconds > 0]  # else it was refused
            found = [failure for failure in moved if failure is not None]
            examined = examined or bool(found)
            stages = ["keypoints" if failure.keypoint_error == 0 else failure.stage for failure in found]
            errors = [1e3 * failure.keypoint_error for failure in found if failure.keypoint_error]
            counts = [len(own) - len(moved), *(sum(map(stages.count, which)) for which in LOST.values())]
            cells = [str(count or NONE) for count in (*counts, len(own) - sum(counts))]
            off = f"{np.median(errors):.0f}" if errors else NONE
            failed = f"{len(own)} of {len(summary.rows_of(variant, task))}"
            rows.append((_name(benchmark, task), label, failed, *cells, off))
    if not examined:
        return None
    note = (
        "Failed executions by the stage that lost them. *Refused*: no plan could be made, or the checks before motion "
        "refuse it. Of the others the first that holds: *replay fails*, the demonstrator's own trajectory for the "
        "scene is no success either; *keypoints*, the method succeeds with the true ones, or none lies on anything "
        "that moves; *plan*, it fails with the true ones, too. The last column is the median, over failures that were "
        "examined beyond replays, of the largest error of a keypoint on an object."
    )
    head = ("task", "method", "failed", "refused", *LOST, "not examined", "keypoint error, mm")
    return Table(head, tuple(rows), note)


def _name(benchmark: Benchmark, task: str) -> str:
    return task.removeprefix(f"{benchmark.name}/") + (TUNED if task in benchmark.tuning else "")


def benchmark_figure(benchmark: Benchmark, summary: Summary) -> Figure:
    """Bars of ours and of published policies in each group of difficulty, and on average over the groups."""
    with matplotlib.rc_context(PARAMETERS):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
        axes = figure.add_subplot()
        bars: list[tuple[str, Sequence[float], dict[str, Any]]] = []
        for name, grey in zip(benchmark.published, PUBLISHED_GREYS, strict=False):
            bars.append((f"{name}, published", benchmark.published[name], {"color": grey}))
        for variant, label in summary.labels.items():
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
    rates = summary.rates(variant, tasks)
    return 100 * fmean(rate.value for rate in rates) if rates else None


def _cell(summary: Summary, variant: Variant, tasks: Sequence[str]) -> str:
    """`_mean`; in parentheses the number of tasks, if not all were tried."""
    mean = _mean(summary, variant, tasks)
    if mean is None:
        return NONE
    tried = len(summary.rates(variant, tasks))
    return f"{mean:.1f}" + (f" (of {tried})" if tried < len(tasks) else "")


def _conditions(summary: Summary) -> str:
    shown = sorted({variant.demos for variant in summary.variants if variant.method != REPLAY})
    features = sorted({one.features for one in summary.variants if one.features and one.keypoints} - {"auto"})
    words = [f"{' or '.join(map(str, shown))} demonstrations"] if shown else []
    words += [f"descriptors: {', '.join(features)}"] if features else []
    words += [] if summary.suite.level == PAPER.name else [f"level {summary.suite.level}"]
    return f"{'; '.join(words)}." if words else ""


def _extent(summary: Summary) -> str:
    """Number of scenes and sets of demonstrations of each method."""
    told: dict[str, list[str]] = {}
    for variant, label in summary.labels.items():
        scenes = {rate.scenes for rate in summary.rates(variant, summary.tasks)}
        sets = len(summary.of_sets(variant))
        count = f"{min(scenes)}" + (f" to {max(scenes)}" if len(scenes) > 1 else "")
        words = f"{count} scene{'s' if scenes != {1} else ''} a task"
        if sets > 1:
            rows = summary.rows_of(variant)
            shared = len({(row.scene, row.variant.demo_set) for row in rows}) > len({row.scene for row in rows})
            words += f", {'all' if shared else 'a part'} of them with each of {sets} sets of demonstrations"
        told.setdefault(words, []).append(label)
    return "; ".join(f"{', '.join(names)}: {words}" for words, names in told.items()) + "."


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
