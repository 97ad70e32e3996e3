"""Writes results/summary.md, the averages of Table I in all of its runs: python scripts/summarise_results.py

Run it after `rip report` of a folder; then `scripts/include_results.py` copies the table into the README.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from robust_instant_policy.evaluation.statistics import Summary, reference
from robust_instant_policy.evaluation.store import read_results
from robust_instant_policy.evaluation.variant import ROW_METHODS
from robust_instant_policy.files import write_whole
from robust_instant_policy.reporting.comparison import paper_rate
from robust_instant_policy.reporting.tables import NONE, Table

RESULTS = Path(__file__).parents[1] / "results"
RUNS = {  # folder: what its column is called
    "table1-paper": "paper's configuration, stand-in for a language model",
    "table1": "adaptive configuration",
    "table1-hard": "adaptive, hard scenes",
    "adaptive": "adaptive, one set of demonstrations",
}


def summary_of(folder: str) -> Summary:
    """Table I of the run in ``results/FOLDER``."""
    results = read_results(RESULTS / folder)
    suite = next(suite for suite in results.manifest.suites if suite.name == "table1")
    return Summary(suite, results.episodes)


def cell(summary: Summary, method: str) -> str:
    """Mean over tasks in percent with its interval, and the mark where RIP is significantly better."""
    variant = next((one for one in summary.variants if one.method == method), None)
    if variant is None:
        return NONE
    ours = reference(summary.variants)
    marks = {one.variant: one.mark for one in summary.compare(ours)} if ours is not None else {}
    low, high = summary.interval_over_tasks(variant)
    stars = marks.get(variant, "").replace("*", "\\*")
    return f"{100 * summary.over_tasks(variant)[0]:.1f}{stars} ({100 * low:.0f} to {100 * high:.0f})"


def printed(summary: Summary, method: str) -> str:
    """The paper's own average over the tasks."""
    variant = next((one for one in summary.variants if one.method == method), None)
    rates = [rate for task in summary.tasks if variant and (rate := paper_rate(summary, variant, task)) is not None]
    return f"{sum(rates) / len(rates):.0f}" if rates else NONE


def described(name: str, summary: Summary) -> str:
    """Scenes and sets of demonstrations of a column, in words."""
    sets = len({row.variant.demo_set for row in summary.rows})
    counts = {len({row.scene for row in summary.rows if row.scene.task == task}) for task in summary.tasks}
    scenes = " to ".join(str(count) for count in sorted({min(counts), max(counts)}))
    of_sets = f"{sets} sets" if sets > 1 else "one set"
    return f"{name}: {of_sets} of demonstrations, new scenes a task and set: {scenes}"


def table(summaries: Sequence[Summary]) -> Table:
    """One row a method, one column a run, and the paper's own averages beside its configuration."""
    columns = dict(zip(RUNS.values(), summaries, strict=True))
    first, *others = columns
    met = {variant.method for summary in summaries for variant in summary.variants}
    rows = [
        (
            method,
            cell(columns[first], method),
            printed(columns[first], method),
            *(cell(columns[name], method) for name in others),
        )
        for method in ROW_METHODS
        if method in met
    ]
    note = (
        "Success in percent, mean over ten tasks; in parentheses Wilson's 95% interval with one trial a task and set "
        "of demonstrations. RIP is significantly better than what is marked \\* or \\*\\* (sign-flip test over scenes, "
        "Holm's correction within the column, p < 0.05 and p < 0.005). "
        f"{'; '.join(described(*one) for one in columns.items())}. "
        "The paper had GPT-4o, and physical robots for its ALOHA tasks."
    )
    return Table(("method", first, "printed in the paper", *others), tuple(rows), note)


if __name__ == "__main__":
    write_whole(RESULTS / "summary.md", table([summary_of(folder) for folder in RUNS]).markdown().encode())
    print(f"wrote {RESULTS / 'summary.md'}")
