"""Sweep something into a dustpan with a brush that touches the table."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from robust_instant_policy.geometry import FloatArray, invert_pose, transform_points
from robust_instant_policy.tasks.aloha.broom import Brush, Dustpan
from robust_instant_policy.tasks.aloha.cell import CONTROL_HZ, AlohaEnv
from robust_instant_policy.tasks.aloha.dust import Dust
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.object_sets import draw_object
from robust_instant_policy.tasks.poses import downward, facing
from robust_instant_policy.tasks.simulated_task import TaskSpec

BRUSH_X_RANGE_M, BRUSH_Y_RANGE_M = (-0.24, -0.20), (0.17, 0.21)
DUST_X_RANGE_M, DUST_Y_RANGE_M = (-0.16, -0.08), (-0.10, 0.07)
PAN_AHEAD_RANGE_M, PAN_ASIDE_RANGE_M = (0.115, 0.135), (-0.012, 0.012)  # of the dust: somebody held it there
BRUSH_YAW_RANGE_RAD, PAN_YAW_RANGE_RAD = np.deg2rad((-8, 8)), np.deg2rad((-6, 6))

TOUCHED_SECONDS = 0.3  # for which the held brush has to touch the table

HOLD_M = 0.052  # of the handle's length, from its top
ABOVE_M = 0.05
LIFT_M = 0.06
AWAY_M = 0.04  # that the brush is lifted by at the end
BEHIND_M = 0.045  # of the dust's near side, where the brush comes down
PRESS_M = 0.002  # of the bristles into the table
INTO_M = 0.055  # how far the brush goes on from the lip


class SweepEnv(AlohaEnv):
    """Success: the object lies in the dustpan, swept there by a brush that touched the table."""

    dust: Dust
    brush: Brush
    pan: Dustpan

    def build(self, spec: mujoco.MjSpec) -> None:
        families = {"seen": Dust.draw_seen, "unseen": Dust.draw_unseen}
        self.dust = draw_object(families, self.objects, self.draw("shape"))
        self.brush, self.pan = Brush(seed=int(self.draw("brush").integers(2**31))), Dustpan()
        rng = self.draw("pose")
        brush = facing(rng.uniform(*BRUSH_X_RANGE_M), rng.uniform(*BRUSH_Y_RANGE_M), rng.uniform(*BRUSH_YAW_RANGE_RAD))
        x, y = rng.uniform(*DUST_X_RANGE_M), rng.uniform(*DUST_Y_RANGE_M)
        ahead, aside = rng.uniform(*PAN_AHEAD_RANGE_M), rng.uniform(*PAN_ASIDE_RANGE_M)
        pan = facing(x + ahead, y + aside, rng.uniform(*PAN_YAW_RANGE_RAD))
        self.brush.build(spec, "brush", brush)
        self.pan.build(spec, "dustpan", pan)
        self.dust.build(spec, "dust", facing(x, y, rng.uniform(-np.pi, np.pi)))
        self._touched = 0.0

    def advance(self, command: FloatArray) -> None:
        super().advance(command)
        if self.touch("brush", "world") > 0 and self.is_held("brush"):
            self._touched += 1 / CONTROL_HZ

    def evaluate(self) -> dict[str, Any]:
        x, y, z = transform_points(invert_pose(self.pose_of("dustpan")), self.pose_of("dust")[:3, 3])
        inside = self.pan.lip < x < self.pan.depth and abs(y) < self.pan.width / 2 and z < self.pan.wall
        touched = self._touched >= TOUCHED_SECONDS
        return {"success": bool(inside and touched), "inside": bool(inside), "touched": touched, "short": -float(x)}


def sweep(env: SweepEnv, rng: np.random.Generator) -> list[Stroke]:
    """Take the brush by its handle, set it down behind the dust, push that over the lip, and lift the brush."""
    brush, dust, pan = (env.pose_of(name) for name in ("brush", "dust", "dustpan"))
    yaw = float(np.arctan2(brush[1, 0], brush[0, 0]))
    hold = env.brush.height - HOLD_M
    x, y = brush[:2, 3].tolist()

    # The brush stays square to the table and goes straight on, over the lip.
    reach = max(env.dust.size[:2]) / 2 + env.brush.depth / 2
    start = dust[:2, 3] - np.array([reach + BEHIND_M, 0.0])
    lip = np.array([pan[0, 3] - env.brush.depth / 2, dust[1, 3]])
    stop = lip + np.array([INTO_M, 0.0])

    def at(place: FloatArray, height: float) -> FloatArray:
        return downward(float(place[0]), float(place[1]), height)

    return [
        Stroke(np.array([downward(x, y, env.brush.height + ABOVE_M, yaw)]), closed=False, free=True, error=0.003),
        Stroke(np.array([downward(x, y, hold, yaw)]), closed=True, speed=0.10, error=0.0015),
        Stroke(np.array([downward(x, y, hold + LIFT_M, yaw)]), closed=True, speed=0.12, error=0.003),
        Stroke(at(start, hold + LIFT_M)[None], closed=True, speed=0.20, error=0.004),
        Stroke(at(start, hold - PRESS_M)[None], closed=True, speed=0.10, error=0.0015, pause=0.2),
        Stroke(
            np.array([at(lip, hold - PRESS_M), at(stop, hold + env.pan.floor)]),
            closed=True,
            speed=0.09,
            error=0.0015,
            pause=0.2,
        ),
        Stroke(at(stop, hold + AWAY_M)[None], closed=True, speed=0.12, error=0.004),
    ]


def verdict(env: SweepEnv) -> str:
    """Why the task failed, or nothing."""
    state = env.evaluate()
    if state["success"]:
        return ""
    if not state["inside"]:
        return f"the object is not in the dustpan, but {1e3 * state['short']:.0f} mm before its lip"
    return "the object is in the dustpan, but the brush hardly touched the table"


SPEC = TaskSpec(
    name="aloha-sweep",
    description="sweep the object into the dustpan with the brush",
    goal="the object is in the dustpan",
    env_id="RIP-AlohaSweep-v1",
    expert=sweep,
    verdict=verdict,
    object_sets=("seen", "unseen"),
)
