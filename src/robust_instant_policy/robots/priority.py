"""Real-time priorities, where the system permits them: root, or ``rtprio`` in /etc/security/limits.conf."""

from __future__ import annotations

import contextlib
import os

CONTROL = 1  # of the thread that commands arms; the lowest there is
DEVICE = 2  # of an emulated device: a real one has a processor of its own


def take_real_time(priority: int) -> None:
    """Give this thread, and those that it starts from now on, a real-time ``priority``; else nothing changes."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
