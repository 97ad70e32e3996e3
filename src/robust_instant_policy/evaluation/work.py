"""The input of a worker (`Setup`, `SceneWork`) and its output (`Outcome`)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from robust_instant_policy.evaluation.episodes import Episode, EpisodeKey
from robust_instant_policy.evaluation.failures import Failure
from robust_instant_policy.evaluation.variant import Scene, Variant
from robust_instant_policy.policies import Plan
from robust_instant_policy.policies.training import DEFAULT_CHECKPOINTS

STORE_FILE = "samples.sqlite"  # in a run's folder: every answer of the language model


@dataclass(frozen=True)
class Setup:
    """Settings that all workers share.

    ``llm`` is a spec for `llm.connect`; with ``replay`` only the answers in ``store`` are used. ``data`` is the folder
    of demonstrations, ``deadline_s`` the time limit of the sampling for one plan. With ``analyses`` each failed
    episode is analysed, and with ``films`` filmed. ``checkpoints`` is the folder for the weights of trained methods;
    ``demo_set`` is the number of the set of demonstrations in ``data``.
    """

    llm: str
    replay: bool
    store: Path
    data: Path
    deadline_s: float
    films: bool
    checkpoints: Path = DEFAULT_CHECKPOINTS
    demo_set: int = 0
    analyses: bool = True


@dataclass(frozen=True)
class Analysis:
    """The analysis of a failed episode; ``video`` is an MP4, empty if not requested or if nothing moved."""

    failure: Failure
    video: bytes = b""


@dataclass(frozen=True, eq=False)
class Planned:
    """A plan that is stored for a figure."""

    scene: Scene
    variant: Variant
    plan: Plan


Outcome = Episode | Analysis | Planned


@dataclass(frozen=True)
class SceneWork:
    """Missing work in one scene: ``variants`` that lack executions, executions that are ``done``, ``failed`` episodes
    that are not analysed, and variants whose ``plans`` are to be stored.
    """

    scene: Scene
    variants: tuple[Variant, ...] = ()
    done: frozenset[EpisodeKey] = frozenset()
    failed: tuple[Episode, ...] = ()
    plans: tuple[Variant, ...] = ()

    @property
    def concerned(self) -> tuple[Variant, ...]:
        """All variants in this work."""
        return (*self.variants, *(episode.variant for episode in self.failed), *self.plans)

    @property
    def demos(self) -> int:
        """The largest number of demonstrations that a variant needs."""
        return max(variant.demos for variant in self.concerned)

    def without(self, outcomes: Collection[Outcome]) -> SceneWork:
        """The work that is left after ``outcomes``."""
        done, failed = set(self.done), {episode.key: episode for episode in self.failed}
        planned = {outcome.variant for outcome in outcomes if isinstance(outcome, Planned)}
        for outcome in outcomes:
            if isinstance(outcome, Analysis):
                failed.pop(outcome.failure.key, None)
            elif isinstance(outcome, Episode):
                done.add(outcome.key)
                if not outcome.success:
                    failed[outcome.key] = outcome
        plans = tuple(variant for variant in self.plans if variant not in planned)
        return replace(self, done=frozenset(done), failed=tuple(failed.values()), plans=plans)


# Does scenes in any order, in parallel, on one machine or many.
Workers = Callable[[Setup, list[SceneWork]], Iterator[Outcome]]
