"""The red bowl; its collision shape is a ring of boxes, so that objects can lie in it."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.aloha.surfaces import Body, add_solid, add_surface, free_body, paint, revolved

MASS_KG = 0.30
FRICTION = 0.6
WALL_M = 0.004
FOOT_SHARE = 0.55  # of the rim's radius
SEGMENTS = 20
RED = (0.76, 0.10, 0.09)
INSIDE = (0.84, 0.16, 0.13)


@dataclass(frozen=True)
class Bowl:
    """A bowl on z = 0 around the z axis; ``radius`` of the rim and ``height``, in metres."""

    radius: float
    height: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Bowl:
        return cls(radius=rng.uniform(0.074, 0.080), height=rng.uniform(0.048, 0.054))

    @property
    def floor_radius(self) -> float:
        return FOOT_SHARE * self.radius

    def build(self, spec: mujoco.MjSpec, name: str, pose: FloatArray) -> Body:
        """Add the bowl to ``spec``, standing at ``pose (4, 4)``."""
        body = free_body(spec, name, pose)
        outer, inner = self._wall(0.0), self._wall(WALL_M)
        add_surface(spec, body, f"{name}-outside", revolved(outer), paint(RED), shine=0.6)
        add_surface(spec, body, f"{name}-inside", revolved(np.concatenate([outer[-1:], inner[::-1]])), paint(INSIDE))
        size, position = (self.floor_radius, WALL_M / 2), (0.0, 0.0, WALL_M / 2)
        add_solid(body, mujoco.mjtGeom.mjGEOM_CYLINDER, size, position=position, mass=0.5 * MASS_KG, friction=FRICTION)
        foot, rim = np.array([self.floor_radius, WALL_M / 2]), np.array([self.radius, self.height])
        middle, slant = (foot + rim) / 2, rim - foot
        length, lean = float(np.linalg.norm(slant)), float(np.arctan2(slant[0], slant[1]))
        width = 2 * np.pi * self.radius / SEGMENTS
        for angle in np.arange(SEGMENTS) * 2 * np.pi / SEGMENTS:
            turn = Rotation.from_euler("z", angle)
            add_solid(
                body,
                mujoco.mjtGeom.mjGEOM_BOX,
                (WALL_M / 2, width / 2, length / 2),
                position=turn.apply([middle[0], 0.0, middle[1]]),
                rotation=(turn * Rotation.from_euler("y", lean)).as_matrix(),
                mass=0.5 * MASS_KG / SEGMENTS,
                friction=FRICTION,
            )
        return body

    def _wall(self, inwards: float) -> FloatArray:
        """Outline ``(N, 2)`` of (radius, height) from the middle of the bottom to the rim, ``inwards`` of it."""
        rise = np.linspace(0.0, 1.0, 9)
        radius = self.floor_radius + (self.radius - self.floor_radius) * rise - inwards
        height = inwards + (self.height - inwards) * rise
        return np.concatenate([[[0.0, inwards]], np.stack([radius, height], axis=1)])
