"""Table I: success rates of methods over tasks (Oh et al. 2025)."""

from __future__ import annotations

from collections.abc import Sequence

from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.evaluation.statistics import wilson_interval


def success_table(episodes: Sequence[Episode]) -> str:
    """Markdown table, one row a method and number of demonstrations, one column a task.

    A cell gives the success rate, the 95% Wilson interval and the number of executions; the best rate of
    a task is bold.
    """
    tasks = list(dict.fromkeys(_column(row) for row in episodes))
    methods = list(dict.fromkeys((row.method, row.demos) for row in episodes))
    rates = {
        (method, task): _rate([row for row in episodes if (row.method, row.demos) == method and _column(row) == task])
        for method in methods
        for task in tasks
    }
    best = {task: max(rate for method in methods if (rate := rates[method, task][0]) is not None) for task in tasks}
    lines = [
        "| method | demonstrations | " + " | ".join(tasks) + " | average |",
        "| --- | --- | " + " | ".join("---" for _ in tasks) + " | --- |",
    ]
    for method in methods:
        known = [rate for task in tasks if (rate := rates[method, task][0]) is not None]
        cells = [_cell(*rates[method, task], best[task]) for task in tasks]
        lines.append(f"| {method[0]} | {method[1]} | {' | '.join(cells)} | {sum(known) / len(known):.0%} |")
    return "\n".join(lines) + "\n"


def _column(row: Episode) -> str:
    return row.task if row.objects == "seen" else f"{row.task} ({row.objects} objects)"


def _rate(rows: Sequence[Episode]) -> tuple[float | None, int, int]:
    successes = sum(row.success for row in rows)
    return (successes / len(rows) if rows else None), successes, len(rows)


def _cell(rate: float | None, successes: int, trials: int, best: float) -> str:
    if rate is None:
        return "–"
    low, high = wilson_interval(successes, trials)
    text = f"{rate:.0%}"
    return f"{f'**{text}**' if rate == best else text} ({low:.0%} to {high:.0%}, n={trials})"
