"""Rows counted: how often a variant succeeds, in a task and in a scene."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.evaluation.statistics import mean_and_deviation, wilson_interval
from robust_instant_policy.evaluation.suites import Suite
from robust_instant_policy.evaluation.variant import Scene, Variant
from robust_instant_policy.policies import METHOD_NAMES


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
