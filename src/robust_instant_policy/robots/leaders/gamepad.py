"""A gamepad through Linux' joystick interface (``/dev/input/js0``)."""

import os
import struct

import numpy as np

from robust_instant_policy.errors import RobotError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.robots.leaders.jog import JOG_SPEEDS

EVENT = struct.Struct("=IhBB")  # milliseconds, value, type, number: js_event of linux/joystick.h
BUTTON, AXIS, INITIAL = 0x01, 0x02, 0x80
FULL = 32767
DEAD_ZONE = 0.12  # share of an axis around its middle
# Sticks of a common gamepad: left stick y, x and right stick y move, right stick x turns about the vertical.
AXES = {1: (0, -1), 0: (1, -1), 4: (2, -1), 3: (5, -1)}
GRIPPER_BUTTON = 0


class GamepadSource:
    """See `robots.leaders.jog.JogSource`; asked at ``rate_hz``."""

    def __init__(self, device: str, rate_hz: float):
        self.name, self._device, self._rate = f"gamepad {device}", device, rate_hz
        self._file = -1
        self._axes = np.zeros(6)

    def connect(self) -> None:
        try:
            self._file = os.open(self._device, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise RobotError(
                f"cannot open {self._device}: {error.strerror}; plug the gamepad in, see which ones exist with "
                "ls /dev/input/js*, and add yourself to the group input"
            ) from None
        self._axes = np.zeros(6)

    def start(self) -> None:
        self.step()

    def step(self) -> tuple[FloatArray, bool]:
        presses = 0
        for _, value, kind, number in EVENT.iter_unpack(self._events()):
            if kind == BUTTON and number == GRIPPER_BUTTON and value:
                presses += 1
            if kind & ~INITIAL == AXIS and number in AXES:
                index, direction = AXES[number]
                share = direction * value / FULL
                self._axes[index] = 0.0 if abs(share) < DEAD_ZONE else share
        return self._axes * JOG_SPEEDS / self._rate, presses % 2 == 1

    def disconnect(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _events(self) -> bytes:
        try:
            content = os.read(self._file, EVENT.size * 256)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise RobotError(f"{self.name} was unplugged ({error.strerror}); plug it in and begin again") from None
        if not content:
            raise RobotError(f"{self.name} was unplugged; plug it in and begin again")
        return content[: len(content) // EVENT.size * EVENT.size]
