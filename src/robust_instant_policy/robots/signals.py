"""Ctrl-C, SIGTERM and a closed terminal become a request to stop, which the control loop checks in each step."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from robust_instant_policy.errors import StoppedError
from robust_instant_policy.interrupts import raise_pending

REASONS = {
    signal.SIGINT: "Ctrl-C",
    signal.SIGTERM: "the process was asked to end",
    signal.SIGHUP: "the terminal or the SSH connection was closed",
}


class StopRequest:
    """``reason`` is empty until somebody asks to stop."""

    def __init__(self) -> None:
        self.reason, self._raises = "", False

    def __call__(self, reason: str) -> None:
        self.reason = self.reason or reason
        if self._raises:
            raise self.error()

    @contextmanager
    def ends_waiting(self) -> Iterator[None]:
        """Raise `StoppedError` at once, also in a call that waits for a device, while the context lasts: only where no
        arm moves."""
        if self.reason:
            raise self.error()
        self._raises = True
        try:
            yield
        finally:
            self._raises = False
        if self.reason:  # what was raised in a callback of a library was dropped
            raise self.error()

    def error(self) -> StoppedError:
        return StoppedError(f"{self.reason}; the arms hold their position")


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """A `StopRequest` that the signals of `REASONS` make; before and after, they do what they usually do.

    Raises `KeyboardInterrupt` for a Ctrl-C before it that was dropped.
    """
    stop = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield stop  # only the main thread may handle signals
        return

    def handle(number: int, frame: FrameType | None) -> None:
        stop(REASONS[signal.Signals(number)])

    before = {number: signal.signal(number, handle) for number in REASONS}
    try:
        raise_pending()
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
