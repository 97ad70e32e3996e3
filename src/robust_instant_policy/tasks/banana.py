"""Bananas of random size, curvature and ripeness: shape, mesh and texture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.geometry import FloatArray

RINGS, SIDES = 48, 30
CAPSULES = 8  # of its contact shape
RIDGE = 0.05  # height of the five longitudinal ridges, relative to the radius
STEM_RADIUS_M = 0.0055
STEM_SHARE, TIP_SHARE = 0.13, 0.06  # of the length
TEXTURE_LENGTH, TEXTURE_AROUND = 256, 96

STEM_BROWN = (0.40, 0.28, 0.12)
TIP_BLACK = (0.13, 0.09, 0.06)
GREEN = (0.62, 0.70, 0.18)
YELLOW = (0.98, 0.80, 0.20)
SPOT_BROWN = (0.42, 0.26, 0.08)


@dataclass(frozen=True)
class Banana:
    """A banana in the xy plane, curved towards +y, its middle at the origin with the long axis along x.

    ``length`` along the curve and ``radius`` of its thickest part in metres, ``bend`` the angle between its ends
    in rad, ``ripeness`` 0 (greenish) to 1 (spotted).
    """

    length: float
    radius: float
    bend: float
    ripeness: float
    seed: int

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Banana:
        return cls(
            length=rng.uniform(0.145, 0.18),
            radius=rng.uniform(0.0145, 0.017),
            bend=rng.uniform(0.9, 1.4),
            ripeness=rng.uniform(0.2, 1.0),
            seed=int(rng.integers(2**31)),
        )

    def centreline(self, along: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points ``(N, 3)`` and tangents ``(N, 3)`` at relative positions ``along (N,)``, -0.5 (stem) to 0.5."""
        turn, bend_radius = along * self.bend, self.length / self.bend
        zero = np.zeros_like(turn)
        points = np.stack([bend_radius * np.sin(turn), bend_radius * (1 - np.cos(turn)), zero], axis=1)
        return points, np.stack([np.cos(turn), np.sin(turn), zero], axis=1)

    def thickness(self, along: FloatArray) -> FloatArray:
        """Radius ``(N,)`` at relative positions ``along (N,)``: a thin stem, a thick middle, a blunt tip."""
        from_stem, from_tip = along + 0.5 - STEM_SHARE, 0.5 - along
        belly = self.radius * np.sqrt(np.clip(1 - np.abs(2 * along / 1.02) ** 5, 0.0, 1.0))
        neck = STEM_RADIUS_M + (belly - STEM_RADIUS_M) * _ease(from_stem / 0.16)
        return np.minimum(neck, 0.004 + self.radius * np.sqrt(np.clip(from_tip / 0.11, 0.0, 1.0)))

    def capsules(self) -> list[tuple[FloatArray, FloatArray, float]]:
        """Ends ``(3,)``, ``(3,)`` and radius of each capsule of the contact shape."""
        edges = np.linspace(-0.5 + STEM_SHARE, 0.5 - TIP_SHARE, CAPSULES + 1)
        points, _ = self.centreline(edges)
        radius = self.thickness((edges[1:] + edges[:-1]) / 2)
        return [(points[i], points[i + 1], float(radius[i])) for i in range(CAPSULES)]

    def mesh(self) -> tuple[FloatArray, NDArray[np.uint32], FloatArray, FloatArray]:
        """Vertices ``(V, 3)`` m, triangles ``(F, 3)``, normals ``(V, 3)`` and texture coordinates ``(V, 2)``."""
        along = np.linspace(-0.5, 0.5, RINGS)
        around = np.linspace(0.0, 2 * np.pi, SIDES + 1)
        points, tangents = self.centreline(along)
        side = np.stack([-tangents[:, 1], tangents[:, 0], np.zeros(RINGS)], axis=1)
        up = np.array([0.0, 0.0, 1.0])
        ridged = 1 + RIDGE * np.cos(5 * around)
        outward = side[:, None] * np.cos(around)[None, :, None] + up * np.sin(around)[None, :, None]
        reach = (self.thickness(along)[:, None] * ridged)[..., None]
        vertices = points[:, None] + reach * outward
        slope = -np.gradient(self.thickness(along), along * self.length)[:, None, None] * tangents[:, None]
        normals = outward + slope
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        uvs = np.stack(np.meshgrid(along + 0.5, around / (2 * np.pi), indexing="ij"), axis=-1)
        first = (np.arange(RINGS - 1)[:, None] * (SIDES + 1) + np.arange(SIDES)).ravel()
        triangles = np.concatenate(
            [
                np.stack([first, first + 1, first + SIDES + 1], axis=1),
                np.stack([first + 1, first + SIDES + 2, first + SIDES + 1], axis=1),
            ]
        )
        ends = len(vertices.reshape(-1, 3))
        caps = np.concatenate(
            [
                np.stack([np.full(SIDES, ends), np.arange(SIDES) + 1, np.arange(SIDES)], axis=1),
                np.stack(
                    [np.full(SIDES, ends + 1), *(ends - SIDES - 1 + np.array([[0], [1]]) + np.arange(SIDES))], axis=1
                ),
            ]
        )
        return (
            np.concatenate([vertices.reshape(-1, 3), points[[0, -1]]]),
            np.concatenate([triangles, caps]).astype(np.uint32),
            np.concatenate([normals.reshape(-1, 3), [-tangents[0], tangents[-1]]]),
            np.concatenate([uvs.reshape(-1, 2), [[0.0, 0.0], [1.0, 0.0]]]),
        )

    def skin(self) -> NDArray[np.uint8]:
        """Texture ``(H, W, 3)``: W along the fruit from the stem, H around it."""
        rng = np.random.default_rng(self.seed)
        along = np.linspace(0.0, 1.0, TEXTURE_LENGTH)[None, :, None]
        around = np.linspace(0.0, 2 * np.pi, TEXTURE_AROUND)[:, None, None]
        green = (1 - self.ripeness) * 0.35 + 0.5 * _ease((0.35 - along) / 0.3) * (1 - 0.6 * self.ripeness)
        color = np.array(YELLOW) + np.clip(green, 0, 1) * (np.array(GREEN) - np.array(YELLOW))
        color = color * (1 - 0.10 * np.cos(5 * around) ** 8)  # the ridges are darker
        rows, columns = np.mgrid[:TEXTURE_AROUND, :TEXTURE_LENGTH]
        for _ in range(int(4 + 60 * self.ripeness**2)):
            spot = (rows - rng.uniform(0, TEXTURE_AROUND)) ** 2 + ((columns - rng.uniform(40, 235)) / 1.6) ** 2
            share = (0.75 * np.exp(-spot / rng.uniform(1.0, 10.0)))[..., None]
            color = color + share * (np.array(SPOT_BROWN) - color)
        color = _blend(color, STEM_BROWN, _ease((STEM_SHARE - along) / 0.05))
        color = _blend(color, TIP_BLACK, _ease((along - 1 + TIP_SHARE) / 0.03))
        return (np.clip(color, 0.0, 1.0) * 255).astype(np.uint8)


def _ease(share: FloatArray) -> FloatArray:
    share = np.clip(share, 0.0, 1.0)
    return share * share * (3 - 2 * share)


def _blend(color: FloatArray, other: tuple[float, float, float], share: FloatArray) -> FloatArray:
    return color + share * (np.array(other) - color)
