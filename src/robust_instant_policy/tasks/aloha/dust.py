"""The object to sweep: small, slides, does not roll."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.aloha.surfaces import (
    Body,
    Surface,
    add_hull,
    add_surface,
    box_surface,
    free_body,
    moved,
    paint,
    revolved,
)
from robust_instant_policy.tasks.textures import Color

MASS_KG = 0.02
FRICTION = 0.4
SEEN_COLORS: tuple[Color, ...] = ((0.90, 0.72, 0.10), (0.85, 0.25, 0.15), (0.20, 0.60, 0.25), (0.90, 0.45, 0.10))
UNSEEN_COLORS: tuple[Color, ...] = ((0.80, 0.30, 0.55), (0.45, 0.25, 0.60), (0.25, 0.65, 0.70), (0.50, 0.32, 0.18))
PAPER_POINTS = 26
STUD_M = (0.0035, 0.004)  # radius and height of a toy brick's studs


@dataclass(frozen=True)
class Dust:
    """An object on z = 0 around the z axis; ``size (3,)`` in metres; ``kind`` is "paper", "brick" or "lid"."""

    kind: str
    size: tuple[float, float, float]
    color: Color
    seed: int

    @classmethod
    def draw_seen(cls, number: int, rng: np.random.Generator) -> Dust:
        """A crumpled ball of coloured paper."""
        size = rng.uniform(0.032, 0.040, 3) * [1.0, 1.0, 0.7]
        x, y, z = size.tolist()
        return cls("paper", (x, y, z), SEEN_COLORS[number % len(SEEN_COLORS)], int(rng.integers(2**31)))

    @classmethod
    def draw_unseen(cls, number: int, rng: np.random.Generator) -> Dust:
        """A toy brick, or the lid of a jar."""
        color, seed = UNSEEN_COLORS[number % len(UNSEEN_COLORS)], int(rng.integers(2**31))
        if number % 2:
            return cls("brick", (0.032, 0.032 if number % 4 == 1 else 0.048, 0.020), color, seed)
        width = rng.uniform(0.036, 0.046)
        return cls("lid", (width, width, rng.uniform(0.014, 0.018)), color, seed)

    def build(self, spec: mujoco.MjSpec, name: str, pose: FloatArray) -> Body:
        """Add it to ``spec``, lying at ``pose (4, 4)``."""
        body = free_body(spec, name, pose)
        rng = np.random.default_rng(self.seed)
        looks, solid = self._shape(rng)
        image = paint(self.color)
        if self.kind == "paper":  # a different shade for every face
            image = (image[:1, :1] * rng.uniform(0.7, 1.0, (16, 16, 1))).astype(np.uint8)
        for index, surface in enumerate(looks):
            add_surface(spec, body, f"{name}-{index}", surface, image, shine=0.3)
        add_hull(spec, body, f"{name}-hull", solid, mass=MASS_KG, friction=(FRICTION, 2e-3, 5e-4))
        return body

    def _shape(self, rng: np.random.Generator) -> tuple[list[Surface], FloatArray]:
        """Visual surfaces, and points ``(N, 3)`` whose convex hull is the collision shape."""
        x, y, z = self.size
        if self.kind == "lid":
            rim = [(0.0, 0.0), (x / 2, 0.0), (x / 2, 0.9 * z), (0.46 * x, z), (0.0, z)]
            lid = revolved(rim, 28)
            return [lid], lid.vertices
        if self.kind == "brick":
            block = moved(box_surface(self.size), (0.0, 0.0, z / 2))
            stud = revolved([(STUD_M[0], 0.0), (STUD_M[0], STUD_M[1]), (0.0, STUD_M[1])], 14)
            places = [(a, b, z) for a in (-0.008, 0.008) for b in (-0.008, 0.008)]
            return [block, *(moved(stud, place) for place in places)], block.vertices
        directions = rng.normal(size=(PAPER_POINTS, 3))
        points = directions / np.linalg.norm(directions, axis=1, keepdims=True) * np.array(self.size) / 2
        points = points * rng.uniform(0.85, 1.0, (PAPER_POINTS, 1))
        points[:, 2] += z / 2
        points[points[:, 2] < 0.2 * z, 2] = 0.0  # flattened
        points = np.concatenate([points, [[0.3 * x, 0, 0], [-0.15 * x, 0.26 * y, 0], [-0.15 * x, -0.26 * y, 0]]])
        return [_faceted(points, rng)], points


def _faceted(points: FloatArray, rng: np.random.Generator) -> Surface:
    """The convex hull of ``points (N, 3)``, each triangle with a different shade."""
    hull = ConvexHull(points)
    triangles = hull.simplices.copy()
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = (normals * hull.equations[:, :3]).sum(axis=1) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    uvs = np.repeat(rng.uniform(0.05, 0.95, (len(triangles), 2)), 3, axis=0)
    return Surface(points[triangles].reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), uvs)
