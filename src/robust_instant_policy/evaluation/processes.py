"""Workers on this machine: processes of their own, so that nothing that happens to one of them ends the run."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from robust_instant_policy.evaluation.work import Agenda, Outcome, SceneWork, Setup, Trouble
from robust_instant_policy.evaluation.workbench import Workbench

# Sums depend in their last bits on the number of threads that share them, and prompts on every bit: one thread a
# worker gives the same rows whatever the machine. It is faster, too; --workers is the way to use more cores.
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
POLITE_SECONDS = 5.0  # that a worker gets to end by itself


@dataclass(frozen=True)
class Processes:
    """``count`` worker processes."""

    count: int

    def __call__(self, setup: Setup, works: list[SceneWork]) -> Iterator[Outcome]:
        """Do ``works``. A worker that dies loses the execution under way and is replaced; others go on.

        Raises `RipError` with the words of an error that a worker met.
        """
        agenda = Agenda(works)
        team = [_Worker(setup) for _ in range(min(self.count, len(works)))]
        try:
            while True:
                for worker in team:
                    if worker.work is None:
                        others = [other.task for other in team if other is not worker]
                        worker.give(agenda.next(worker.task, others))
                at_work = {worker.pipe: worker for worker in team if worker.work is not None}
                if not at_work:
                    return
                for pipe in wait(list(at_work)):
                    worker = at_work[pipe]  # type: ignore[index]
                    try:
                        outcome = worker.receive()
                    except (EOFError, OSError):
                        agenda.put_back(worker.left(), worker.cause_of_death())
                        team[team.index(worker)] = _Worker(setup)
                        continue
                    if outcome is not None:
                        yield outcome
        finally:
            for worker in team:
                worker.end()


@dataclass
class _Worker:
    """A process, the scene it was given and what it has said of it."""

    setup: Setup
    work: SceneWork | None = None
    task: str = ""
    outcomes: list[Outcome] = field(default_factory=list)

    def __post_init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe: Connection[Any, Any]
        self.pipe, theirs = context.Pipe()
        self.process: BaseProcess = context.Process(target=_serve, args=(theirs, self.setup), daemon=True)
        with one_thread_each():
            self.process.start()
        theirs.close()

    def give(self, work: SceneWork | None) -> None:
        if work is not None:
            self.work, self.task, self.outcomes = work, work.scene.task, []
            with suppress(OSError):  # a process that died in the meantime is found out on receiving
                self.pipe.send(work)

    def receive(self) -> Outcome | None:
        """The next outcome, or None once the scene is done; `EOFError` when the process is no more."""
        said = self.pipe.recv()
        if said is None:
            self.work = None
            return None
        if isinstance(said, Trouble):
            raise said.as_error()
        self.outcomes.append(said)
        return said

    def left(self) -> SceneWork:
        """What a process that died has not done."""
        assert self.work is not None
        return self.work.without(self.outcomes)

    def cause_of_death(self) -> str:
        self.process.join(POLITE_SECONDS)
        code = self.process.exitcode
        return f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit status {code}"

    def end(self) -> None:
        self.pipe.close()
        if self.work is not None:
            self.process.terminate()
        self.process.join(POLITE_SECONDS)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Processes started meanwhile compute with one thread."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def end_with_parent() -> None:
    """Have this process end at once when the one that started it is no more, killed or not.

    It would find out only with its next row, and plan on for minutes until then.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _serve(pipe: Connection, setup: Setup) -> None:
    """The life of a worker: a scene comes in, its outcomes go out one by one, until nobody listens any more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one who keeps the rows
    end_with_parent()
    bench = Workbench(setup)
    try:
        while True:
            work = pipe.recv()
            for outcome in bench.run(work):
                pipe.send(outcome)
            pipe.send(None)
    except (EOFError, BrokenPipeError):
        pass
    except Exception as error:
        pipe.send(Trouble.of(error))
    finally:
        bench.close()
