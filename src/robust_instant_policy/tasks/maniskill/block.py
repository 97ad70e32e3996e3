"""Boxes on the table of the cell: what is stacked, sorted and wiped."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
from mani_skill.utils.structs.actor import Actor

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.maniskill.carpentry import add_box
from robust_instant_policy.tasks.maniskill.paint import Paint

MARK_M = 0.012


@dataclass(frozen=True)
class Block:
    """A box of ``size (3,)`` metres; ``marks`` are the colours of stripes, `MARK_M` wide, along the edges of its top at
    +x and, if there are two, at -x: they show how it is turned."""

    size: tuple[float, float, float]
    paint: Paint
    marks: tuple[Paint, ...]

    @property
    def height(self) -> float:
        return self.size[2]

    def build(self, scene: Any, name: str, fixed: bool = False) -> Actor:
        """The origin is in the middle of the bottom; ``fixed`` blocks do not move."""
        builder = scene.create_actor_builder()
        add_box(builder, self.size, [0, 0, self.height / 2], self.paint)
        x, y, z = self.size
        for side, mark in zip((1, -1), self.marks, strict=False):
            add_box(builder, [MARK_M, y, 0.001], [side * (x - MARK_M) / 2, 0, z + 0.0005], mark, collide=False)
        builder.initial_pose = sapien.Pose([0, 0, 0])
        return builder.build_kinematic(name) if fixed else builder.build(name)


def corners(x: float, y: float) -> FloatArray:
    """Corners ``(4, 2)`` of a rectangle with edges of ``x`` and ``y`` metres around the origin."""
    return np.array([(side * x / 2, other * y / 2) for side in (-1, 1) for other in (-1, 1)])


def is_still(actor: Actor, limit_m_s: float = 0.01, limit_rad_s: float = 0.2) -> bool:
    return bool(actor.is_static(lin_thresh=limit_m_s, ang_thresh=limit_rad_s))


def scattered(
    rng: np.random.Generator, corners: FloatArray, count: int, fits: Callable[[FloatArray], bool]
) -> FloatArray:
    """Random places ``(count, 2)`` in a rectangle with ``corners (2, 2)``, metres, that fit."""
    low, high = corners
    while True:
        places = rng.uniform(low, high, (count, 2))
        if fits(places):
            return places


def apart(places: FloatArray) -> float:
    """The least distance of two of ``places (N, 2)``."""
    distances = np.linalg.norm(places[:, None] - places[None], axis=-1)
    return float(distances[np.triu_indices(len(places), 1)].min())
