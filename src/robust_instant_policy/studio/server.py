"""The server of the page: from the command's options to a running studio."""

import contextlib
import io
import signal
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import viser

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.plugins import is_own
from robust_instant_policy.studio.cell import Cell
from robust_instant_policy.studio.gate import Gate
from robust_instant_policy.studio.page import Page
from robust_instant_policy.studio.recorded import RecordedCell
from robust_instant_policy.studio.session import Session
from robust_instant_policy.studio.simulated import SimulatedCell
from robust_instant_policy.tasks import TASK_NAMES, is_installed

FAREWELL_S = 0.3  # for browsers to be told that the server stops


@dataclass(frozen=True)
class Choice:
    """What the command was asked for. Demonstrations of ``task`` are in ``demos``, of other tasks in ``data/TASK``.

    A ``task`` that is not simulated, or one with an ``observation``, is a folder to look at and to plan for.
    """

    task: str
    demos: Path | None
    data: Path
    llm: str = "embedded"
    observation: Observation | None = None

    def folder(self, task: str) -> Path:
        return self.demos if self.demos is not None and task == self.task else self.data / task

    def cell(self, task: str, demonstrations: Sequence[Demonstration]) -> Cell:
        if (is_own(task) or is_installed(task)) and (self.observation is None or task != self.task):
            return SimulatedCell(task)
        return RecordedCell(task, demonstrations, self.observation if task == self.task else None)


@contextlib.contextmanager
def studio(choice: Choice, host: str, port: int) -> Iterator[tuple[Page, str]]:
    """A page that is being served, and its address; its `Page.session` must be run."""
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints the address behind the gate
        server = viser.ViserServer(host="127.0.0.1", port=0, label="RIP studio", verbose=False)
    gate = None
    try:
        gate = Gate(host, port, server.get_port())
        tasks = (*TASK_NAMES, *({choice.task} - set(TASK_NAMES)))
        page = Page(server, tasks, choice.folder, choice.cell, choice.llm)
        page.open(choice.task)
        yield page, gate.address
        page.plans.planner.close()
        page.say_stopped()
        time.sleep(FAREWELL_S)
    finally:
        if gate is not None:
            gate.close()
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def serve(choice: Choice, host: str, port: int) -> None:
    """Serve the studio until Ctrl-C or SIGTERM."""
    with studio(choice, host, port) as (page, address), _stop_by_signal(page.session):
        print(f"rip studio: {address}\nOpen this address in a browser; Ctrl-C stops the studio.", flush=True)
        try:
            page.session.run()
        finally:
            page.session.close()
        print("rip studio: stopped; what was kept is on the disk", flush=True)


@contextlib.contextmanager
def _stop_by_signal(session: Session) -> Iterator[None]:
    """Ctrl-C and SIGTERM stop ``session`` once its present work is done: an exception while a simulator
    loads leaves it half loaded. The second signal raises `KeyboardInterrupt`."""
    numbers = signal.SIGINT, signal.SIGTERM

    def stop(*_: object) -> None:
        session.stop()
        for number in numbers:
            signal.signal(number, signal.default_int_handler)

    before = [signal.signal(number, stop) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
