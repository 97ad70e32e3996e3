"""Distribute scenes over a pool of workers, and handle errors and deaths of workers.

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

MAX_DEATHS = 3  # workers that may die in one scene before the run stops

# The last bits of a sum depend on the number of threads, and prompts depend on these bits. With one thread per worker,
# rows do not depend on the machine. Use --workers for more cores.
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@dataclass(frozen=True)
class Finished:
    """A worker has finished its scene."""


@dataclass(frozen=True)
class Died:
    """A worker has died of ``cause``."""

    cause: str


@dataclass(frozen=True)
class WorkError:
    """An error in a worker, as text, because not every exception can be pickled."""

    message: str
    exit_code: int
    trace: str

    @classmethod
    def of(cls, error: Exception) -> WorkError:
        """Call it in the ``except`` block: it stores the traceback."""
        if isinstance(error, RipError):
            return cls(str(error), error.exit_code, traceback.format_exc())
        return cls(f"unexpected {type(error).__name__}: {error}", RipError.exit_code, traceback.format_exc())

    def as_error(self) -> RipError:
        """The same error for the main process; ``--debug`` shows the worker's traceback."""
        error = RipError(self.message)
        error.exit_code = self.exit_code
        error.add_note(self.trace)
        return error


Message = Outcome | Finished | WorkError | Died


@dataclass(eq=False)
class Worker:
    """State of a worker: its scene (None: idle), the task of its simulator, and the outcomes of the scene so far."""

    work: SceneWork | None = None
    task: str = ""
    outcomes: list[Outcome] = field(default_factory=list)


W = TypeVar("W", bound=Worker)


class Pool(Protocol[W]):
    """Workers of one kind. The next call of `workers` replaces those that died."""

    def workers(self, wanted: int) -> Sequence[W]:
        """The live workers, at most ``wanted``; starts new ones if there are free cores."""
        ...

    def give(self, worker: W, work: SceneWork) -> None:
        """Send ``work`` to ``worker``; `receive` reports a worker that has died."""
        ...

    def receive(self, busy: Collection[W]) -> Iterator[tuple[W, Message]]:
        """The next messages of the workers in ``busy``; may be empty."""
        ...

    def close(self) -> None:
        """End all workers, including busy ones."""
        ...


def run_pool(pool: Pool[W], works: Iterable[SceneWork]) -> Iterator[Outcome]:
    """Do ``works``. A worker that dies loses its current execution; others do the rest of its scene.

    Raises the error of a worker as `RipError`, and `RipError` if `MAX_DEATHS` workers die in one scene.
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
    """Queue of scenes. A worker stays with its task, because a simulator takes seconds to start."""

    def __init__(self, works: Iterable[SceneWork]):
        self._works = list(works)
        self._deaths: dict[Scene, int] = {}

    def __len__(self) -> int:
        return len(self._works)

    def next(self, own: str, elsewhere: Iterable[str]) -> SceneWork | None:
        """The next scene for a worker whose simulator runs the task ``own``; tasks of other workers come last."""
        if not self._works:
            return None
        busy = set(elsewhere)
        best = min(self._works, key=lambda work: (work.scene.task != own, work.scene.task in busy))
        self._works.remove(best)
        return best

    def put_back(self, work: SceneWork, cause: str) -> None:
        """Queue ``work`` again after its worker died of ``cause``; raises `RipError` at the `MAX_DEATHS`-th death."""
        deaths = self._deaths[work.scene] = self._deaths.get(work.scene, 0) + 1
        if deaths >= MAX_DEATHS:
            raise RipError(
                f"scene {work.scene} ended {deaths} workers, the last with {cause}; finished work is kept: use "
                "fewer --workers if memory ran out, and run the same command again to continue"
            )
        self._works.insert(0, work)
