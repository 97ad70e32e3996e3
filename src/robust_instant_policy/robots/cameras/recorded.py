"""A folder of observations, replayed as a camera."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import RobotError
from robust_instant_policy.robots.camera import Frame

INTERVAL_S = 1 / 30  # between the time stamps


class RecordedCamera:
    """Replays the ``.npz`` files of a folder (as `Observation.save` writes them) in the order of their names."""

    def __init__(self, folder: Path):
        self.name, self._folder = f"recorded {folder}", folder
        self._files: list[Path] = []
        self._next = 0

    def connect(self) -> None:
        self._files, self._next = sorted(self._folder.glob("*.npz")), 0
        if not self._files:
            raise RobotError(f"{self._folder} holds no .npz file of an observation")

    def read(self) -> Frame:
        if self._next >= len(self._files):
            raise RobotError(f"the {len(self._files)} images of {self._folder} are used up")
        seen = Observation.load(self._files[self._next])
        self._next += 1
        return Frame(seen.rgb, seen.depth, seen.intrinsics, self._next * INTERVAL_S)

    def preview(self) -> NDArray[np.uint8]:
        """The image that is read last, or first: looking uses up none."""
        return Observation.load(self._files[max(self._next - 1, 0)]).rgb

    def disconnect(self) -> None:
        self._files = []
