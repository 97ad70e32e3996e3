"""A `Teleoperator` of LeRobot, or an object of that shape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from robust_instant_policy.errors import RobotError
from robust_instant_policy.geometry import FloatArray


class LeRobotShape(Protocol):
    """What is used of LeRobot's ``Teleoperator``."""

    def connect(self) -> None: ...
    def get_action(self) -> Mapping[str, Any]: ...
    def disconnect(self) -> None: ...


class LeRobotSource:
    """See `JointSource`; ``keys`` of the action in the order of the channels, in ``degrees`` or radians."""

    def __init__(self, name: str, device: LeRobotShape, keys: Sequence[str], degrees: bool):
        self.name, self._device, self._keys, self._degrees = name, device, tuple(keys), degrees

    def connect(self) -> None:
        self._answer(self._device.connect)

    def angles(self) -> FloatArray:
        action = self._answer(self._device.get_action)
        missing = [key for key in self._keys if key not in action]
        if missing:
            raise RobotError(f"{self.name} has no {', '.join(missing)}; it has {', '.join(sorted(action))}")
        angles = np.array([float(action[key]) for key in self._keys])
        return np.radians(angles) if self._degrees else angles

    def disconnect(self) -> None:
        self._answer(self._device.disconnect)

    def _answer(self, call):
        try:
            return call()
        except (OSError, RuntimeError, ValueError) as error:  # what LeRobot's devices raise
            raise RobotError(f"{self.name} does not answer: {error}") from error
