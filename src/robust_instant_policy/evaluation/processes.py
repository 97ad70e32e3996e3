"""Worker processes on this machine: the death of one does not end the run.

A local Ray takes 10 s to start, processes 0.3 s; hence two kinds of pools.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from robust_instant_policy.evaluation.work import Outcome, SceneWork, Setup
from robust_instant_policy.evaluation.workbench import Workbench
from robust_instant_policy.evaluation.workers import ONE_THREAD, Died, Finished, Message, Worker, WorkError, run_pool

EXIT_SECONDS = 5.0  # before a worker that does not end is killed
PR_SET_PDEATHSIG = 1  # of Linux's prctl


@dataclass(frozen=True)
class LocalWorkers:
    """``count`` worker processes."""

    count: int

    def __call__(self, setup: Setup, works: list[SceneWork]) -> Iterator[Outcome]:
        return run_pool(_Processes(setup, self.count), works)


@dataclass(eq=False, kw_only=True)
class _Process(Worker):
    process: BaseProcess
    pipe: Connection[Any, Any]

    def cause_of_death(self) -> str:
        self.process.join(EXIT_SECONDS)
        code = self.process.exitcode
        return f"signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"exit status {code}"

    def end(self) -> None:
        self.pipe.close()
        if self.work is not None:
            self.process.terminate()
        self.process.join(EXIT_SECONDS)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


@dataclass
class _Processes:
    """A `Pool` of up to ``most`` processes."""

    setup: Setup
    most: int
    alive: list[_Process] = field(default_factory=list)

    def workers(self, wanted: int) -> list[_Process]:
        while len(self.alive) < min(self.most, wanted):
            self.alive.append(self._start())
        return self.alive

    def give(self, worker: _Process, work: SceneWork) -> None:
        with suppress(OSError):
            worker.pipe.send(work)

    def receive(self, busy: Collection[_Process]) -> Iterator[tuple[_Process, Message]]:
        pipes = {worker.pipe: worker for worker in busy}
        for pipe in wait(list(pipes)):
            worker = pipes[pipe]  # type: ignore[index]
            try:
                yield worker, worker.pipe.recv()
            except (EOFError, OSError):
                self.alive.remove(worker)
                yield worker, Died(worker.cause_of_death())

    def close(self) -> None:
        for worker in self.alive:
            worker.end()

    def _start(self) -> _Process:
        context = multiprocessing.get_context("spawn")
        pipe, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, self.setup), daemon=True)
        with one_thread_each():
            process.start()
        theirs.close()
        return _Process(process=process, pipe=pipe)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Processes that are started in the ``with`` block compute with one thread."""
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
    """End this process at once when its parent ends, not minutes later with its next row.

    On Linux the kernel does it, also while a library holds the interpreter's lock; on other systems a thread does.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent.pid:  # it ended before prctl was called
            os._exit(1)
        return

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _serve(pipe: Connection, setup: Setup) -> None:
    """Receive scenes from ``pipe`` and send their outcomes one by one, until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent, which stores the rows, handles Ctrl-C
    end_with_parent()
    bench = Workbench(setup)
    try:
        while True:
            work = pipe.recv()
            for outcome in bench.run(work):
                pipe.send(outcome)
            pipe.send(Finished())
    except (EOFError, BrokenPipeError):
        pass
    except Exception as error:
        pipe.send(WorkError.of(error))
    finally:
        bench.close()
