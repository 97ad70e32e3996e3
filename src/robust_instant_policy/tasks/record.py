"""Recording demonstrations: the demonstrator tries one scene after another; only successes are stored."""

from collections.abc import Callable
from dataclasses import replace
from inspect import signature
from typing import Any

from robust_instant_policy.datasets import DatasetWriter
from robust_instant_policy.errors import RipError, UsageError
from robust_instant_policy.interrupts import raise_pending
from robust_instant_policy.tasks.task import Task, require

MAX_FAILURES_IN_A_ROW = 50  # after as many failures in a row, recording stops

Progress = Callable[[int, int, int], None]


def record(
    task: Task,
    writer: DatasetWriter,
    num_episodes: int,
    seed: int = 0,
    with_images: bool = False,
    every: int = 1,
    on_progress: Progress | None = None,
) -> int:
    """Record until ``writer`` holds ``num_episodes``, trying the scenes ``seed``, ``seed + 1``, … in turn.

    ``with_images`` and ``every`` as in `Task.demonstrate`; the writer's rate is that of the steps that are kept.
    Continues after the last seed of the writer, so an interrupted recording gets the same episodes as an
    uninterrupted one. Demonstrations are labelled with the task's name and the seed. After every attempt
    ``on_progress`` receives (stored episodes, requested episodes, discarded attempts). Returns the number of discarded
    attempts. Raises `MissingMethodError` for a task without a demonstrator.
    """
    require(task, "demonstrate")
    asked: dict[str, Any] = {"with_images": with_images, "every": every} if with_images or every > 1 else {}
    known = signature(task.demonstrate).parameters.values()
    if not set(asked) <= {one.name for one in known} and not any(one.kind is one.VAR_KEYWORD for one in known):
        raise UsageError(
            f"demonstrate() of the task {task.name} takes no with_images and every; what learns from images needs them"
        )
    if writer.last_seed is not None:
        seed = max(seed, writer.last_seed + 1)
    in_a_row = 0
    while writer.num_episodes < num_episodes:
        raise_pending()
        attempt = task.demonstrate(seed, **asked)
        if attempt.success:
            writer.add(replace(attempt.demonstration, task=task.name, seed=seed), attempt.images, attempt.grippers)
            in_a_row = 0
        else:
            writer.discard(seed)
            in_a_row += 1
            if in_a_row == MAX_FAILURES_IN_A_ROW:
                raise RipError(
                    f"the demonstrator of {task.name} failed {in_a_row} times in a row, last because "
                    f"{attempt.failure}; this task cannot be recorded"
                )
        seed += 1
        if on_progress is not None:
            on_progress(writer.num_episodes, num_episodes, writer.discarded)
    return writer.discarded
