"""Noise model of a stereo depth camera, applied to rendered images.

Numbers follow the Intel RealSense D415: 55 mm between its imagers, about 920 pixels of focal length at 1280×720,
a matching error of about 0.08 pixels, disparities in 1/32 pixel, readings in millimetres, zero where there is none.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from robust_instant_policy.demonstration import Observation

FOCAL_BASELINE_M_PX = 920 * 0.055  # disparity in pixels = this / depth in metres
UNIT_M = 0.001  # one count of the depth image
EDGE_JUMP = 0.02  # share of the depth; neighbours that differ by more are on two surfaces
SHINY = 0.97  # brightness, of 1, above which the projected pattern is not visible


@dataclass(frozen=True)
class CameraNoise:
    """Parameters of the noise; `photograph` applies it.

    ``matching_error`` and ``disparity_step`` in pixels of disparity, so that noise and steps of the depth grow with
    the square of the distance; ``correlation`` in pixels, the correlation length of the noise; ``edge_holes`` and
    ``flying_pixels``: shares of the pixels at depth edges without a reading, or with one between the two surfaces;
    ``shiny_holes``: share of overexposed pixels without a reading; ``colour_noise`` of a channel's range.
    """

    matching_error: float = 0.08
    disparity_step: float = 1 / 32
    correlation: float = 1.5
    edge_holes: float = 0.5
    flying_pixels: float = 0.3
    shiny_holes: float = 0.8
    colour_noise: float = 0.01

    def photograph(self, observation: Observation, seed: int) -> Observation:
        """``observation`` with the noise of ``seed``."""
        rng = np.random.default_rng(seed)
        colour = observation.rgb + rng.normal(0, 255 * self.colour_noise, observation.rgb.shape)
        return Observation(
            np.clip(np.rint(colour), 0, 255).astype(np.uint8),
            self._depth(observation, rng),
            observation.intrinsics,
            observation.camera_pose,
        )

    def _depth(self, observation: Observation, rng: np.random.Generator) -> NDArray[np.float32]:
        true = np.where(np.isfinite(observation.depth), observation.depth, 0).astype(np.float64)
        seen = true > 0
        near = minimum_filter(np.where(seen, true, np.inf), size=3)
        far = maximum_filter(true, size=3)
        edge = seen & (far - near > EDGE_JUMP * near)
        chance = rng.random(true.shape)
        flying = edge & (chance < self.flying_pixels)
        mixed = np.where(flying, near + (far - near) * rng.random(true.shape), true)

        blotches = gaussian_filter(rng.normal(size=true.shape), self.correlation)
        disparity = FOCAL_BASELINE_M_PX / np.where(seen, mixed, 1.0)
        disparity += self.matching_error * blotches / blotches.std()
        disparity = np.maximum(np.rint(disparity / self.disparity_step), 1) * self.disparity_step
        measured = np.rint(FOCAL_BASELINE_M_PX / disparity / UNIT_M) * UNIT_M

        hole = edge & ~flying & (chance < self.flying_pixels + self.edge_holes)
        shiny = observation.rgb.min(axis=2) >= SHINY * 255
        hole |= shiny & (rng.random(true.shape) < self.shiny_holes)
        return np.where(seen & ~hole, measured, 0).astype(np.float32)
