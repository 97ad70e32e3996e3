"""Faucets with a spout and one lever on top, in two families."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from robust_instant_policy.tasks.maniskill.carpentry import Joint, add_ball, add_box, add_cylinder, build_mechanism
from robust_instant_policy.tasks.maniskill.mechanism import Lever, Mechanism
from robust_instant_policy.tasks.maniskill.paint import BLACK, BRASS, RED, STEEL, WHITE, Paint

LEVER_GAP_M = 0.003
LEVER_DAMPING, LEVER_FRICTION = 0.06, 0.05  # a cartridge valve
START_RAD = np.deg2rad(90)  # the lever starts over the faucet's +y side and turns towards +x


@dataclass(frozen=True)
class Faucet:
    """A faucet with one lever on top; its frame lies on the table under the lever's axis, the spout along -x.

    Lengths in metres, ``turn`` the lever's range in rad.
    """

    column: float
    height: float
    spout: float
    lever: float
    lever_half_width: float
    turn: float
    square: bool
    metal: Paint
    grip: Paint

    @classmethod
    def draw_seen(cls, number: int, rng: np.random.Generator) -> Faucet:
        """Round columns, round levers with a coloured ball at the end."""
        return cls(
            column=rng.uniform(0.018, 0.023),
            height=rng.uniform(0.08, 0.11),
            spout=rng.uniform(0.10, 0.13),
            lever=rng.uniform(0.085, 0.105),
            lever_half_width=rng.uniform(0.006, 0.008),
            turn=rng.uniform(np.deg2rad(80), np.deg2rad(95)),
            square=False,
            metal=(STEEL, WHITE, BRASS)[number % 3],
            grip=(RED, Paint((0.10, 0.25, 0.70)), BLACK)[(number // 3 + number) % 3],
        )

    @classmethod
    def draw_unseen(cls, number: int, rng: np.random.Generator) -> Faucet:
        """Square columns, flat levers with a coloured end, other colours."""
        return cls(
            column=rng.uniform(0.020, 0.026),
            height=rng.uniform(0.10, 0.125),
            spout=rng.uniform(0.08, 0.11),
            lever=rng.uniform(0.075, 0.09),
            lever_half_width=rng.uniform(0.008, 0.011),
            turn=rng.uniform(np.deg2rad(80), np.deg2rad(95)),
            square=True,
            metal=(Paint((0.30, 0.31, 0.33), 0.4, 0.3), Paint((0.86, 0.83, 0.75), 0.4, 0.2))[number % 2],
            grip=(Paint((0.16, 0.55, 0.30)), WHITE)[number // 2 % 2],
        )

    @property
    def lever_height(self) -> float:
        """Height of the lever's middle above the table."""
        return self.height + LEVER_GAP_M + self.column * 0.5

    @property
    def lever_geometry(self) -> Lever:
        return Lever(
            pivot=np.zeros(2),
            start=START_RAD,
            sign=-1.0,
            turn=self.turn,
            length=self.lever,
            half_width=self.lever_half_width,
            height=self.lever_height,
        )

    def build(self, scene: Any) -> Mechanism:
        at, axis = (0, 0, self.lever_height), (0, 0, -1)
        valve = Joint("valve", "revolute", at, axis, self.turn, LEVER_DAMPING, LEVER_FRICTION)
        return build_mechanism(scene, "faucet", self._build_body, "lever", self._build_lever, valve)

    def _build_body(self, link: Any) -> None:
        spout_height = 0.72 * self.height
        end = -self.spout
        if self.square:
            add_box(link, (4 * self.column, 3 * self.column, 0.01), (0, 0, 0.005), self.metal)
            add_box(link, (2 * self.column, 2 * self.column, self.height), (0, 0, self.height / 2), self.metal)
            add_box(link, (self.spout, 0.026, 0.02), (end / 2, 0, spout_height), self.metal)
            add_box(link, (0.024, 0.026, 0.03), (end + 0.012, 0, spout_height - 0.015), self.metal)
        else:
            add_cylinder(link, 2 * self.column, 0.008, (0, 0, 0.004), "z", self.metal)
            add_cylinder(link, self.column, self.height, (0, 0, self.height / 2), "z", self.metal)
            rise = 0.02
            add_cylinder(
                link, 0.011, self.spout, (end / 2, 0, spout_height + rise / 2), (-self.spout, 0, rise), self.metal
            )
            add_ball(link, 0.011, (end, 0, spout_height + rise), self.metal)
            add_cylinder(link, 0.011, 0.03, (end, 0, spout_height + rise - 0.015), "z", self.metal)

    def _build_lever(self, link: Any) -> None:
        # In the link's frame the valve is the z axis and the closed lever reaches along +y.
        length, half = self.lever, self.lever_half_width
        if self.square:
            add_box(link, (2 * self.column, 2 * self.column, self.column), (0, 0, 0), self.metal)
            add_box(link, (2 * half, length, 0.012), (0, length / 2, 0), self.metal)
            add_box(link, (2 * half, 0.022, 0.0135), (0, length - 0.011, 0), self.grip)
        else:
            add_cylinder(link, self.column * 0.95, self.column, (0, 0, 0), "z", self.metal)
            add_cylinder(link, half, length, (0, length / 2, 0), "y", self.metal)
            add_ball(link, half * 1.5, (0, length, 0), self.grip)
