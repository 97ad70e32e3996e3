"""Statistics of success rates: how often variants succeed, with intervals, and whether two of them differ.

The unit is the scene. Executions in one scene, of several candidates or with several sets of demonstrations, are no
independent trials: they meet the same objects in the same places.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from scipy import stats

from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.evaluation.suites import Suite
from robust_instant_policy.evaluation.variant import ROW_METHODS, Scene, Variant, labels
from robust_instant_policy.geometry import FloatArray

MARKS = ((5e-3, "**"), (5e-2, "*"))  # the paper's, below these p-values
CONFIDENCE = 0.95
RESAMPLES = 10_000  # of the bootstrap


def wilson_interval(successes: float, trials: int) -> tuple[float, float]:
    """95% confidence interval of a success rate (Wilson 1927); (0, 1) without trials.

    A trial is a scene, and ``successes`` the sum of the success rates in the scenes. The rate of a scene with several
    executions varies at most as much as a single execution with that probability, so the interval is not too narrow.
    """
    if not 0 <= successes <= trials:
        raise InvalidValueError(f"successes must lie between 0 and trials, got {successes} of {trials}")
    if trials == 0:
        return 0.0, 1.0
    z, mean = float(stats.norm.ppf((1 + CONFIDENCE) / 2)), successes / trials
    middle = (mean + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * math.sqrt(mean * (1 - mean) / trials + z**2 / (4 * trials**2))
    return max(0.0, middle - half), min(1.0, middle + half)


def auroc(score: FloatArray, positive: np.ndarray) -> float:
    """Probability that the ``score (N,)`` of a ``positive (N,)`` case is higher than that of another; ties count half.

    The area under the receiver operating characteristic (Mann and Whitney 1947); NaN where all cases are of one kind.
    """
    high, low = score[positive == 1], score[positive == 0]
    pairs = len(high) * len(low)
    return float(stats.mannwhitneyu(high, low).statistic / pairs) if pairs else math.nan


def mean_and_deviation(rates: Sequence[float]) -> tuple[float, float]:
    """Mean and standard deviation over tasks; the deviation is that of the tasks as a population, as in the paper."""
    return float(np.mean(rates)), float(np.std(rates))


def t_test(ours: Sequence[float], theirs: Sequence[float]) -> float:
    """Two-sided p of Student's t-test between two methods' success rates over the same tasks; NaN for fewer than two.

    Computed from `mean_and_deviation`: this reproduces all four significance marks of the paper from its own Table I.
    The unit is the task; shared scenes are not used (see `paired_test`).
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

    If the methods are equal, each scene's difference has either sign with equal probability: p is the share of all
    sign choices whose total is at least as far from 0. The unit is the scene. With one execution a scene this is
    McNemar's exact test.
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


def difference_interval(ours: Mapping[Scene, Fraction], theirs: Mapping[Scene, Fraction]) -> tuple[float, float]:
    """95% interval of the difference of two methods' success rates, averaged over tasks, by the cluster bootstrap:
    scenes that both methods share are drawn with replacement, task by task (Davison and Hinkley 1997, Sec. 3.8).

    NaN without shared scenes.
    """
    of_tasks: dict[str, list[float]] = {}
    for scene in ours:
        if scene in theirs:
            of_tasks.setdefault(scene.task, []).append(float(ours[scene] - theirs[scene]))
    if not of_tasks:
        return math.nan, math.nan
    rng = np.random.default_rng(0)
    means = [rng.choice(one, (RESAMPLES, len(one))).mean(axis=1) for one in of_tasks.values()]
    low, high = np.quantile(np.mean(means, axis=0), [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values corrected by Holm's method (Holm 1979), in the same order; NaN is no comparison and stays NaN."""
    corrected = [math.nan] * len(p_values)
    known = sorted((p, index) for index, p in enumerate(p_values) if not math.isnan(p))
    largest = 0.0
    for rank, (p, index) in enumerate(known):
        largest = max(largest, min(1.0, p * (len(known) - rank)))
        corrected[index] = largest
    return corrected


@dataclass(frozen=True)
class Rate:
    """Success of ``trials`` executions in some scenes: ``of_scenes`` are the shares that succeeded, scene by scene."""

    of_scenes: tuple[Fraction, ...]
    trials: int

    @property
    def value(self) -> float:
        return float(sum(self.of_scenes) / len(self.of_scenes))

    @property
    def scenes(self) -> int:
        return len(self.of_scenes)

    @property
    def interval(self) -> tuple[float, float]:
        """95%, see `wilson_interval`."""
        return wilson_interval(float(sum(self.of_scenes)), self.scenes)


@dataclass(frozen=True)
class Comparison:
    """The reference against ``variant``: ``difference`` of the success rates averaged over the tasks that both were
    tried in, with its ``interval``, the paper's t-test over these tasks, the test over scenes, and ``corrected``, its
    p-value by Holm's method. NaN where there is nothing to compare.
    """

    variant: Variant
    difference: float
    interval: tuple[float, float]
    t_test: float
    paired: Paired
    corrected: float

    @property
    def mark(self) -> str:
        """The paper's stars where the reference is better."""
        return mark(self.corrected) if self.difference > 0 else ""


class Summary:
    """The success of the variants of ``suite``, counted from those of ``episodes`` that belong to it.

    Variants that differ only in the set of demonstrations are one variant; its rates are averages over the sets. If a
    variant was run with different demonstrations of one task and set, the last ones count.
    """

    def __init__(self, suite: Suite, episodes: Iterable[Episode]):
        self.suite = suite
        scenes = set(suite.scenes)
        wanted = set(suite.variants)
        self._rows: dict[Variant, list[Episode]] = {of_any_set(variant): [] for variant in suite.variants}
        shown: dict[tuple[Variant, str], str] = {}
        for row in episodes:
            variant = replace(row.variant, demonstrations="")
            if variant in wanted and row.scene in scenes:
                self._rows[of_any_set(variant)].append(row)
                shown[variant, row.scene.task] = row.variant.demonstrations
        for rows in self._rows.values():
            rows[:] = [
                row
                for row in rows
                if row.variant.demonstrations == shown[replace(row.variant, demonstrations=""), row.scene.task]
            ]
        self.rows: list[Episode] = [row for rows in self._rows.values() for row in rows]
        known = [variant for variant, rows in self._rows.items() if rows]
        # a fixed order, independent of the order of the runs
        self.variants: list[Variant] = sorted(known, key=lambda variant: ROW_METHODS.index(variant.method))
        self.labels: dict[Variant, str] = dict(zip(self.variants, labels(self.variants), strict=True))
        self.tasks: list[str] = [task for task in suite.tasks if any(row.scene.task == task for row in self.rows)]

    def rows_of(self, variant: Variant, task: str | None = None) -> list[Episode]:
        """The executions of ``variant`` in ``task``, or in all."""
        return [row for row in self._rows.get(variant, ()) if task in (None, row.scene.task)]

    def rate(self, variant: Variant, task: str | None = None) -> Rate | None:
        """In ``task``, or all executions together; None where there were none."""
        rows = self.rows_of(variant, task)
        return Rate(tuple(_means_of_scenes(rows).values()), len(rows)) if rows else None

    def rates(self, variant: Variant, tasks: Iterable[str]) -> list[Rate]:
        """In those of ``tasks`` in which the variant was tried."""
        return [rate for task in tasks if (rate := self.rate(variant, task)) is not None]

    def of_tasks(self, variant: Variant, beside: Variant | None = None) -> list[float]:
        """The success rate in each task in which the variant, and ``beside`` if given, was tried."""
        tasks = (task for task in self.tasks if beside is None or self.rate(beside, task) is not None)
        return [rate.value for rate in self.rates(variant, tasks)]

    def over_tasks(self, variant: Variant) -> tuple[float, float]:
        """Mean and standard deviation of the success rate over tasks."""
        return mean_and_deviation(self.of_tasks(variant))

    def interval_over_tasks(self, variant: Variant) -> tuple[float, float]:
        """95% interval of the mean of `over_tasks`, see `wilson_interval`, with one trial a task and set of
        demonstrations: scenes that share what was shown are no independent trials."""
        clusters = {(row.scene.task, row.variant.demo_set) for row in self._rows[variant]}
        return wilson_interval(self.over_tasks(variant)[0] * len(clusters), len(clusters))

    def of_sets(self, variant: Variant) -> dict[int, float]:
        """For each set of demonstrations the success rate, averaged over tasks."""
        of_set: dict[int, list[Episode]] = {}
        for row in self._rows[variant]:
            of_set.setdefault(row.variant.demo_set, []).append(row)
        return {number: _over_tasks(_means_of_scenes(of_set[number])) for number in sorted(of_set)}

    def compare(self, ours: Variant) -> list[Comparison]:
        """``ours`` against every other variant, each over the scenes and sets of demonstrations that both have."""
        found = []
        for variant in self.variants:
            if variant == ours:
                continue
            known = [{(row.scene, row.variant.demo_set) for row in self._rows[one]} for one in (ours, variant)]
            both = known[0] & known[1]
            own, theirs = (
                _means_of_scenes(row for row in self._rows[one] if (row.scene, row.variant.demo_set) in both)
                for one in (ours, variant)
            )
            found.append(
                Comparison(
                    variant,
                    _over_tasks(own) - _over_tasks(theirs),
                    difference_interval(own, theirs),
                    t_test(self.of_tasks(ours, variant), self.of_tasks(variant, ours)),
                    paired_test(own, theirs),
                    math.nan,
                )
            )
        corrected = holm([one.paired.p if one.paired.scenes else math.nan for one in found])
        return [replace(one, corrected=p) for one, p in zip(found, corrected, strict=True)]

    def best(self, task: str) -> float:
        """The highest success rate in ``task``."""
        return max(rate.value for variant in self.variants if (rate := self.rate(variant, task)) is not None)


def of_any_set(variant: Variant) -> Variant:
    """``variant`` without its set of demonstrations."""
    return replace(variant, demo_set=0)


def _means_of_scenes(rows: Iterable[Episode]) -> dict[Scene, Fraction]:
    """Success rate of each scene: the average over sets of demonstrations."""
    counts: dict[Scene, dict[int, tuple[int, int]]] = {}
    for row in rows:
        of_sets = counts.setdefault(row.scene, {})
        successes, trials = of_sets.get(row.variant.demo_set, (0, 0))
        of_sets[row.variant.demo_set] = successes + row.success, trials + 1
    return {
        scene: sum((Fraction(*count) for count in of_sets.values()), Fraction(0)) / len(of_sets)
        for scene, of_sets in counts.items()
    }


def _over_tasks(rates: Mapping[Scene, Fraction]) -> float:
    """The average over tasks of the ``rates`` of scenes; NaN without scenes."""
    of_tasks: dict[str, list[Fraction]] = {}
    for scene, rate in rates.items():
        of_tasks.setdefault(scene.task, []).append(rate)
    if not of_tasks:
        return math.nan
    return float(np.mean([float(sum(own) / len(own)) for own in of_tasks.values()]))


def reference(variants: Sequence[Variant]) -> Variant | None:
    """The variant that others are tested against: RIP."""
    return next((variant for variant in variants if variant.method == "rip"), None)
