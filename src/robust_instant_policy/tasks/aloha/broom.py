"""Tools for sweeping: a brush with an upright handle, and a dustpan."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.aloha.surfaces import (
    VISUAL_GROUP,
    Body,
    add_hull,
    add_solid,
    add_surface,
    box_surface,
    free_body,
    moved,
    paint,
)
from robust_instant_policy.tasks.textures import Color, bristles, wood

BOX = mujoco.mjtGeom.mjGEOM_BOX
BRISTLE_FRICTION, WOOD_FRICTION, PAN_FRICTION = 0.4, 0.7, 0.3
BEECH: Color = (0.72, 0.52, 0.30)
BRISTLES: Color = (0.16, 0.15, 0.15)
PAN_BLUE: Color = (0.12, 0.32, 0.62)


@dataclass(frozen=True)
class Brush:
    """A brush on its bristles on z = 0, its width along y; lengths in metres."""

    seed: int
    width: float = 0.085
    depth: float = 0.030
    bristle_length: float = 0.032
    handle_height: float = 0.068

    MASS_KG: ClassVar[float] = 0.12
    BACK_M: ClassVar[float] = 0.012
    TIPS_M: ClassVar[float] = 0.008
    HANDLE_M: ClassVar[tuple[float, float]] = (0.020, 0.024)
    # Soft bristles: a few newtons of force at some millimetres of penetration.
    SOFT: ClassVar[dict] = dict(priority=1, solref=[0.045, 1.0], solimp=[0.2, 0.9, 0.008, 0.5, 2.0])

    @property
    def height(self) -> float:
        return self.bristle_length + self.BACK_M + self.handle_height

    def build(self, spec: mujoco.MjSpec, name: str, pose: FloatArray) -> Body:
        """Add the brush to ``spec`` at ``pose (4, 4)``."""
        body = free_body(spec, name, pose)
        rng = np.random.default_rng(self.seed)
        grain = wood(BEECH, rng)
        back = self.bristle_length + self.BACK_M / 2
        handle = self.bristle_length + self.BACK_M + self.handle_height / 2
        tufts = (self.depth, self.width, self.bristle_length)
        parts = (
            ("bristles", tufts, self.bristle_length / 2, bristles(BRISTLES, rng)),
            ("back", (self.depth + 0.006, self.width + 0.006, self.BACK_M), back, grain),
            ("handle", (*self.HANDLE_M, self.handle_height), handle, grain),
        )
        for (part, size, height, image), mass in zip(parts, (0.3, 0.4, 0.3), strict=True):
            place = (0.0, 0.0, height)
            add_surface(spec, body, f"{name}-{part}", moved(box_surface(size), place), image, shine=0.1)
            touch = dict(friction=BRISTLE_FRICTION, **self.SOFT) if part == "bristles" else dict(friction=WOOD_FRICTION)
            add_solid(body, BOX, np.array(size) / 2, position=place, mass=mass * self.MASS_KG, **touch)
        # Above their tips the bristles are rigid, so that objects do not get under them.
        firm = self.bristle_length - self.TIPS_M
        size, place = (self.depth, self.width, firm), (0.0, 0.0, self.TIPS_M + firm / 2)
        add_solid(body, BOX, np.array(size) / 2, position=place, friction=BRISTLE_FRICTION)
        return body


@dataclass(frozen=True)
class Dustpan:
    """A dustpan on z = 0, its lip along y at x = 0, the pan and its handle behind it along x; lengths in metres."""

    width: float = 0.19
    depth: float = 0.11
    wall: float = 0.030
    lip: float = 0.020
    floor: float = 0.003
    handle_length: float = 0.09

    MASS_KG: ClassVar[float] = 0.15
    THICKNESS_M: ClassVar[float] = 0.004
    HANDLE_M: ClassVar[tuple[float, float]] = (0.026, 0.018)
    HANDLE_HEIGHT_M: ClassVar[float] = 0.021  # of its middle

    @property
    def grip(self) -> FloatArray:
        """Grasp point: the middle of the handle ``(3,)``."""
        return np.array([self.depth + self.handle_length / 2, 0.0, self.HANDLE_HEIGHT_M])

    def build(self, spec: mujoco.MjSpec, name: str, pose: FloatArray) -> Body:
        """Add the dustpan to ``spec`` at ``pose (4, 4)``."""
        body = free_body(spec, name, pose)
        t, half = self.THICKNESS_M, self.width / 2
        inside, middle = self.depth - self.lip, (self.depth + self.lip) / 2
        boxes = (
            ("floor", (inside, self.width, self.floor), (middle, 0, self.floor / 2)),
            ("back", (t, self.width, self.wall), (self.depth, 0, self.wall / 2)),
            ("left", (inside, t, self.wall), (middle, half, self.wall / 2)),
            ("right", (inside, t, self.wall), (middle, -half, self.wall / 2)),
            ("handle", (self.handle_length, *self.HANDLE_M), self.grip),
        )
        volume = sum(float(np.prod(size)) for _, size, _ in boxes)
        for part, size, place in boxes:
            shade = np.array(PAN_BLUE) * (1.25 if part == "floor" else 1.0)
            add_surface(spec, body, f"{name}-{part}", moved(box_surface(size), place), paint(shade), shine=0.3)
            mass = self.MASS_KG * float(np.prod(size)) / volume
            add_solid(body, BOX, np.array(size) / 2, position=place, friction=PAN_FRICTION, mass=mass)
        corners = [(x, y, z) for y in (-half, half) for x, z in ((0, 0), (self.lip, 0), (self.lip, self.floor))]
        color = [*(1.25 * np.array(PAN_BLUE)), 1.0]
        add_hull(spec, body, f"{name}-ramp", corners, friction=PAN_FRICTION, rgba=color, group=VISUAL_GROUP, mass=0.0)
        return body
