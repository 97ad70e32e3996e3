"""Ctrl-C, a terminal that closes and a polite kill become a request to stop, which the control loop obeys."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

REASONS = {
    signal.SIGINT: "Ctrl-C",
    signal.SIGTERM: "the process was asked to end",
    signal.SIGHUP: "the terminal or the SSH connection was closed",
}


class StopRequest:
    """``reason`` is empty until somebody asks to stop."""

    def __init__(self) -> None:
        self.reason = ""

    def __call__(self, reason: str) -> None:
        self.reason = self.reason or reason


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """A `StopRequest` that the signals of `REASONS` make; before and after, they do what they usually do."""
    stop = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield stop  # only the main thread may handle signals
        return

    def handle(number: int, frame: FrameType | None) -> None:
        stop(REASONS[signal.Signals(number)])

    before = {number: signal.signal(number, handle) for number in REASONS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
