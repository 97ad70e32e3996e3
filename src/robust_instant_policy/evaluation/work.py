"""What a worker is given, and what it gives back."""

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
    """What every worker needs to know: the language model, where samples and demonstrations are, and what to keep.

    ``llm`` is a line for `llm.connect`; with ``replay`` only stored answers are used. ``deadline_s`` bounds the
    sampling for one plan. With ``films`` every failed episode is filmed. ``checkpoints`` is where methods that are
    trained keep their weights; ``demo_set`` is the number of the set of demonstrations that ``data`` holds.
    """

    llm: str
    replay: bool
    store: Path
    data: Path
    deadline_s: float
    films: bool
    checkpoints: Path = DEFAULT_CHECKPOINTS
    demo_set: int = 0


@dataclass(frozen=True)
class Analysis:
    """The analysis of a failed episode; ``video`` is an MP4, empty where none was wanted or nothing moved."""

    failure: Failure
    video: bytes = b""


@dataclass(frozen=True, eq=False)
class Planned:
    """A plan that is kept, for a picture."""

    scene: Scene
    variant: Variant
    plan: Plan


Outcome = Episode | Analysis | Planned


@dataclass(frozen=True)
class SceneWork:
    """What is still to be done in one scene: the ``variants`` that lack executions, those ``done`` before, the
    ``failed`` episodes that have not been analysed yet, and the variants whose ``plans`` are wanted.
    """

    scene: Scene
    variants: tuple[Variant, ...]
    done: frozenset[EpisodeKey] = frozenset()
    failed: tuple[Episode, ...] = ()
    plans: tuple[Variant, ...] = ()

    @property
    def concerned(self) -> tuple[Variant, ...]:
        """Every variant that any of it is about."""
        return (*self.variants, *(episode.variant for episode in self.failed), *self.plans)

    @property
    def demos(self) -> int:
        """The most demonstrations that any of it needs."""
        return max(variant.demos for variant in self.concerned)

    def without(self, outcomes: Collection[Outcome]) -> SceneWork:
        """What is left of the work once ``outcomes`` are there."""
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


# Workers, on this machine or many: they do scenes in any order, each as soon as one of them is free.
Workers = Callable[[Setup, list[SceneWork]], Iterator[Outcome]]
