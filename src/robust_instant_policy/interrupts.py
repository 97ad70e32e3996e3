"""Handling of Ctrl-C so that none is lost.

Python prints and drops a `KeyboardInterrupt` that is raised inside a destructor, a callback of a weak reference
(imports have many) or a callback of a C library. So each Ctrl-C is noted, too, and raised again by `raise_pending`.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_pending = threading.Event()


@contextmanager
def noted_interrupts() -> Iterator[None]:
    """Note each Ctrl-C while the context lasts. Does nothing where Ctrl-C does not raise `KeyboardInterrupt`."""
    _pending.clear()
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield  # a background job, or a program with a handler of its own
        return

    def handle(number: int, frame: FrameType | None) -> None:
        _pending.set()
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def blocked(*numbers: signal.Signals) -> Iterator[None]:
    """Signals of ``numbers`` wait until the end of the context; processes that start within it inherit that."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def raise_pending() -> None:
    """Raise `KeyboardInterrupt` if a Ctrl-C was noted but dropped."""
    if _pending.is_set():
        raise KeyboardInterrupt
