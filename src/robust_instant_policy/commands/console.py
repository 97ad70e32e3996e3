"""Progress on the terminal: one line per finished stage, a progress bar for the current one."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from robust_instant_policy.interrupts import raise_pending
from robust_instant_policy.policies.policy import Stage

TRAINING_LINE_S = 30.0  # between two progress lines of a training without a terminal


class StageConsole:
    """Prints stages with their times and stores them in ``stages``."""

    def __init__(self) -> None:
        self.console = Console(highlight=False, soft_wrap=True)
        self.stages: list[Stage] = []
        self._bar: Progress | None = None

    def say(self, line: str) -> None:
        self.console.print(line, markup=False)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage, with a progress bar on a terminal; a stage that raises is not counted."""
        raise_pending()
        self.done_so_far(name, 0, 0)
        start = time.perf_counter()
        try:
            yield
        finally:
            if self._bar is not None:
                self._bar.stop()
                self._bar = None
        raise_pending()
        seconds = time.perf_counter() - start
        self.stages.append(Stage(name, seconds))
        self.say(f"  {name:<34}{seconds:7.1f} s")

    def done_so_far(self, name: str, done: int, total: int) -> None:
        """Update the bar; a `Progress` for the policies."""
        if not self.console.is_terminal:
            return
        if self._bar is None:
            self._bar = Progress(
                SpinnerColumn(),
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                console=self.console,
                transient=True,
            )
            self._bar.add_task(name, total=None)
            self._bar.start()
        self._bar.update(self._bar.task_ids[0], description=name, completed=done, total=total or None)


class TrainingScreen:
    """A `policies.training.TrainingReport`: loss and remaining time, as a bar or, without a terminal, as lines."""

    def __init__(self, screen: StageConsole):
        self._screen = screen
        self._last_line = -TRAINING_LINE_S

    def __call__(self, method: str, done: int, total: int, loss: float, seconds_left: float) -> None:
        left = f"{seconds_left / 60:.0f} min" if seconds_left >= 90 else f"{seconds_left:.0f} s"
        what = f"training {method}: loss {loss:.4f}, {left} left"
        self._screen.done_so_far(what, done, total)
        now = time.monotonic()
        if not self._screen.console.is_terminal and (now - self._last_line > TRAINING_LINE_S or done == total):
            self._screen.say(f"  {what}, {done} of {total} steps")
            self._last_line = now
