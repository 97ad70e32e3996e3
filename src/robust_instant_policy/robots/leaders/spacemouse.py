"""A SpaceMouse, through `pyspacemouse` and the system's HIDAPI."""

import math
import time
from typing import Any

import numpy as np

from robust_instant_policy.errors import RobotError, needs_extra
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.robots.leaders.jog import JOG_SPEEDS

DEAD_ZONE = 0.1  # share of an axis around its middle
MAX_REPORTS = 100  # read in one step; the device sends some 250 a second while its cap is pushed
SILENT_S = 0.5  # without a report: the cap is at rest, or the device is out of reach
AXES = ("x", "y", "z", "roll", "pitch", "yaw")  # x forward, y left, z up (ROS REP 103), as the hand pushes the cap
HELP = (
    "plug it in; Debian and Ubuntu need the package libhidapi-hidraw0 and a udev rule that lets you read it: "
    "docs/calibration.md, Leaders"
)


class SpaceMouseSource:
    """See `robots.leaders.jog.JogSource`; asked at ``rate_hz``. ``device`` is a path such as ``/dev/hidraw0``, empty
    for the first one that is found."""

    def __init__(self, device: str, rate_hz: float):
        self.name, self._path, self._rate = f"SpaceMouse {device}".strip(), device, rate_hz
        self._device: Any = None

    def connect(self) -> None:
        with needs_extra("robots"):
            import pyspacemouse
        ros = pyspacemouse.AxisConvention.ROS
        try:
            if self._path:
                self._device = pyspacemouse.open_by_path(self._path, axis_convention=ros)
            else:
                self._device = pyspacemouse.open(axis_convention=ros)
        except (RuntimeError, ValueError, OSError, AttributeError) as error:  # the last one: HIDAPI is missing
            raise RobotError(f"{self.name} cannot be opened: {error}; {HELP}") from None
        self._time, self._pressed, self._heard = -1.0, False, -math.inf

    def start(self) -> None:
        self.step()
        self._heard = -math.inf  # the last report may be old: the system buffers unread ones

    def step(self) -> tuple[FloatArray, bool]:
        presses = 0
        for _ in range(MAX_REPORTS):
            try:
                state = self._device.read()
            except Exception as error:  # easyhid's own class, which derives from nothing else
                raise RobotError(f"{self.name} was unplugged ({error}); plug it in and begin again") from None
            if state.t == self._time:
                break  # no new report
            self._time, before, self._pressed = state.t, self._pressed, any(state.buttons)
            self._heard = time.monotonic()
            presses += self._pressed and not before
        axes = np.array([getattr(state, axis) for axis in AXES])
        axes[(np.abs(axes) < DEAD_ZONE) | (time.monotonic() - self._heard > SILENT_S)] = 0.0
        return axes.clip(-1.0, 1.0) * JOG_SPEEDS / self._rate, presses % 2 == 1

    def disconnect(self) -> None:
        if self._device is not None:
            self._device.close()
            self._device = None
