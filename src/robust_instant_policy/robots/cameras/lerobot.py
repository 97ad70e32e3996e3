"""A camera of LeRobot, or one of that shape."""

import time
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.errors import RobotError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.robots.camera import Frame, check_alive
from robust_instant_policy.robots.device import answered


class LeRobotShape(Protocol):
    """What is used of LeRobot's ``Camera``; ``read_depth`` is that of its depth cameras, uint16 millimetres."""

    def connect(self) -> None: ...
    def read(self) -> NDArray[np.uint8]: ...
    def read_depth(self) -> NDArray[np.uint16]: ...
    def disconnect(self) -> None: ...


class LeRobotCamera:
    """``device`` is a depth camera of LeRobot's shape whose depth is ``aligned`` to its colour image.

    LeRobot knows neither intrinsics nor alignment, so both are stated; its own RealSense camera does not align, and is
    read better by `RealSenseCamera`.
    """

    def __init__(self, name: str, device: LeRobotShape, intrinsics: FloatArray, aligned: bool):
        self.name, self._device, self._intrinsics, self._aligned = name, device, intrinsics, aligned
        self._before: NDArray[np.uint8] | None = None

    def connect(self) -> None:
        if not self._aligned or not hasattr(self._device, "read_depth"):
            raise RobotError(
                f"{self.name} gives no depth that is aligned to colour; a RealSense camera is read with "
                'kind = "realsense", another one that aligns its depth with aligned = true'
            )
        answered(self.name, self._device.connect)

    def read(self) -> Frame:
        rgb, depth = answered(self.name, self._device.read), answered(self.name, self._device.read_depth)
        if depth.shape[:2] != rgb.shape[:2] or depth.dtype != np.uint16:
            raise RobotError(
                f"{self.name} gives depth {depth.shape} {depth.dtype} for an image {rgb.shape}; expected uint16 "
                "millimetres of the same size"
            )
        check_alive(self.name, rgb, self._before)
        self._before = rgb.copy()
        metres = depth.reshape(rgb.shape[:2]).astype(np.float32) * np.float32(1e-3)
        return Frame(rgb, metres, self._intrinsics, time.monotonic())

    def preview(self) -> NDArray[np.uint8]:
        return answered(self.name, self._device.read)

    def disconnect(self) -> None:
        answered(self.name, self._device.disconnect)
