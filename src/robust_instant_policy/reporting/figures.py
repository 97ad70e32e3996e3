"""The paper's figures, drawn from rows: readable in greyscale, every axis with its unit."""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import fmean
from textwrap import fill

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from robust_instant_policy.evaluation import paper
from robust_instant_policy.evaluation.statistics import Summary
from robust_instant_policy.evaluation.variant import Scene, Variant, by_demos, dof_symbol, values
from robust_instant_policy.policies import Plan
from robust_instant_policy.reporting.comparison import is_comparable, paper_rate

AVERAGE = "average"
GROUPS_A_ROW = 7  # of bars
WIDTH_IN, HEIGHT_IN = 7.0, 2.8  # of a figure over both columns of a paper
LINE_CHARACTERS = 75  # that fit below such a figure, side by side
LEGEND_CHARACTERS, HANDLE_CHARACTERS = 100, 8  # that fit beside each other above it; a handle takes as much room
LEGEND_ROW_IN, LEGEND_ROWS = 0.16, 2  # height of a row; so many fit into `HEIGHT_IN`
PNG_DPI = 200
MM = 1000.0
PARAMETERS = {
    "font.size": 8,
    "font.family": "DejaVu Sans",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "hatch.linewidth": 0.5,
    "legend.frameon": False,
    "svg.hashsalt": "rip",  # the same rows give the same file
    "svg.fonttype": "none",
}


@dataclass(frozen=True)
class Style:
    """How a method is drawn. Brightness, hatch, marker and line differ, so that colour is not needed."""

    colour: str
    hatch: str
    marker: str
    line: str | tuple[float, tuple[float, ...]]


STYLES = {
    "rip": Style("#4a78ad", "", "o", "-"),
    "rip-gauss": Style("#a9c8e8", "//", "s", "--"),
    "rip-adaptive": Style("#3f9188", "xx", "D", (0, (5, 1))),
    "mean": Style("#7d7d7d", "..", "h", (0, (2, 1))),
    "kat": Style("#d98032", "\\\\", "^", "-."),
    "kat-dp": Style("#f0c58f", "||", "v", ":"),
    "dp": Style("#c9c9c9", "--", "P", (0, (1, 1))),
    "neighbours": Style("#e8e0d0", "++", "X", (0, (3, 1, 1, 1))),
    "gp": Style("#b9a3c9", "|//", "p", (0, (6, 2))),
}
PLAIN = Style("#808080", "-/", "*", (0, (1, 2)))

# The paper's number in percent for a variant in a task, or on average.
PaperNumber = Callable[[Variant, str], float | None]


def draw(summary: Summary, plans: Mapping[tuple[Scene, Variant], Plan]) -> Figure:
    """The figure of a suite; ``plans`` are those it kept."""
    with matplotlib.rc_context(PARAMETERS):
        if summary.suite.name == "trajectories":
            return _trajectories(summary, plans)
        return _FIGURES[summary.suite.name](summary)


def encode(figure: Figure, form: str) -> bytes:
    """The figure as ``"svg"`` or ``"png"``; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(PARAMETERS):
        figure.savefig(buffer, format=form, dpi=PNG_DPI, metadata={"Date": None} if form == "svg" else None)
    return buffer.getvalue()


def _success_bars(summary: Summary) -> Figure:
    groups = [*summary.tasks, AVERAGE]
    num_rows = -(-len(groups) // GROUPS_A_ROW)
    names = list(summary.labels.values())
    columns = max(1, min(4, LEGEND_CHARACTERS // (max(map(len, names)) + HANDLE_CHARACTERS)))
    more_rows = max(0, -(-len(names) // columns) - LEGEND_ROWS)
    height = HEIGHT_IN * num_rows + LEGEND_ROW_IN * more_rows
    figure = Figure(figsize=(WIDTH_IN, height), layout="constrained")
    bounds = [len(groups) * row // num_rows for row in range(num_rows + 1)]
    styles = [style_of(variant) for variant in summary.variants]
    for row in range(num_rows):
        axes = figure.add_subplot(num_rows, 1, row + 1)
        _bars(axes, summary, groups[bounds[row] : bounds[row + 1]], styles, partial(_paper_percent, summary))
        if row == 0:
            has_paper = any(_paper_percent(summary, one, task) for one in summary.variants for task in summary.tasks)
            _legend_above(axes, styles, names, "paper, with GPT-4o" if has_paper else "", columns)
    return figure


def _bars(
    axes: Axes, summary: Summary, groups: Sequence[str], styles: Sequence[Style], paper_number: PaperNumber
) -> None:
    """One group of bars for each of ``groups``, tasks or their average; whiskers are Wilson's 95% interval, over tasks
    ± 1 sd; lines are the paper's numbers.
    """
    width = 0.84 / len(summary.variants)
    for index, (variant, style) in enumerate(zip(summary.variants, styles, strict=True)):
        offset = (index - (len(summary.variants) - 1) / 2) * width
        for place, task in enumerate(groups):
            if task == AVERAGE:
                mean, deviation = summary.over_tasks(variant)
                low, high = max(0.0, mean - deviation), min(1.0, mean + deviation)
            else:
                rate = summary.rate(variant, task)
                if rate is None:
                    continue
                mean, (low, high) = rate.value, rate.interval
            axes.bar(
                place + offset,
                100 * mean,
                width,
                color=style.colour,
                edgecolor="black",
                linewidth=0.5,
                hatch=style.hatch,
            )
            whisker = 100 * np.array([[max(0.0, mean - low)], [max(0.0, high - mean)]])
            axes.errorbar(place + offset, 100 * mean, whisker, color="black", linewidth=0.7, capsize=1.5)
            if (percent := paper_number(variant, task)) is not None:
                _paper_line(axes, place + offset, width, percent)
    room = max(8, LINE_CHARACTERS // len(groups))  # names break at their hyphens
    axes.set_xticks(range(len(groups)), [fill(group, room) for group in groups])
    success_axis(axes)


def _paper_percent(summary: Summary, variant: Variant, group: str) -> float | None:
    """The paper's number for a task, or its average over the tasks that ``variant`` was tried in here."""
    if group != AVERAGE:
        return paper_rate(summary, variant, group)
    tried = [task for task in summary.tasks if summary.rate(variant, task) is not None]
    known = [rate for task in tried if (rate := paper_rate(summary, variant, task)) is not None]
    return fmean(known) if len(known) == len(tried) else None


def _paper_line(axes: Axes, centre: float, width: float, percent: float) -> None:
    """The paper's number: a line across the bar, edged in white so that it shows on dark ones."""
    ends = [centre - width / 2, centre + width / 2]
    axes.plot(ends, [percent, percent], color="white", linewidth=3.2, solid_capstyle="butt", zorder=4)
    axes.plot(ends, [percent, percent], color="black", linewidth=1.6, solid_capstyle="butt", zorder=5)


def _legend_above(axes: Axes, styles: Sequence[Style], names: Sequence[str], paper_label: str, columns: int) -> None:
    handles: list[Artist] = [
        Patch(facecolor=style.colour, edgecolor="black", linewidth=0.5, hatch=style.hatch, label=name)
        for style, name in zip(styles, names, strict=True)
    ]
    if paper_label:
        handles.append(Line2D([], [], color="black", linewidth=1.6, label=paper_label))
    axes.legend(handles=handles, ncols=columns, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _demos(summary: Summary) -> Figure:
    figure = Figure(figsize=(WIDTH_IN / 1.6, HEIGHT_IN), layout="constrained")
    axes = figure.add_subplot()
    counts = sorted({variant.demos for variant in summary.variants})
    groups = by_demos(summary.variants)
    for number, (label, of_count) in enumerate(groups.items()):
        shown = [of_count[count] for count in sorted(of_count)]
        # shifted, so that equal curves do not cover each other
        places = [counts.index(one.demos) + 0.06 * (number - (len(groups) - 1) / 2) for one in shown]
        _curve(axes, summary, shown, places, style_of(shown[0]), label)
    axes.set_xticks(range(len(counts)), [str(count) for count in counts])
    axes.set_xlabel("demonstrations shown")
    success_axis(axes)
    axes.legend(loc="lower right")
    return figure


def _sweep(summary: Summary, label: str, value: Callable[[Variant], str]) -> Figure:
    figure = Figure(figsize=(WIDTH_IN / 2, HEIGHT_IN), layout="constrained")
    axes = figure.add_subplot()
    places = list(range(len(summary.variants)))
    _curve(axes, summary, summary.variants, places, STYLES["rip"], "mean ± sd over tasks")
    markers = "svD^P*X"
    for marker, task in zip(markers * len(summary.tasks), summary.tasks, strict=False):
        rates = [summary.rate(variant, task) for variant in summary.variants]
        known = [(place, 100 * rate.value) for place, rate in zip(places, rates, strict=True) if rate is not None]
        axes.plot(*zip(*known, strict=True), marker, color="#777777", fillstyle="none", markersize=4, label=task)
    axes.set_xticks(places, values(summary.variants, value))
    axes.set_xlabel(label)
    success_axis(axes)
    axes.legend(loc="lower right", fontsize=6.5)
    return figure


def _curve(
    axes: Axes, summary: Summary, variants: Sequence[Variant], places: Sequence[float], style: Style, label: str
) -> None:
    spread = np.array([summary.over_tasks(variant) for variant in variants])
    mean, deviation = 100 * spread.T
    axes.fill_between(places, mean - deviation, np.minimum(mean + deviation, 100), color=style.colour, alpha=0.15, lw=0)
    axes.plot(
        places, mean, style.marker, linestyle=style.line, color="black", markerfacecolor=style.colour,
        markeredgecolor="black", markeredgewidth=0.5, markersize=5, linewidth=0.9, label=label,
    )  # fmt: skip


def _downsampling(summary: Summary) -> Figure:
    figure = Figure(figsize=(WIDTH_IN / 2 + 0.5 * len(summary.tasks), HEIGHT_IN), layout="constrained")
    axes = figure.add_subplot()
    ways = [variant.downsampling for variant in summary.variants]
    looks = {"uniform": STYLES["dp"], "masked": STYLES["rip"]}
    names = {"uniform": "normal (uniform)", "masked": "gripper-based (masked)"}
    groups = [*summary.tasks, AVERAGE]
    styles = [looks[way] for way in ways]

    comparable = is_comparable(summary)

    def paper_number(variant: Variant, group: str) -> float | None:
        return paper.DOWNSAMPLING[variant.downsampling] if comparable and group == AVERAGE else None

    _bars(axes, summary, groups, styles, paper_number)
    _legend_above(axes, styles, [names[way] for way in ways], "paper, average of 5 tasks" if comparable else "", 2)
    return figure


def _trajectories(summary: Summary, plans: Mapping[tuple[Scene, Variant], Plan]) -> Figure:
    """Gripper point over time where RIP and the ablation differ most (Oh et al. 2025, Fig. 5a)."""
    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
    by_scene: dict[Scene, dict[str, Plan]] = {}
    for (scene, variant), plan in plans.items():
        by_scene.setdefault(scene, {})[variant.method] = plan
    other = "rip-gauss" if any("rip-gauss" in of for of in by_scene.values()) else "mean"
    whole = {scene: of for scene, of in by_scene.items() if {"rip", other} <= of.keys()}
    if not whole:
        figure.text(0.5, 0.5, "no scene has been planned by both rip and rip-gauss yet", ha="center")
        return figure
    panels = figure.subplots(1, 3, sharex=True)
    scene = max(whole, key=lambda one: _difference(whole[one]["rip"], whole[one][other]))
    robust, ablation = whole[scene]["rip"], whole[scene][other]
    for axis, panel in enumerate(panels):
        for candidate, hallucinated in zip(robust.candidates, robust.hallucinated, strict=True):
            label = "KAT, hallucinated" if hallucinated else "KAT"
            style = {"linestyle": ":", "linewidth": 1.6} if hallucinated else {"linestyle": "-", "linewidth": 0.8}
            panel.plot(candidate.times, MM * candidate.actions[:, axis], color="#9a9a9a", label=label, **style)
        for plan, method, colour, label in (
            (ablation, other, "black", {"rip-gauss": "RIP Gaussian"}.get(other, other)),
            (robust, "rip", None, "RIP"),
        ):
            look = STYLES[method]
            panel.plot(
                plan.trajectory.times, MM * plan.trajectory.actions[:, axis], linestyle=look.line, linewidth=1.2,
                color=colour or look.colour, marker=look.marker, markersize=3, markevery=4, label=label,
            )  # fmt: skip
        panel.set_xlabel("time, share of the episode")
        panel.set_ylabel(f"gripper {'xyz'[axis]} [mm]")
    handles, names = panels[0].get_legend_handles_labels()
    unique = dict(zip(names, handles, strict=True))
    figure.legend(unique.values(), unique.keys(), loc="outside upper center", ncols=len(unique))
    panels[1].set_title(f"{scene.task}, scene {scene.seed}", fontsize=8)
    return figure


def _difference(robust: Plan, ablation: Plan) -> tuple[bool, float]:
    """Whether a candidate is hallucinated, and the largest distance between RIP and the ablation, in metres."""
    times = np.linspace(0.0, 1.0, 50)
    points = [plan.trajectory.resampled(times).actions[:, :3] for plan in (robust, ablation)]
    return bool(robust.hallucinated.any()), float(np.linalg.norm(points[0] - points[1], axis=1).max())


def success_axis(axes: Axes) -> None:
    axes.set_ylim(0, 104)
    axes.set_ylabel("success [%]")
    axes.grid(axis="y", linewidth=0.3, color="#bbbbbb")
    axes.set_axisbelow(True)


def style_of(variant: Variant) -> Style:
    return STYLES.get(variant.method, PLAIN)


_FIGURES: dict[str, Callable[[Summary], Figure]] = {
    "chosen": _success_bars,
    "table1": _success_bars,
    "demos": _demos,
    "queries": lambda summary: _sweep(summary, "queries Q", lambda variant: str(variant.queries)),
    "dof": lambda summary: _sweep(summary, "degrees of freedom ν", dof_symbol),
    "downsampling": _downsampling,
}
