"""How a person picks something up from the table, and in which words that fails: the same for every arm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.poses import downward

LIFT_SPREAD_M = 0.02  # people lift higher one time and less high another
GRASP_ERROR_M = 0.0015


@dataclass(frozen=True)
class Pick:
    """Heights of the fingertips over the table in metres, speeds in m/s, ``error`` of free strokes in metres."""

    above: float
    grasp: float
    lift: float
    reach_speed: float
    down_speed: float
    lift_speed: float
    error: float

    def strokes(self, pose: FloatArray, rng: np.random.Generator) -> list[Stroke]:
        """Come down over what lies at ``pose (4, 4)``, fingers across its x axis, close, lift and hold."""
        x, y = pose[:2, 3].tolist()
        yaw = float(np.arctan2(pose[1, 0], pose[0, 0]))
        lift = self.lift + rng.uniform(-LIFT_SPREAD_M, LIFT_SPREAD_M)
        above, grasp, lifted = (np.array([downward(x, y, z, yaw)]) for z in (self.above, self.grasp, lift))
        return [
            Stroke(above, closed=False, free=True, speed=self.reach_speed, error=self.error),
            Stroke(grasp, closed=True, speed=self.down_speed, error=GRASP_ERROR_M),
            Stroke(lifted, closed=True, speed=self.lift_speed, error=self.error),
        ]


def failure_of_pick(state: Mapping[str, Any], what: str) -> str:
    """Why ``what`` was not picked, or nothing, by the "success", "lifted" and "held" of an environment's evaluation."""
    if bool(state["success"]):
        return ""
    if not bool(state["held"]):
        return f"the {what} slipped out of the fingers" if bool(state["lifted"]) else f"the fingers hold no {what}"
    return f"the {what} is held but still moving" if bool(state["lifted"]) else f"the {what} was not lifted"
