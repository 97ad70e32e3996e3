"""A tumbler with facets, so that it does not roll."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.geometry import FloatArray, make_pose
from robust_instant_policy.tasks.aloha.surfaces import Body, add_hull, add_surface, free_body, paint, revolved
from robust_instant_policy.tasks.textures import Color

MASS_KG = 0.13
FRICTION = 0.7
FACETS = 12
WALL_M = 0.003
TEXTURE_HEIGHT, TEXTURE_AROUND = 128, 240
BODY_COLORS: tuple[Color, ...] = ((0.16, 0.42, 0.70), (0.14, 0.55, 0.45), (0.80, 0.38, 0.12), (0.55, 0.22, 0.50))
BAND: Color = (0.95, 0.93, 0.86)
INSIDE: Color = (0.93, 0.91, 0.85)


@dataclass(frozen=True)
class Cup:
    """A cup on z = 0 around the z axis; ``foot`` and ``rim`` are radii, in metres."""

    foot: float
    rim: float
    height: float
    color: Color
    seed: int

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Cup:
        foot = rng.uniform(0.0215, 0.0230)
        return cls(
            foot=foot,
            rim=foot + rng.uniform(0.003, 0.0045),
            height=rng.uniform(0.080, 0.092),
            color=BODY_COLORS[rng.integers(len(BODY_COLORS))],
            seed=int(rng.integers(2**31)),
        )

    @property
    def taper(self) -> float:
        """Angle, in rad, between axis and facets."""
        return float(np.arctan2((self.rim - self.foot) * np.cos(np.pi / FACETS), self.height))

    def lying(self) -> FloatArray:
        """Pose ``(4, 4)`` lying on a facet at the origin, the mouth towards x."""
        lowest = self.foot * np.cos(np.pi / FACETS)
        turn, tilt = np.pi / FACETS, self.taper
        # The axis points along x, raised by the taper; the body is rotated so that a facet is at the bottom.
        axis = np.array([np.cos(tilt), 0.0, np.sin(tilt)])
        side = np.array([0.0, 1.0, 0.0])
        up = np.cross(axis, side)
        rotation = np.stack([np.cos(turn) * side + np.sin(turn) * up, np.cos(turn) * up - np.sin(turn) * side, axis], 1)
        return make_pose(rotation, [-self.height / 2 * np.cos(tilt), 0, lowest * np.cos(tilt)])

    def build(self, spec: mujoco.MjSpec, name: str, pose: FloatArray) -> Body:
        """Add the cup to ``spec`` at ``pose (4, 4)``."""
        body = free_body(spec, name, pose)
        outside = np.array([(0.0, 0.0), (self.foot, 0.0), (self.rim, self.height)])
        add_surface(spec, body, name, revolved(outside, FACETS, flat=True), self._skin(outside), shine=0.4)
        floor = 2 * WALL_M
        inside = [
            (self.rim, self.height),
            (self.rim - WALL_M, self.height),
            (self.foot - WALL_M + (self.rim - self.foot) * floor / self.height, floor),
            (0.0, floor),
        ]
        add_surface(spec, body, f"{name}-inside", revolved(inside, FACETS, flat=True), paint(INSIDE), shine=0.4)
        around = (np.arange(FACETS)) * 2 * np.pi / FACETS
        ring = np.stack([np.cos(around), np.sin(around)], axis=1)
        corners = [
            np.column_stack([r * ring, np.full(FACETS, z)]) for r, z in ((self.foot, 0.0), (self.rim, self.height))
        ]
        add_hull(spec, body, f"{name}-hull", np.concatenate(corners), mass=MASS_KG, friction=FRICTION)
        return body

    def _skin(self, outside: FloatArray) -> NDArray[np.uint8]:
        """Texture ``(H, W, 3)``: W around the cup, H along its outline from the middle of the foot."""
        rng = np.random.default_rng(self.seed)
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outside, axis=0), axis=1))])
        heights = np.interp(np.linspace(0, along[-1], TEXTURE_HEIGHT), along, outside[:, 1]) / self.height
        image = np.broadcast_to(np.array(self.color), (TEXTURE_HEIGHT, TEXTURE_AROUND, 3)).copy()
        image[heights > 0.80] = BAND
        image[(heights > 0.62) & (heights < 0.68)] = BAND
        dots = np.arange(TEXTURE_AROUND) % 40 < 14
        image[np.ix_((heights > 0.2) & (heights < 0.38), dots)] = BAND
        image = image * (1 + 0.03 * rng.normal(size=(TEXTURE_HEIGHT, TEXTURE_AROUND, 1)))
        return (np.clip(image, 0.0, 1.0) * 255).astype(np.uint8)
