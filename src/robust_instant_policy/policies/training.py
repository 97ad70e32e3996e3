"""How methods that must be trained are trained: where to, for how long, on what, and who watches."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

DEFAULT_CHECKPOINTS = Path("checkpoints")
DEFAULT_STEPS = 1000  # of gradient descent

# Called after a step: method, steps done, steps in all, loss, seconds left.
TrainingReport = Callable[[str, int, int, float, float], None]


def no_report(method: str, done: int, total: int, loss: float, seconds_left: float) -> None:
    """The `TrainingReport` of a caller who does not look."""


@dataclass(frozen=True)
class Training:
    """``steps`` of gradient descent on ``device`` (None: CUDA where there is one), checkpoints in ``checkpoints``.

    Trained policies look there first, and train only what is not there.
    """

    checkpoints: Path = DEFAULT_CHECKPOINTS
    steps: int = DEFAULT_STEPS
    device: str | None = None
    seed: int = 0
    report: TrainingReport = no_report
