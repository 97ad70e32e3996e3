from __future__ import annotations

import logging
import threading
import time
from typing import Any

import numpy as np
from lerobot.cameras import Camera
from numpy.typing import NDArray

from robust_instant_policy.datasets.images import millimetres
from robust_instant_policy.errors import RobotError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.robots.camera import Frame
from robust_instant_policy.robots.cameras import RealSenseCamera

from .config_rip import RipRealSenseConfig

logger = logging.getLogger(__name__)
START_TIMEOUT_S = 5.0


class RipRealSense(Camera):
    """A RealSense camera whose depth is aligned to colour, without distortion, and whose ``intrinsics`` are known.

    A thread reads it. Depth, uint16 millimetres ``(H, W, 1)``, is that of the colour image that was read last.
    """

    use_rgb = use_depth = True

    def __init__(self, config: RipRealSenseConfig, device: Any | None = None):
        super().__init__(config)
        self._camera = RealSenseCamera(config.serial, config.width, config.height, config.fps, 1, device)
        self._new, self._stop = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._latest: Frame | RobotError | None = None
        self._shown: Frame | None = None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """LeRobot's own search finds RealSense cameras: ``lerobot-find-cameras realsense``."""
        return []

    @property
    def is_connected(self) -> bool:
        return self._thread is not None

    @property
    def intrinsics(self) -> FloatArray:
        """``(3, 3)``, pixels."""
        return self._frame(START_TIMEOUT_S).intrinsics

    def connect(self, warmup: bool = True) -> None:
        self._camera.connect()
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, name=self._camera.name, daemon=True)
        self._thread.start()
        logger.info("%s: intrinsics=%s", self._camera.name, np.round(self.intrinsics, 3).tolist())

    def disconnect(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._camera.disconnect()
        self._thread = self._latest = self._shown = None

    def read(self) -> NDArray[np.uint8]:
        """The next image ``(H, W, 3)`` RGB."""
        return self.async_read(START_TIMEOUT_S * 1e3)

    def async_read(self, timeout_ms: float = 1000) -> NDArray[np.uint8]:
        """The newest image that was not read yet."""
        if self._shown is self._latest:
            self._new.clear()
        if not self._new.wait(timeout_ms / 1e3):
            raise TimeoutError(f"{self._camera.name} sent no image for {timeout_ms:g} ms")
        return self.read_latest()

    def read_latest(self, max_age_ms: int = 1000) -> NDArray[np.uint8]:
        """The newest image, at once."""
        self._shown = self._frame(max_age_ms / 1e3)
        return self._shown.rgb

    def read_latest_depth(self, max_age_ms: int = 1000) -> NDArray[np.uint16]:
        """The depth ``(H, W, 1)`` of the image that was read last."""
        shown = self._shown or self._frame(max_age_ms / 1e3)
        return millimetres(shown.depth)[..., None]

    read_depth = async_read_depth = read_latest_depth

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._latest, self._read_at = self._camera.read(), time.monotonic()
            except RobotError as error:
                self._latest = error
            self._new.set()

    def _frame(self, max_age_s: float) -> Frame:
        if not self.is_connected:
            raise RobotError(f"{self._camera.name} is not connected")
        self._new.wait(START_TIMEOUT_S)
        if self._latest is None or isinstance(self._latest, RobotError):
            raise self._latest or RobotError(f"{self._camera.name} sends no images")
        if time.monotonic() - self._read_at > max_age_s:
            raise TimeoutError(f"{self._camera.name} sent no image for {max_age_s:g} s")
        return self._latest
