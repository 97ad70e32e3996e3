"""Small cabinets with one door, built of boxes, in two families."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from robust_instant_policy.tasks.maniskill.carpentry import Joint, add_box, add_cylinder, build_mechanism
from robust_instant_policy.tasks.maniskill.mechanism import Door, Mechanism
from robust_instant_policy.tasks.maniskill.paint import BLACK, STEEL, WHITE, Paint

BOARD_M = 0.012
DOOR_M = 0.016
GAP_M = 0.002
DOOR_LIMIT_RAD = np.deg2rad(110)
HINGE_SIDE = 1.0  # the hinge is on the cabinet's +y side
HINGE_DAMPING, HINGE_FRICTION = 0.08, 0.05  # an ordinary door


@dataclass(frozen=True)
class Cabinet:
    """A cabinet with one door; its frame lies on the table under the middle of its front, -x outwards.

    ``width`` (y), ``depth`` (x), ``height`` in metres.
    """

    width: float
    depth: float
    height: float
    handle_kind: str
    body: Paint
    door: Paint
    handle: Paint
    shelf: bool

    @classmethod
    def draw_seen(cls, number: int, rng: np.random.Generator) -> Cabinet:
        """Low and wide, painted or of oak, with a bar handle."""
        bodies = (Paint((0.80, 0.66, 0.46), grain=True), Paint((0.42, 0.55, 0.60)), WHITE)
        doors = (Paint((0.30, 0.38, 0.47)), Paint((0.62, 0.30, 0.22)), Paint((0.25, 0.45, 0.36)))
        return cls(
            width=rng.uniform(0.18, 0.22),
            depth=rng.uniform(0.13, 0.16),
            height=rng.uniform(0.13, 0.16),
            handle_kind="bar",
            body=bodies[number % 3],
            door=doors[(number // 3 + number) % 3],
            handle=(BLACK, STEEL)[number % 2],
            shelf=True,
        )

    @classmethod
    def draw_unseen(cls, number: int, rng: np.random.Generator) -> Cabinet:
        """Narrower and deeper, of dark wood or in other colours, with a knob."""
        bodies = (Paint((0.36, 0.24, 0.16), grain=True), Paint((0.55, 0.63, 0.50)), Paint((0.70, 0.68, 0.66)))
        doors = (Paint((0.86, 0.78, 0.60), grain=True), Paint((0.85, 0.62, 0.20)), Paint((0.45, 0.25, 0.42)))
        return cls(
            width=rng.uniform(0.155, 0.18),
            depth=rng.uniform(0.16, 0.19),
            height=rng.uniform(0.15, 0.18),
            handle_kind="knob",
            body=bodies[number % 3],
            door=doors[(number // 3 + number) % 3],
            handle=STEEL,
            shelf=False,
        )

    @property
    def door_width(self) -> float:
        return self.width - 2 * GAP_M

    @property
    def door_top(self) -> float:
        """Height of the door's upper edge."""
        return self.height - GAP_M

    @property
    def door_geometry(self) -> Door:
        hinge_at = np.array([0.0, HINGE_SIDE * self.door_width / 2])
        return Door(hinge_at, HINGE_SIDE, self.door_width, self.door_top)

    def build(self, scene: Any) -> Mechanism:
        at, axis = (*self.door_geometry.hinge, 0.0), (0.0, 0.0, -HINGE_SIDE)
        hinge = Joint("hinge", "revolute", at, axis, DOOR_LIMIT_RAD, HINGE_DAMPING, HINGE_FRICTION)
        return build_mechanism(scene, "cabinet", self._build_body, "door", self._build_door, hinge)

    def _build_body(self, link: Any) -> None:
        width, depth, height = self.width, self.depth, self.height
        middle = DOOR_M + depth / 2
        add_box(link, (depth, width, BOARD_M), (middle, 0, BOARD_M / 2), self.body)
        add_box(link, (depth, width, BOARD_M), (middle, 0, height - BOARD_M / 2), self.body)
        inner = height - 2 * BOARD_M
        for side in (-1, 1):
            add_box(link, (depth, BOARD_M, inner), (middle, side * (width - BOARD_M) / 2, height / 2), self.body)
        back = (BOARD_M, width - 2 * BOARD_M, inner)
        add_box(link, back, (DOOR_M + depth - BOARD_M / 2, 0, height / 2), self.body)
        if self.shelf:
            shelf = (depth - 0.03, width - 2 * BOARD_M, 0.008)
            add_box(link, shelf, (middle + 0.012, 0, height / 2), self.body, collide=False)

    def _build_door(self, link: Any) -> None:
        # In the link's frame the hinge is the z axis; the closed door reaches to the side away from it, and its
        # outer face is at x = 0.
        width, height = self.door_width, self.door_top - GAP_M
        centre = np.array([DOOR_M / 2, -HINGE_SIDE * width / 2, GAP_M + height / 2])
        add_box(link, (DOOR_M, width, height), centre, self.door)
        rim = WHITE if self.door != WHITE else BLACK
        edge = centre + np.array([0, 0, height / 2])
        add_box(link, (DOOR_M, width, 0.002), edge, rim, collide=False)
        at = np.array([0.0, -HINGE_SIDE * (width - 0.022), 0.55 * height])
        if self.handle_kind == "bar":
            add_cylinder(link, 0.006, 0.06, at - np.array([0.022, 0, 0]), "z", self.handle)
            for end in (-0.022, 0.022):
                add_cylinder(link, 0.004, 0.022, at + np.array([-0.011, 0, end]), "x", self.handle)
        else:
            add_cylinder(link, 0.006, 0.014, at - np.array([0.007, 0, 0]), "x", self.handle)
            add_cylinder(link, 0.013, 0.014, at - np.array([0.02, 0, 0]), "x", self.handle)
