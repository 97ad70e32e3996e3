"""Real-time priorities, where the system permits them: root, or ``rtprio`` in /etc/security/limits.conf."""

import contextlib
import os
from collections.abc import Iterator

CONTROL = 1  # of the thread that commands arms; the lowest there is
DEVICE = 2  # of an emulated device: a real one has a processor of its own


def take_real_time(priority: int) -> None:
    """Give this thread, and those that it starts from now on, a real-time ``priority``; else nothing changes."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


@contextlib.contextmanager
def real_time(priority: int) -> Iterator[None]:
    """`take_real_time` while the context lasts."""
    policy, usual = os.sched_getscheduler(0), os.sched_getparam(0)
    take_real_time(priority)
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, usual)
