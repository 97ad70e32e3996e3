"""The protocol of an RGB-D camera."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.errors import RobotError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.robots.device import Device


@dataclass(frozen=True, eq=False)
class Frame:
    """One image: ``rgb (H, W, 3)`` uint8; ``depth (H, W)`` float32, metres along the optical axis, aligned to the
    colour image, 0 or NaN where there is no reading; ``intrinsics (3, 3)`` in pixels, without distortion;
    ``timestamp`` in seconds of the camera's own clock, which must advance."""

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    intrinsics: FloatArray
    timestamp: float

    @property
    def depth_share(self) -> float:
        """Share of the pixels that have depth."""
        return float((np.isfinite(self.depth) & (self.depth > 0)).mean())


def check_alive(camera: str, rgb: NDArray[np.uint8], before: NDArray[np.uint8] | None) -> None:
    """Raises `RobotError` for an image that repeats the one ``before``: noise makes any two images differ."""
    if before is not None and np.array_equal(before, rgb) and rgb.std() > 0:
        raise RobotError(f"{camera} repeats the same image: it is frozen; unplug it and connect it again")


class Camera(Device, Protocol):
    """An RGB-D camera; `connect` waits until exposure and depth are stable."""

    def read(self) -> Frame:
        """The next frame, taken after the call."""
        ...


class VideoCamera(Camera, Protocol):
    """A camera with a live picture."""

    def preview(self) -> NDArray[np.uint8]:
        """The colour image ``(H, W, 3)`` now, to look at: without depth, filters and checks."""
        ...
