"""What is handed to a worker, what it hands back, and in which order scenes are handed out."""

from __future__ import annotations

import traceback
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from robust_instant_policy.errors import RipError
from robust_instant_policy.evaluation.episodes import Episode, EpisodeKey
from robust_instant_policy.evaluation.failures import Failure
from robust_instant_policy.evaluation.variant import Scene, Variant
from robust_instant_policy.policies import Plan
from robust_instant_policy.policies.training import DEFAULT_CHECKPOINTS

STORE_FILE = "samples.sqlite"  # in a run's folder: every answer of the language model
MAX_DEATHS = 3  # workers that one scene may take with it before the run gives up


@dataclass(frozen=True)
class Setup:
    """What every worker needs to know: the language model, where samples and demonstrations are, and what to keep.

    ``llm`` is a line for `llm.connect`; with ``replay`` only stored answers are used. ``deadline_s`` bounds the
    sampling for one plan. With ``films`` every failed episode is filmed. ``checkpoints`` is where methods that are
    trained keep their weights.
    """

    llm: str
    replay: bool
    store: Path
    data: Path
    deadline_s: float
    films: bool
    checkpoints: Path = DEFAULT_CHECKPOINTS


@dataclass(frozen=True)
class Analysis:
    """A failed episode taken apart; ``video`` is an MP4, empty where none was wanted or nothing moved."""

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
    ``failed`` episodes that nobody has taken apart yet, and the variants whose ``plans`` are wanted.
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


@dataclass(frozen=True)
class Trouble:
    """An error that ended a worker's work, in words that travel: errors themselves need not survive a pipe."""

    words: str
    exit_code: int
    trace: str

    @classmethod
    def of(cls, error: Exception) -> Trouble:
        """To be called where ``error`` was caught."""
        if isinstance(error, RipError):
            return cls(str(error), error.exit_code, traceback.format_exc())
        return cls(f"unexpected {type(error).__name__}: {error}", RipError.exit_code, traceback.format_exc())

    def as_error(self) -> RipError:
        """The error to raise where the rows are kept; ``--debug`` shows the worker's trace."""
        error = RipError(self.words)
        error.exit_code = self.exit_code
        error.add_note(self.trace)
        return error


class Hands(Protocol):
    """Workers, on this machine or many: they do scenes in any order, each as soon as there is somebody free."""

    def __call__(self, setup: Setup, works: list[SceneWork]) -> Iterator[Outcome]: ...


class Agenda:
    """Scenes to hand out: a worker stays with its task, because a simulator takes seconds to start."""

    def __init__(self, works: Iterable[SceneWork]):
        self._works = list(works)
        self._deaths: dict[Scene, int] = {}

    def __len__(self) -> int:
        return len(self._works)

    def next(self, own: str, elsewhere: Iterable[str]) -> SceneWork | None:
        """The next scene for a worker whose simulator runs the task ``own``; tasks that run ``elsewhere`` come last."""
        if not self._works:
            return None
        busy = set(elsewhere)
        best = min(self._works, key=lambda work: (work.scene.task != own, work.scene.task in busy))
        self._works.remove(best)
        return best

    def put_back(self, work: SceneWork, cause: str) -> None:
        """Have ``work`` done again, after its worker died of ``cause``; raises `RipError` when that is hopeless."""
        deaths = self._deaths[work.scene] = self._deaths.get(work.scene, 0) + 1
        if deaths >= MAX_DEATHS:
            raise RipError(
                f"scene {work.scene} ended {deaths} workers, the last with {cause}; what was finished is kept: use "
                "fewer --workers if memory ran out, and run the same command again to go on"
            )
        self._works.insert(0, work)
