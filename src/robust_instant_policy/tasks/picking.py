"""Picking an object from the table: the strokes, and the reason of a failure."""

from dataclasses import dataclass

import numpy as np

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.poses import downward

LIFT_SPREAD_M = 0.02  # of the lift height between episodes
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
        """Descend to the object at ``pose (4, 4)`` with the fingers across its x axis, close, lift and hold."""
        x, y = pose[:2, 3].tolist()
        yaw = float(np.arctan2(pose[1, 0], pose[0, 0]))
        lift = self.lift + rng.uniform(-LIFT_SPREAD_M, LIFT_SPREAD_M)
        above, grasp, lifted = (np.array([downward(x, y, z, yaw)]) for z in (self.above, self.grasp, lift))
        return [
            Stroke(above, closed=False, free=True, speed=self.reach_speed, error=self.error),
            Stroke(grasp, closed=True, speed=self.down_speed, error=GRASP_ERROR_M),
            Stroke(lifted, closed=True, speed=self.lift_speed, error=self.error),
        ]


def failure_of_pick(what: str, lifted: bool, held: bool, still: bool) -> str:
    """Reason why ``what`` was not picked; empty if it is held ``still`` above the table."""
    if not held:
        return f"the {what} slipped out of the fingers" if lifted else f"the fingers hold no {what}"
    if not lifted:
        return f"the {what} was not lifted"
    return "" if still else f"the {what} is held but still moving"


def set_down(target: FloatArray, pick: Pick) -> list[Stroke]:
    """Carry what ``pick`` holds over ``target (4, 4)``, where its frame is to be, lower it, let go and retreat."""
    x, y, z = target[:3, 3].tolist()
    yaw = float(np.arctan2(target[1, 0], target[0, 0]))
    over, down = (np.array([downward(x, y, z + height, yaw)]) for height in (pick.above, pick.grasp))
    return [
        Stroke(over, closed=True, speed=pick.lift_speed, error=pick.error),
        Stroke(down, closed=False, speed=pick.down_speed, error=GRASP_ERROR_M, pause=0.2),
        Stroke(over, closed=False, free=True, speed=pick.lift_speed, error=pick.error),
    ]
