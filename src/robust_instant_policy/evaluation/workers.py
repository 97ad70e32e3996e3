"""A pool of workers that do scenes: which scene goes to which worker, what an error and a death mean.

`evaluation.processes` and `evaluation.cluster` are the two kinds of pools.
"""

from __future__ import annotations

import traceback
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

from robust_instant_policy.errors import RipError
from robust_instant_policy.evaluation.variant import Scene
from robust_instant_policy.evaluation.work import Outcome, SceneWork

MAX_DEATHS = 3  # workers that one scene may take with it before the run gives up

# Sums depend in their last bits on the number of threads that share them, and prompts on every bit: one thread a
# worker gives the same rows whatever the machine. It is faster, too; --workers is the way to use more cores.
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@dataclass(frozen=True)
class Finished:
    """A worker has done all of its scene."""


@dataclass(frozen=True)
class Died:
    """A worker has ended because of ``cause``."""

    cause: str


@dataclass(frozen=True)
class WorkError:
    """An error that ended a worker's work, in words that travel: errors themselves need not survive a pipe."""

    words: str
    exit_code: int
    trace: str

    @classmethod
    def of(cls, error: Exception) -> WorkError:
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


Message = Outcome | Finished | WorkError | Died


@dataclass(eq=False)
class Worker:
    """A worker as the pool sees it: its scene (None: it is free), its simulator's task, and the scene's outcomes."""

    work: SceneWork | None = None
    task: str = ""
    outcomes: list[Outcome] = field(default_factory=list)


W = TypeVar("W", bound=Worker)


class Pool(Protocol[W]):
    """Workers of one kind. One that died is replaced by the next `workers`."""

    def workers(self, wanted: int) -> Sequence[W]:
        """Those alive, up to ``wanted`` of them where there is room."""
        ...

    def give(self, worker: W, work: SceneWork) -> None:
        """Have ``worker`` begin; that it died in the meantime is said by `receive`."""
        ...

    def receive(self, busy: Collection[W]) -> Iterator[tuple[W, Message]]:
        """The next messages of any of ``busy``; none after a while of silence."""
        ...

    def close(self) -> None:
        """End all workers, also those at work."""
        ...


def run_pool(pool: Pool[W], works: Iterable[SceneWork]) -> Iterator[Outcome]:
    """Do ``works``. A worker that dies loses the execution under way; others do the rest of its scene.

    Raises `RipError` with the words of an error that a worker met, or where a scene ends one worker after the other.
    """
    agenda = Agenda(works)
    busy: list[W] = []
    try:
        while agenda or busy:
            for worker in pool.workers(len(agenda) + len(busy)):
                if worker.work is not None:
                    continue
                work = agenda.next(worker.task, [other.task for other in busy])
                if work is not None:
                    worker.work, worker.task, worker.outcomes = work, work.scene.task, []
                    busy.append(worker)
                    pool.give(worker, work)
            for worker, message in pool.receive(busy):
                if isinstance(message, WorkError):
                    raise message.as_error()
                if isinstance(message, Finished):
                    worker.work = None
                    busy.remove(worker)
                elif isinstance(message, Died):
                    busy.remove(worker)
                    assert worker.work is not None
                    agenda.put_back(worker.work.without(worker.outcomes), message.cause)
                else:
                    worker.outcomes.append(message)
                    yield message
    finally:
        pool.close()


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
