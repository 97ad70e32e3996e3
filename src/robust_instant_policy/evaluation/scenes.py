"""Which scenes are drawn, for showing and for testing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from robust_instant_policy.datasets import DatasetWriter, load_demonstrations
from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.errors import NoDemonstrationsError
from robust_instant_policy.tasks.record import record
from robust_instant_policy.tasks.task import Task

FIRST_TEST_SEED = 100_000  # demonstrations draw scenes from 0 on, tests from here on
SEEDS_A_RUN = 1_000  # apart, so that runs with different --seed share no scene


def scene_seed(seed: int, index: int) -> int:
    """Seed of the ``index``-th test scene of a run with ``--seed seed``."""
    return FIRST_TEST_SEED + seed * SEEDS_A_RUN + index


def count_demonstrations(folder: Path, task: str) -> int:
    """How many demonstrations of ``task`` are in ``folder``; 0 where there is nothing."""
    try:
        return len(load_demonstrations(folder, task=task))
    except NoDemonstrationsError:
        return 0


def obtain_demonstrations(
    task: Task, folder: Path, count: int, on_progress: Callable[[int, int, int], None] | None = None
) -> list[Demonstration]:
    """The first ``count`` demonstrations of ``task`` in ``folder``, recorded now where they are not there yet.

    ``on_progress`` receives (episodes there, episodes wanted, attempts thrown away).
    """
    if count_demonstrations(folder, task.name) < count:
        with DatasetWriter(folder, task=task.name, description=task.description, rate_hz=task.record_hz) as writer:
            record(task, writer, count, on_progress=on_progress)
    return load_demonstrations(folder, task=task.name, limit=count)
