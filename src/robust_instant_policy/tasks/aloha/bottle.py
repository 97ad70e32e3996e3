"""Small bottles with a label and a screw cap, in two families."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.aloha.surfaces import Body, add_solid, add_surface, free_body, revolved
from robust_instant_policy.tasks.textures import Color

MASS_KG = 0.12
FRICTION = 0.7
TEXTURE_HEIGHT, TEXTURE_AROUND = 192, 256
SIDES = 40
SEEN_COLORS: tuple[Color, ...] = ((0.10, 0.42, 0.72), (0.12, 0.52, 0.30), (0.16, 0.24, 0.55), (0.18, 0.55, 0.60))
UNSEEN_COLORS: tuple[Color, ...] = ((0.92, 0.92, 0.88), (0.55, 0.30, 0.60), (0.30, 0.20, 0.12), (0.12, 0.12, 0.13))


@dataclass(frozen=True)
class Bottle:
    """A bottle on z = 0 around the z axis; ``radius`` and ``height`` of the body under the shoulder, in metres.

    ``facets`` 0 is a round bottle.
    """

    radius: float
    height: float
    shoulder: float
    cap_radius: float
    cap_height: float
    color: Color
    cap_color: Color
    label_color: Color
    facets: int
    seed: int

    @classmethod
    def draw_seen(cls, number: int, rng: np.random.Generator) -> Bottle:
        """Round, in blue and green, with a white cap and a light label."""
        return cls(
            radius=rng.uniform(0.0195, 0.0225),
            height=rng.uniform(0.070, 0.085),
            shoulder=rng.uniform(0.012, 0.020),
            cap_radius=rng.uniform(0.010, 0.012),
            cap_height=rng.uniform(0.014, 0.018),
            color=SEEN_COLORS[number % len(SEEN_COLORS)],
            cap_color=(0.93, 0.93, 0.92),
            label_color=(0.95, 0.90, 0.72),
            facets=0,
            seed=int(rng.integers(2**31)),
        )

    @classmethod
    def draw_unseen(cls, number: int, rng: np.random.Generator) -> Bottle:
        """Taller and slimmer or short and wide, some with facets, in other colours with dark caps."""
        slim = number % 2 == 0
        return cls(
            radius=rng.uniform(0.0165, 0.0185) if slim else rng.uniform(0.0235, 0.0250),
            height=rng.uniform(0.088, 0.098) if slim else rng.uniform(0.060, 0.070),
            shoulder=rng.uniform(0.006, 0.010),
            cap_radius=rng.uniform(0.012, 0.015),
            cap_height=rng.uniform(0.010, 0.014),
            color=UNSEEN_COLORS[number % len(UNSEEN_COLORS)],
            cap_color=(0.20, 0.20, 0.22) if number % 3 else (0.85, 0.45, 0.10),
            label_color=(0.75, 0.20, 0.25),
            facets=0 if number % 4 < 2 else 8,
            seed=int(rng.integers(2**31)),
        )

    @property
    def total_height(self) -> float:
        return self.height + self.shoulder + self.cap_height

    def build(self, spec: mujoco.MjSpec, name: str, pose: FloatArray) -> Body:
        """Add the bottle to ``spec``, standing at ``pose (4, 4)``."""
        body = free_body(spec, name, pose)
        outline = self._outline()
        surface = revolved(outline, self.facets or SIDES, flat=self.facets > 0)
        add_surface(spec, body, name, surface, self._skin(outline), shine=0.5)
        cylinder = mujoco.mjtGeom.mjGEOM_CYLINDER
        inner = self.radius * (np.cos(np.pi / self.facets) if self.facets else 1.0)
        neck = self.total_height - self.height
        parts = (
            (inner, self.height, self.height / 2, 0.9),
            (self.cap_radius, neck, self.height + neck / 2, 0.1),
        )
        for radius, height, middle, share in parts:
            size, position = (radius, height / 2), (0.0, 0.0, middle)
            add_solid(body, cylinder, size, position=position, mass=share * MASS_KG, friction=FRICTION)
        return body

    def _outline(self) -> FloatArray:
        """Points ``(N, 2)`` of (radius, height), from the middle of the bottom to the middle of the cap."""
        rise = np.linspace(0.0, 1.0, 7)
        neck = self.cap_radius * 0.85
        shoulder = np.stack(
            [neck + (self.radius - neck) * np.cos(np.pi / 2 * rise) ** 0.8, self.height + self.shoulder * rise], axis=1
        )
        top = self.height + self.shoulder
        cap = [
            (self.cap_radius, top),
            (self.cap_radius, top + 0.85 * self.cap_height),
            (0.9 * self.cap_radius, top + self.cap_height),
            (0.0, top + self.cap_height),
        ]
        foot = [(0.0, 0.0), (0.92 * self.radius, 0.0), (self.radius, 0.003)]
        return np.concatenate([foot, shoulder, cap])

    def _skin(self, outline: FloatArray) -> NDArray[np.uint8]:
        """Texture ``(H, W, 3)``: W around the bottle, H along its outline from the bottom."""
        rng = np.random.default_rng(self.seed)
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
        heights = np.interp(np.linspace(0, along[-1], TEXTURE_HEIGHT), along, outline[:, 1])
        image = np.broadcast_to(np.array(self.color), (TEXTURE_HEIGHT, TEXTURE_AROUND, 3)).copy()
        label = (heights > 0.25 * self.height) & (heights < 0.85 * self.height)
        image[label] = self.label_color
        for _ in range(5):  # print on the label
            row, column = rng.integers(0, int(label.sum()) - 8), rng.integers(0, TEXTURE_AROUND - 60)
            block = image[label]
            block[row : row + int(rng.integers(3, 8)), column : column + int(rng.integers(20, 60))] = self.color
            image[label] = block
        image[heights >= self.height + self.shoulder - 1e-6] = self.cap_color
        return (np.clip(image, 0.0, 1.0) * 255).astype(np.uint8)
