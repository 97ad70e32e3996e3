"""The current episode on disk while it is recorded: no step is lost if the process dies.

A hidden folder beside the dataset holds ``start.npz`` (the observation), ``facts.json`` and ``steps.f64``, to which
each step is appended at once.
"""

import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.files import make_folder, read_json, read_regular, write_whole
from robust_instant_policy.geometry import FloatArray

START, FACTS, STEPS = "start.npz", "facts.json", "steps.f64"


@dataclass(frozen=True, eq=False)
class Episode:
    """``steps (T, A, 2, J + 1)``: for each arm the commanded and the measured joints, rad, and finger travel, metres;
    ``seconds (T,)`` of `time.monotonic`; ``calibration`` is the cell's digest."""

    start: Observation
    steps: FloatArray
    seconds: FloatArray
    calibration: str


class Journal:
    """The journal of the dataset folder ``path``."""

    def __init__(self, path: Path):
        named = path if path.name else path.resolve()
        self.folder = named.parent / f".{named.name}.unfinished"
        self._file = -1

    def begin(self, start: Observation, calibration: str, shape: tuple[int, ...]) -> None:
        """Begin an episode with steps of ``shape (A, 2, J + 1)``. Raises `DatasetError` where it cannot be written."""
        self.discard()
        make_folder(self.folder)
        start.save(self.folder / START)
        write_whole(self.folder / FACTS, json.dumps({"calibration": calibration, "shape": list(shape)}).encode())
        self._file = os.open(self.folder / STEPS, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)

    def add(self, second: float, step: FloatArray) -> None:
        """Append a step; raises `OSError` where the disk is full."""
        os.write(self._file, np.concatenate([[second], step.ravel()]).tobytes())

    def end(self) -> None:
        """Keep what was written."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def discard(self) -> None:
        """Remove the episode, which was stored in the dataset or is not wanted."""
        self.end()
        shutil.rmtree(self.folder, ignore_errors=True)

    def read(self) -> Episode | None:
        """The episode that a process left behind, None if there is none."""
        if not (self.folder / STEPS).exists():
            return None
        try:
            facts = read_json(self.folder / FACTS)
            shape = [int(size) for size in facts["shape"]]
            content = read_regular(self.folder / STEPS)
            width = 1 + int(np.prod(shape))
            whole = len(content) // (8 * width) * 8 * width  # the last row may be cut short
            rows = np.frombuffer(content[:whole]).reshape(-1, width)
            return Episode(
                Observation.load(self.folder / START),
                rows[:, 1:].reshape(-1, *shape),
                rows[:, 0],
                str(facts["calibration"]),
            )
        except (KeyError, ValueError, TypeError) as error:
            raise DatasetError(f"{self.folder} is damaged ({error}); remove it to go on") from None
