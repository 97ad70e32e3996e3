"""The server of the page: from the command's options to a running studio."""

from __future__ import annotations

import contextlib
import io
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import viser

from robust_instant_policy.studio.gate import Gate
from robust_instant_policy.studio.page import Page
from robust_instant_policy.tasks import TASK_NAMES

FAREWELL_S = 0.3  # for browsers to be told that the server stops


@contextlib.contextmanager
def studio(task: str, demos: Path | None, data: Path, llm: str, host: str, port: int) -> Iterator[tuple[Page, str]]:
    """A page that is being served, and its address; its `Page.session` must be run.

    Demonstrations of ``task`` are kept in ``demos``, those of other tasks in ``data/TASK``.
    """
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints the address behind the gate
        server = viser.ViserServer(host="127.0.0.1", port=0, label="RIP studio", verbose=False)
    gate = None
    try:
        gate = Gate(host, port, server.get_port())
        page = Page(server, TASK_NAMES, lambda name: demos if demos and name == task else data / name)
        page.open(task)
        yield page, gate.address
        page.say_stopped()
        time.sleep(FAREWELL_S)
    finally:
        if gate is not None:
            gate.close()
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def serve(task: str, demos: Path | None, data: Path, llm: str, host: str, port: int) -> None:
    """Serve the studio until Ctrl-C."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with studio(task, demos, data, llm, host, port) as (page, address):
            print(f"rip studio: {address}\nOpen this address in a browser; Ctrl-C stops the studio.", flush=True)
            try:
                page.session.run()
            except KeyboardInterrupt:
                print("rip studio: stopped; what was kept is on the disk", flush=True)
            finally:
                page.session.close()
    finally:
        signal.signal(signal.SIGTERM, before)
