"""A `Teleoperator` of LeRobot, or an object of that shape."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.robots.device import answered, numbers


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
        answered(self.name, self._device.connect)

    def angles(self) -> FloatArray:
        angles = np.array(numbers(self.name, answered(self.name, self._device.get_action), self._keys))
        return np.radians(angles) if self._degrees else angles

    def disconnect(self) -> None:
        answered(self.name, self._device.disconnect)
