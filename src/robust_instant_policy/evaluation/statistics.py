"""Statistics of success rates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from scipy import stats

from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.evaluation.variant import Scene

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
