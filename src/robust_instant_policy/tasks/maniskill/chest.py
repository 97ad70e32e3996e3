"""Small chests of drawers, built of boxes, with random sizes, colours and handles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from robust_instant_policy.tasks.maniskill.carpentry import Joint, add_box, add_cylinder, build_mechanism
from robust_instant_policy.tasks.maniskill.mechanism import Drawer, Mechanism
from robust_instant_policy.tasks.maniskill.paint import BLACK, STEEL, WHITE, Paint

BOARD_M = 0.01
FRONT_M = 0.014  # thickness of the drawer's front
GAP_M = 0.003  # around the drawer's front
HANDLE_M = 0.045  # protrusion of handles
GRASP_REACH_M = 0.034  # from the front to the grasp point of a handle
SLIDE_DAMPING, SLIDE_FRICTION = 15.0, 0.05  # of wooden runners

BODIES = (
    Paint((0.80, 0.66, 0.46), grain=True),
    Paint((0.36, 0.24, 0.16), grain=True),
    Paint((0.42, 0.55, 0.60)),
    Paint((0.55, 0.63, 0.50)),
    WHITE,
)
FRONTS = (WHITE, Paint((0.88, 0.80, 0.62), grain=True), Paint((0.30, 0.38, 0.47)), Paint((0.62, 0.30, 0.22)))
HANDLES = (BLACK, WHITE, STEEL)
HANDLE_KINDS = ("knob", "fin", "bar")


@dataclass(frozen=True)
class Chest:
    """A chest whose upper drawer opens; its frame lies on the table under the middle of its front, -x outwards.

    ``width`` (y), ``depth`` (x), ``height``, ``drawer_height`` and ``travel`` of the drawer in metres.
    """

    width: float
    depth: float
    height: float
    drawer_height: float
    travel: float
    handle_kind: str
    body: Paint
    front: Paint
    handle: Paint

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Chest:
        body = BODIES[rng.integers(len(BODIES))]
        fronts = [paint for paint in FRONTS if paint != body]
        return cls(
            width=rng.uniform(0.18, 0.24),
            depth=rng.uniform(0.17, 0.20),
            height=rng.uniform(0.11, 0.14),
            drawer_height=rng.uniform(0.055, 0.065),
            travel=rng.uniform(0.11, 0.13),
            handle_kind=HANDLE_KINDS[rng.integers(len(HANDLE_KINDS))],
            body=body,
            front=fronts[rng.integers(len(fronts))],
            handle=HANDLES[rng.integers(len(HANDLES))],
        )

    @property
    def handle_height(self) -> float:
        """Height of the handle's middle above the table."""
        return self.height - BOARD_M - self.drawer_height / 2

    @property
    def drawer(self) -> Drawer:
        return Drawer(np.array([-GRASP_REACH_M, 0.0, self.handle_height]), self.travel)

    def build(self, scene: Any) -> Mechanism:
        at, axis = (0.0, 0.0, self.handle_height), (-1.0, 0.0, 0.0)
        slide = Joint("slide", "prismatic", at, axis, self.travel, SLIDE_DAMPING, SLIDE_FRICTION)
        return build_mechanism(scene, "chest", self._build_body, "drawer", self._build_drawer, slide)

    def _build_body(self, link: Any) -> None:
        width, depth, height = self.width, self.depth, self.height
        add_box(link, (depth, width + 0.012, BOARD_M), (depth / 2 - 0.006, 0, height - BOARD_M / 2), self.body)
        for side in (-1, 1):
            at = (depth / 2, side * (width - BOARD_M) / 2, (height - BOARD_M) / 2)
            add_box(link, (depth, BOARD_M, height - BOARD_M), at, self.body)
        add_box(
            link,
            (BOARD_M, width - 2 * BOARD_M, height - BOARD_M),
            (depth - BOARD_M / 2, 0, (height - BOARD_M) / 2),
            self.body,
        )
        plinth = height - BOARD_M - self.drawer_height
        add_box(link, (FRONT_M, width - 2 * BOARD_M, plinth), (FRONT_M / 2, 0, plinth / 2), self.body)
        add_box(link, (0.001, width - 0.05, plinth * 0.7), (-0.0005, 0, plinth / 2), self.front, collide=False)

    def _build_drawer(self, link: Any) -> None:
        width = self.width - 2 * BOARD_M - 2 * GAP_M
        height = self.drawer_height - 2 * GAP_M
        inside, wall = self.travel + 0.02, 0.005
        wood = Paint((0.86, 0.75, 0.56), grain=True)
        add_box(link, (FRONT_M, width, height), (FRONT_M / 2 - 0.004, 0, 0), self.front)
        add_box(link, (inside, width - 0.01, wall), (inside / 2 + 0.01, 0, -height / 2 + 0.008), wood)
        for side in (-1, 1):
            at = (inside / 2 + 0.01, side * (width - 0.016) / 2, -0.004)
            add_box(link, (inside, wall, height * 0.75), at, wood)
        add_box(link, (wall, width - 0.016, height * 0.75), (inside + 0.01, 0, -0.004), wood)
        self._build_handle(link)

    def _build_handle(self, link: Any) -> None:
        face = -0.004
        if self.handle_kind == "knob":
            add_cylinder(link, 0.007, HANDLE_M - 0.018, (face - (HANDLE_M - 0.018) / 2, 0, 0), "x", self.handle)
            add_cylinder(link, 0.013, 0.02, (face - HANDLE_M + 0.01, 0, 0), "x", self.handle)
        elif self.handle_kind == "fin":
            add_box(link, (HANDLE_M, 0.014, 0.032), (face - HANDLE_M / 2, 0, 0), self.handle)
        else:
            add_cylinder(link, 0.008, 0.044, (face - GRASP_REACH_M, 0, 0), "z", self.handle)
            for end in (-0.016, 0.016):
                add_cylinder(link, 0.005, GRASP_REACH_M, (face - GRASP_REACH_M / 2, 0, end), "x", self.handle)
