"""Record the demonstrations that an evaluation lacks, several tasks at a time."""

import multiprocessing
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from robust_instant_policy.evaluation.processes import end_with_parent, one_thread_each
from robust_instant_policy.evaluation.scenes import obtain_demonstrations
from robust_instant_policy.evaluation.variant import Scene
from robust_instant_policy.evaluation.workers import WorkError
from robust_instant_policy.tasks import make_task

Report = Callable[[str, int, int, int], None]  # task, episodes stored, episodes wanted, attempts discarded


@dataclass(frozen=True)
class Recording:
    """``count`` demonstrations of the task of ``scene`` in ``folder``, of the set ``demo_set``."""

    scene: Scene
    folder: Path
    count: int
    with_images: bool
    demo_set: int

    def make(self, report: Report) -> None:
        """Record what the folder lacks."""
        with closing(make_task(self.scene.task, assets=self.scene.assets, level=self.scene.level)) as task:
            progress = partial(report, self.scene.task)
            obtain_demonstrations(task, self.folder, self.count, progress, self.with_images, self.demo_set)


def record_all(recordings: Sequence[Recording], processes: int, report: Report) -> None:
    """Make ``recordings``, ``processes`` at a time; then each is reported once, when it is complete.

    Raises the first error as `RipError`; finished demonstrations are kept.
    """
    if processes == 1 or len(recordings) < 2:
        for recording in recordings:
            recording.make(report)
        return
    context = multiprocessing.get_context("spawn")
    with (
        one_thread_each(),
        ProcessPoolExecutor(min(processes, len(recordings)), context, initializer=_begin) as pool,
    ):
        for result in as_completed([pool.submit(_make, recording) for recording in recordings]):
            error, told = result.result()
            if error is not None:
                pool.shutdown(wait=False, cancel_futures=True)
                raise error.as_error()
            report(*told)


def _begin() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def _make(recording: Recording) -> tuple[WorkError | None, tuple[str, int, int, int]]:
    last = (recording.scene.task, recording.count, recording.count, 0)

    def keep(task: str, there: int, count: int, discarded: int) -> None:
        nonlocal last
        last = task, there, count, discarded

    try:
        recording.make(keep)
    except Exception as error:  # errors of this package cannot be pickled
        return WorkError.of(error), last
    return None, last
