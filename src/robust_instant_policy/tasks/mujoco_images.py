"""Off-screen images of a MuJoCo scene."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.geometry import FloatArray

Size = tuple[int, int]  # width and height, pixels


class MujocoImages:
    """Images of a scene in its present state, each of a ``camera`` and a ``size``."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData):
        self._model, self._data = model, data
        self._renderers: dict[Size, mujoco.Renderer] = {}

    def rgb(
        self, camera: str | mujoco.MjvCamera, size: Size, options: mujoco.MjvOption | None = None
    ) -> NDArray[np.uint8]:
        """``(H, W, 3)``."""
        return self._updated(camera, size, options).render()

    def depth(self, camera: str | mujoco.MjvCamera, size: Size) -> NDArray[np.float32]:
        """``(H, W)``, metres along the optical axis."""
        renderer = self._updated(camera, size)
        renderer.enable_depth_rendering()
        depth = renderer.render()
        renderer.disable_depth_rendering()
        return depth

    def segmentation(self, camera: str | mujoco.MjvCamera, size: Size) -> NDArray[np.int32]:
        """``(H, W, 2)``: number and kind (`mujoco.mjtObj`) of what each pixel shows."""
        renderer = self._updated(camera, size)
        renderer.enable_segmentation_rendering()
        seen = renderer.render()
        renderer.disable_segmentation_rendering()
        return seen

    def close(self) -> None:
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    def _updated(
        self, camera: str | mujoco.MjvCamera, size: Size, options: mujoco.MjvOption | None = None
    ) -> mujoco.Renderer:
        if size not in self._renderers:
            width, height = size
            self._renderers[size] = mujoco.Renderer(self._model, height, width)
        self._renderers[size].update_scene(self._data, camera, options)
        return self._renderers[size]


def pinhole(size: Size, fov_deg: float) -> FloatArray:
    """Intrinsics ``(3, 3)`` of a camera with a vertical field of view, pixel centres at integers."""
    width, height = size
    focal = height / 2 / np.tan(np.deg2rad(fov_deg) / 2)
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
