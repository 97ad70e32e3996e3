"""Statistics of success rates: how often variants succeed, with intervals, and whether two of them differ."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from scipy import stats

from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.evaluation.suites import Suite
from robust_instant_policy.evaluation.variant import Scene, Variant
from robust_instant_policy.policies import METHOD_NAMES

MARKS = ((5e-3, "**"), (5e-2, "*"))  # the paper's, below these p-values


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """95% confidence interval of a success rate (Wilson 1927); (0, 1) without trials."""
    if not 0 <= successes <= trials:
        raise InvalidValueError(f"successes must lie between 0 and trials, got {successes} of {trials}")
    if trials == 0:
        return 0.0, 1.0
    interval = stats.binomtest(successes, trials).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def mean_and_deviation(rates: Sequence[float]) -> tuple[float, float]:
    """Mean and standard deviation over tasks; the deviation is that of the tasks as a population, as in the paper."""
    return float(np.mean(rates)), float(np.std(rates))


def t_test(ours: Sequence[float], theirs: Sequence[float]) -> float:
    """Two-sided p of Student's t-test between two methods' success rates over the same tasks; NaN for fewer than two.

    It is computed from mean and standard deviation as `mean_and_deviation` gives them: with these the paper's marks
    come out of the paper's own Table I, all four. It compares tasks, not executions, and takes no notice of which
    scenes the methods share: see `paired_test`.
    """
    if min(len(ours), len(theirs)) < 2:
        return math.nan
    (mean, deviation), (other_mean, other_deviation) = mean_and_deviation(ours), mean_and_deviation(theirs)
    if deviation == other_deviation == 0:
        return 1.0 if mean == other_mean else 0.0
    return float(
        stats.ttest_ind_from_stats(mean, deviation, len(ours), other_mean, other_deviation, len(theirs)).pvalue
    )


def mark(p_value: float) -> str:
    """The paper's stars."""
    return next((stars for limit, stars in MARKS if p_value < limit), "")


@dataclass(frozen=True)
class Paired:
    """Two methods in the same ``scenes``: in how many the first is ``better``, ``worse``; ``p`` is two-sided."""

    scenes: int
    better: int
    worse: int
    p: float


def paired_test(ours: Mapping[Scene, Fraction], theirs: Mapping[Scene, Fraction]) -> Paired:
    """Exact sign-flip test of the success rates in the scenes that two methods share.

    Were the methods alike, every scene's difference might as well have the other sign: p is the share of all choices of
    signs with a total at least as far from 0. With one execution a scene this is McNemar's exact test.
    """
    shared = [scene for scene in ours if scene in theirs]
    differences = [ours[scene] - theirs[scene] for scene in shared]
    unit = math.lcm(*(difference.denominator for difference in differences)) if differences else 1
    steps = [abs(int(difference * unit)) for difference in differences if difference]
    reach = sum(steps)
    ways = np.zeros(2 * reach + 1)  # probability of each total, from -reach to reach
    ways[reach] = 1.0
    for step in steps:
        ways = (np.roll(ways, step) + np.roll(ways, -step)) / 2
    total = abs(int(sum(differences) * unit))
    totals = np.abs(np.arange(-reach, reach + 1))
    return Paired(
        scenes=len(shared),
        better=sum(difference > 0 for difference in differences),
        worse=sum(difference < 0 for difference in differences),
        p=min(1.0, float(ways[totals >= total].sum())),
    )


@dataclass(frozen=True)
class Rate:
    """``successes`` of ``trials`` executions."""

    successes: int
    trials: int

    @property
    def value(self) -> float:
        return self.successes / self.trials

    @property
    def interval(self) -> tuple[float, float]:
        """95%, Wilson's."""
        return wilson_interval(self.successes, self.trials)


class Summary:
    """The success of the variants of ``suite``, counted from those of ``episodes`` that belong to it.

    Where a variant was shown different demonstrations of one task, those shown last count.
    """

    def __init__(self, suite: Suite, episodes: Iterable[Episode]):
        self.suite = suite
        scenes = set(suite.scenes)
        self._rows: dict[Variant, list[Episode]] = {variant: [] for variant in suite.variants}
        shown: dict[tuple[Variant, str], str] = {}
        for row in episodes:
            variant = replace(row.variant, demonstrations="")
            if variant in self._rows and row.scene in scenes:
                self._rows[variant].append(row)
                shown[variant, row.scene.task] = row.variant.demonstrations
        for variant, rows in self._rows.items():
            rows[:] = [row for row in rows if row.variant.demonstrations == shown[variant, row.scene.task]]
        self.rows: list[Episode] = [row for rows in self._rows.values() for row in rows]
        known = [variant for variant, rows in self._rows.items() if rows]
        # whatever the order in which they were asked for, run by run
        self.variants: list[Variant] = sorted(known, key=lambda variant: METHOD_NAMES.index(variant.method))
        self.tasks: list[str] = [task for task in suite.tasks if any(row.scene.task == task for row in self.rows)]

    def rate(self, variant: Variant, task: str | None = None) -> Rate | None:
        """In ``task``, or all executions together; None where there were none."""
        rows = [row for row in self._rows.get(variant, ()) if task in (None, row.scene.task)]
        return Rate(sum(row.success for row in rows), len(rows)) if rows else None

    def of_tasks(self, variant: Variant, beside: Variant | None = None) -> list[float]:
        """The success rate in each task that the variant was tried in, and ``beside``, if given, was tried in, too."""
        rates = (
            self.rate(variant, task) for task in self.tasks if beside is None or self.rate(beside, task) is not None
        )
        return [rate.value for rate in rates if rate is not None]

    def over_tasks(self, variant: Variant) -> tuple[float, float]:
        """Mean and standard deviation of the success rate over tasks."""
        return mean_and_deviation(self.of_tasks(variant))

    def of_scenes(self, variant: Variant) -> dict[Scene, Fraction]:
        """The share of executions that succeeded, scene by scene."""
        counts: dict[Scene, tuple[int, int]] = {}
        for row in self._rows[variant]:
            successes, trials = counts.get(row.scene, (0, 0))
            counts[row.scene] = successes + row.success, trials + 1
        return {scene: Fraction(*count) for scene, count in counts.items()}

    def best(self, task: str) -> float:
        """The highest success rate in ``task``."""
        return max(rate.value for variant in self.variants if (rate := self.rate(variant, task)) is not None)


def reference(variants: Sequence[Variant]) -> Variant | None:
    """The variant that others are tested against: RIP."""
    return next((variant for variant in variants if variant.method == "rip"), None)
