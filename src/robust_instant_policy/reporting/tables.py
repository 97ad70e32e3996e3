"""The paper's tables, with confidence intervals and significance tests."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from robust_instant_policy.evaluation import paper
from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.evaluation.failures import STAGES, Failure
from robust_instant_policy.evaluation.manifest import Invocation
from robust_instant_policy.evaluation.statistics import Rate, Summary, mark, mean_and_deviation, reference
from robust_instant_policy.evaluation.variant import ROW_METHODS, Variant, by_demos, configs, dof_symbol, values
from robust_instant_policy.reporting.comparison import is_comparable, paper_rate

NONE = "–"
MAX_NAMED_TASKS = 10  # in a caption
INTERVAL = "Wilson's 95% interval with one trial a scene"


@dataclass(frozen=True)
class Table:
    """Cells of text, in which ``**`` makes bold; ``note`` says how to read them."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str

    def markdown(self) -> str:
        lines = [self.head, tuple("---" for _ in self.head), *self.rows]
        return "\n".join(f"| {' | '.join(line)} |" for line in lines) + f"\n\n{self.note}\n"


def tables(summary: Summary) -> list[Table]:
    """All tables of a suite."""
    return _TABLES[summary.suite.name](summary)


def success_table(summary: Summary) -> Table:
    """Table I: one row a method, for each task the success rate in percent, and the paper's own beside rows of its
    configuration.
    """
    ours, variants = reference(summary.variants), summary.variants
    compared = [task for task in summary.tasks if any(paper_rate(summary, one, task) is not None for one in variants)]
    stars = {one.variant: one.mark for one in summary.compare(ours)} if ours is not None else {}
    sets = {variant: summary.of_sets(variant) for variant in summary.variants}
    several = any(len(rates) > 1 for rates in sets.values())
    head = ["method"]
    for task in summary.tasks:
        of_paper = "paper, physical robot" if task.startswith("aloha") else "paper"
        head += [task, of_paper] if task in compared else [task]
    rows = []
    for variant, label in summary.labels.items():
        row = [label]
        for task in summary.tasks:
            row.append(_cell(summary.rate(variant, task), summary.best(task)))
            if task in compared:
                percent = paper_rate(summary, variant, task)
                row.append(NONE if percent is None else str(percent))
        tried = [task for task in compared if summary.rate(variant, task) is not None]
        row.append(_spread(summary, variant, stars.get(variant, "")))
        if several:
            row.append(", ".join(f"{100 * rate:.1f}" for rate in sets[variant].values()))
        if compared:
            row.append(_paper_average(summary, variant, tried))
        rows.append(tuple(row))
    counts = ", ".join(f"{label} {_executions(summary, variant)}" for variant, label in summary.labels.items())
    over_same = ", the paper's over the same" if compared else ""
    marked = (
        "RIP is significantly better than those marked \\* or \\*\\* (sign-flip test over scenes, Holm's correction "
        "for the methods in this table, p < 0.05 and p < 0.005). "
        if ours is not None and len(variants) > 1
        else ""
    )
    by_set = "The averages with each set of demonstrations stand beside them. " if several else ""
    return Table(
        (*head, "average", *(["with each set"] if several else []), *(["paper"] if compared else [])),
        tuple(rows),
        f"{_configuration(variants)}Success in percent; in parentheses {INTERVAL}; the best of a task is bold. "
        "Averages are mean ± standard deviation over the tasks that the method was tried in"
        f"{over_same}. {by_set}{marked}Executions a task: {counts}.",
    )


def test_table(summary: Summary) -> Table | None:
    """RIP against every other method; None where there is no other."""
    ours = reference(summary.variants)
    if ours is None or len(summary.variants) == 1:
        return None
    rows = []
    for one in summary.compare(ours):
        low, high = one.interval
        rows.append(
            (
                summary.labels[one.variant],
                f"{100 * one.difference:+.1f} ({100 * low:+.1f} to {100 * high:+.1f})" if one.paired.scenes else NONE,
                str(one.paired.scenes),
                str(one.paired.better),
                str(one.paired.worse),
                _p(one.paired.p) if one.paired.scenes else NONE,
                _p(one.corrected),
                _p(one.t_test),
            )
        )
    head = (
        "rip against", "difference", "shared scenes", "rip better in", "worse in", "paired p", "Holm's p", "t-test p",
    )  # fmt: skip
    note = (
        "Difference in percentage points of the averages over the tasks that both methods were tried in, with the same "
        "scenes and sets of demonstrations; in parentheses its 95% interval (cluster bootstrap over scenes). The "
        "paired test is the exact sign-flip test over shared scenes (McNemar's where each has one execution); Holm's p "
        "corrects it for the number of methods. The t-test is the paper's, over tasks, without correction."
    )
    return Table(head, tuple(rows), note)


def sweep_table(summary: Summary, name: str, value: Callable[[Variant], str]) -> Table:
    """One row a task, one column a value of what is varied."""
    columns = zip(summary.variants, values(summary.variants, value), strict=True)
    head = ("task", *(text if variant.method == "mean" else f"{name} = {text}" for variant, text in columns))
    rows = [
        (task, *(_cell(summary.rate(variant, task), summary.best(task)) for variant in summary.variants))
        for task in summary.tasks
    ]
    rows.append(("average", *(_spread(summary, variant) for variant in summary.variants)))
    counts = dict.fromkeys(_executions(summary, variant) for variant in summary.variants)
    return Table(
        head,
        tuple(rows),
        f"{_configuration(summary.variants)}"
        f"Success of {summary.variants[0].method} in percent, {summary.variants[0].demos} demonstrations shown; in "
        f"parentheses {INTERVAL}; the best of a task is bold. Averages: mean ± standard deviation over "
        f"tasks. Executions a task: {', '.join(counts)}.",
    )


def demos_table(summary: Summary) -> Table:
    """One row a method, one column a number of demonstrations."""
    counts = sorted({variant.demos for variant in summary.variants})
    rows = []
    for label, of_count in by_demos(summary.variants).items():
        cells = []
        for count in counts:
            pooled = summary.rate(of_count[count]) if count in of_count else None
            if pooled is None:
                cells.append(NONE)
                continue
            low, high = pooled.interval
            cells.append(
                f"{_spread(summary, of_count[count])} ({100 * low:.0f} to {100 * high:.0f}, n={pooled.scenes})"
            )
        rows.append((label, *cells))
    tasks = ", ".join(summary.tasks) if len(summary.tasks) <= MAX_NAMED_TASKS else f"{len(summary.tasks)} tasks"
    return Table(
        ("method", *(f"{count} shown" for count in counts)),
        tuple(rows),
        f"{_configuration(summary.variants)}"
        f"Success in percent, mean ± standard deviation over {tasks}; in parentheses "
        f"{INTERVAL}, of all n scenes together.",
    )


def failure_table(episodes: Sequence[Episode], failures: Sequence[Failure]) -> Table:
    """How many failures of each method each stage caused."""
    keys = {row.key for row in episodes}
    known = [failure for failure in failures if failure.key in keys]
    kinds = sorted(
        {(row.variant.config, row.variant.method) for row in episodes},
        key=lambda kind: (kind[0], ROW_METHODS.index(kind[1])),
    )
    apart = len({config for config, _ in kinds if config}) > 1
    stages_met = [stage for stage in STAGES if any(failure.stage == stage for failure in known)]
    rows = []
    for config, method in kinds:
        executions = [row for row in episodes if (row.variant.config, row.variant.method) == (config, method)]
        lost = sum(not row.success for row in executions)
        stages = [one.stage for one in known if (one.variant.config, one.variant.method) == (config, method)]
        cells = [f"{stages.count(stage)} ({stages.count(stage) / lost:.0%})" if lost else NONE for stage in stages_met]
        label = f"{method} ({config})" if apart and config else method
        rows.append((label, str(len(executions)), str(lost), *cells, str(lost - len(stages))))
    return Table(
        ("method", "executions", "failed", *(f"{stage} off" for stage in stages_met), "not examined"),
        tuple(rows),
        "Each failure is attributed to the first stage that explains it when stages are replaced by the truth in "
        "this order: execution (the demonstrator's own trajectory fails), keypoints (the method succeeds with the true "
        "ones), regression (one of its candidates succeeds alone), else samples. A closed-loop policy has no such "
        "stages.",
    )


def invocation_table(invocations: Sequence[Invocation], episodes: Sequence[Episode]) -> Table:
    """What was run, where and for how long; invocations of one command are one row."""
    rows: dict[tuple[str, str, str], list[float]] = {}
    for one in invocations:
        rows.setdefault((one.command, one.machine, one.code), []).append(one.hours)
    models = sorted({row.variant.model for row in episodes if row.variant.model})
    shared: dict[tuple, float] = {}  # methods that share samples each count the time of sampling
    for row in episodes:
        own = row.variant
        samples = row.scene, own.demos, own.downsampling, own.keypoints, own.frames, own.layout, own.model
        shared[samples] = max(shared.get(samples, 0.0), row.seconds)
    planning = sum(shared.values()) / 3600
    physics = sum(row.physics_seconds for row in episodes) / 3600
    return Table(
        ("command", "machine", "version", "times", "hours"),
        tuple((f"`{key[0]}`", *key[1:], str(len(hours)), f"{sum(hours):.2f}") for key, hours in rows.items()),
        f"Language model: {', '.join(models) or 'none was asked'}. First begun: {invocations[0].began}. The workers "
        f"planned for {planning:.1f} hours (samples that were stored already cost next to nothing) and executed for "
        f"{physics:.1f}."
        if invocations
        else "Nothing is known of the commands that wrote these rows.",
    )


def _cell(rate: Rate | None, best: float) -> str:
    if rate is None:
        return NONE
    low, high = rate.interval
    text = f"{100 * rate.value:.0f}"
    return f"{f'**{text}**' if rate.value == best else text} ({100 * low:.0f} to {100 * high:.0f})"


def _spread(summary: Summary, variant: Variant, stars: str = "") -> str:
    mean, deviation = summary.over_tasks(variant)
    return f"{100 * mean:.1f}{stars.replace('*', chr(92) + '*')} ± {100 * deviation:.1f}"


def _configuration(variants: Sequence[Variant]) -> str:
    """A sentence that names the configuration, and the descriptors where they are not the paper's DINO."""
    named = [config for config in configs(variants) if config]
    features = sorted({one.features for one in variants if one.features and one.keypoints} - {"auto"})
    words = [f"Configuration: {' and '.join(named)}"] if named else []
    words += [f"descriptors: {' and '.join(features)}"] if features else []
    return f"{'; '.join(words)}. " if words else ""


def _paper_average(summary: Summary, variant: Variant, tasks: Sequence[str]) -> str:
    rates = [rate for task in tasks if (rate := paper_rate(summary, variant, task)) is not None]
    return "{:.0f} ± {:.0f}".format(*mean_and_deviation(rates)) if rates else NONE


def _executions(summary: Summary, variant: Variant) -> str:
    counts = [rate.trials for rate in summary.rates(variant, summary.tasks)]
    return str(counts[0]) if len(set(counts)) == 1 else f"{min(counts)} to {max(counts)}"


def _p(value: float) -> str:
    if math.isnan(value):
        return NONE
    shown = f"{value:.3f}" if value >= 0.0005 else "< 0.001"
    return shown + mark(value).replace("*", chr(92) + "*")


def _with_tests(summary: Summary) -> list[Table]:
    tests = test_table(summary)
    return [success_table(summary), *([tests] if tests else [])]


def _downsampling(summary: Summary) -> list[Table]:
    table = sweep_table(summary, "downsampling", lambda variant: variant.downsampling)
    if not is_comparable(summary):
        return [table]
    printed = [str(paper.DOWNSAMPLING[variant.downsampling]) for variant in summary.variants]
    row = ("paper, average of five tasks", *printed)
    return [Table(table.head, (*table.rows, row), table.note)]


_TABLES: dict[str, Callable[[Summary], list[Table]]] = {
    "chosen": _with_tests,
    "table1": _with_tests,
    "demos": lambda summary: [demos_table(summary)],
    "queries": lambda summary: [sweep_table(summary, "Q", lambda variant: str(variant.queries))],
    "dof": lambda summary: [sweep_table(summary, "ν", dof_symbol)],
    "downsampling": _downsampling,
    "trajectories": lambda summary: [],
}
