"""A clothes hanger, and a stand with a level rod to hang it on."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np

from robust_instant_policy.geometry import FloatArray, make_pose
from robust_instant_policy.tasks.aloha.surfaces import (
    Body,
    add_bar,
    add_solid,
    add_surface,
    box_surface,
    fixed_body,
    free_body,
    paint,
    revolved,
    tube,
)
from robust_instant_policy.tasks.textures import Color, wood

HANGER_MASS_KG = 0.06
FRICTION = 0.5
HOOK_SEGMENTS = 10
HOOK_END_RAD = -0.25  # where the hook's arc ends, past level
HANGER_COLORS: tuple[Color, ...] = ((0.85, 0.30, 0.08), (0.10, 0.35, 0.75), (0.12, 0.55, 0.25), (0.60, 0.12, 0.45))

ROD_RADIUS_M = 0.006
POST_RADIUS_M = 0.009
BASE_M = (0.10, 0.12, 0.014)
OAK: Color = (0.62, 0.42, 0.22)
DARK: Color = (0.13, 0.13, 0.14)


@dataclass(frozen=True)
class Hanger:
    """A hanger in the xy plane, its hook towards x, the foot of its neck at the origin; lengths in metres.

    ``hook`` is the radius of the hook's middle line, ``neck`` the length of the straight part under it.
    """

    width: float
    drop: float
    neck: float
    hook: float
    bar: float
    color: Color

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Hanger:
        return cls(
            width=rng.uniform(0.17, 0.19),
            drop=rng.uniform(0.042, 0.050),
            neck=rng.uniform(0.030, 0.034),
            hook=rng.uniform(0.0235, 0.0255),
            bar=rng.uniform(0.0046, 0.0052),
            color=HANGER_COLORS[rng.integers(len(HANGER_COLORS))],
        )

    @property
    def hook_middle(self) -> float:
        """Position of the hook's centre along x."""
        return self.neck + 0.020

    @property
    def hang_height(self) -> float:
        """Position along x of the contact point inside the hook."""
        return self.hook_middle + self.hook - self.bar

    def line(self) -> FloatArray:
        """Points ``(N, 3)`` along the neck and around the hook."""
        angles = np.linspace(np.pi, HOOK_END_RAD, HOOK_SEGMENTS + 1)
        arc = np.stack([self.hook_middle + self.hook * np.sin(angles), self.hook * np.cos(angles)], axis=1)
        points = np.concatenate([[[0.0, 0.0], [self.neck, 0.0]], arc])
        return np.column_stack([points, np.zeros(len(points))])

    def build(self, spec: mujoco.MjSpec, name: str, pose: FloatArray) -> Body:
        """Add the hanger to ``spec``, lying at ``pose (4, 4)``, whose origin is on the table."""
        lifted = pose.copy()
        lifted[2, 3] += self.bar
        body = free_body(spec, name, lifted)
        left, right = np.array([[-self.drop, 0.5 * sign * self.width, 0.0] for sign in (-1, 1)])
        strokes = [self.line(), np.array([left, np.zeros(3), right]), np.array([right, left])]
        length = sum(np.linalg.norm(np.diff(points, axis=0), axis=1).sum() for points in strokes)
        for index, points in enumerate(strokes):
            add_surface(spec, body, f"{name}-{index}", tube(points, self.bar), paint(self.color), shine=0.4)
            for start, stop in pairwise(points):
                mass = HANGER_MASS_KG * float(np.linalg.norm(stop - start) / length)
                add_bar(body, start, stop, self.bar, mass=mass, friction=FRICTION)
        return body


@dataclass(frozen=True)
class Stand:
    """A post on a board with a rod at ``height`` that points along -x for ``reach`` metres; fixed to the table."""

    height: float
    reach: float
    seed: int

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Stand:
        return cls(rng.uniform(0.195, 0.205), rng.uniform(0.105, 0.115), int(rng.integers(2**31)))

    def build(self, spec: mujoco.MjSpec, name: str, pose: FloatArray) -> Body:
        """Add the stand to ``spec``, its board's middle at ``pose (4, 4)``."""
        body = fixed_body(spec, name, pose)
        grain = wood(OAK, np.random.default_rng(self.seed))
        board = body.add_body(name=f"{name}-board", pos=[0, 0, BASE_M[2] / 2])
        add_surface(spec, board, f"{name}-board", box_surface(BASE_M), grain, shine=0.1)
        add_solid(board, mujoco.mjtGeom.mjGEOM_BOX, np.array(BASE_M) / 2)
        post = revolved([(POST_RADIUS_M, 0.0), (POST_RADIUS_M, self.height + 0.02), (0.0, self.height + 0.022)])
        add_surface(spec, body, f"{name}-post", post, paint(DARK), shine=0.4)
        add_bar(body, (0, 0, 0), (0, 0, self.height + 0.015), POST_RADIUS_M, friction=FRICTION)
        ends = np.array([(0.0, 0.0, self.height), (-self.reach, 0.0, self.height)])
        add_surface(spec, body, f"{name}-rod", tube(ends, ROD_RADIUS_M), paint(DARK), shine=0.4)
        add_bar(body, ends[0], ends[1], ROD_RADIUS_M, friction=FRICTION)
        return body

    def rod_pose(self, stand: FloatArray, inwards: float) -> FloatArray:
        """Pose ``(4, 4)`` on the rod's middle line, ``inwards`` metres from its free end, of a ``stand (4, 4)``."""
        return stand @ make_pose(np.eye(3), (-self.reach + inwards, 0.0, self.height))
