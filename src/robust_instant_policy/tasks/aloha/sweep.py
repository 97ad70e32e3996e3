"""Sweep an object into a dustpan: one gripper holds the pan, the other the brush."""

from typing import ClassVar

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from robust_instant_policy.geometry import FloatArray, invert_pose, make_pose, transform_points
from robust_instant_policy.tasks.aloha.broom import Brush, Dustpan
from robust_instant_policy.tasks.aloha.cell import CONTROL_HZ, AlohaEnv
from robust_instant_policy.tasks.aloha.dust import Dust
from robust_instant_policy.tasks.aloha.tool_poses import grip, over
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.object_sets import draw_object
from robust_instant_policy.tasks.poses import downward, facing
from robust_instant_policy.tasks.simulated_task import TaskSpec

BRUSH_X_RANGE_M, BRUSH_Y_RANGE_M = (-0.24, -0.20), (0.17, 0.21)
DUST_X_RANGE_M, DUST_Y_RANGE_M = (-0.16, -0.08), (-0.10, 0.07)
PAN_X_RANGE_M, PAN_Y_RANGE_M = (0.00, 0.05), (-0.22, -0.16)  # of its lip
SWEPT_M = ((-0.14, -0.06), (-0.14, 0.06), (0.22, -0.08), (0.22, 0.08))  # from the object on
BRUSH_M = ((-0.05, -0.05), (-0.05, 0.05), (0.05, -0.05), (0.05, 0.05))
PAN_M = ((-0.02, -0.07), (-0.02, 0.07), (0.20, 0.0))
BRUSH_YAW_RANGE_RAD, PAN_YAW_RANGE_RAD = np.deg2rad((-8, 8)), np.deg2rad((-10, 10))

TOUCHED_SECONDS = 0.3  # minimum contact of the held brush with the table

HOLD_M = 0.052  # of the handle's length, from its top
ABOVE_M = 0.05
LIFT_M = 0.06
AWAY_M = 0.04  # lift of the brush at the end
BEHIND_M = 0.045  # behind the object, where the brush descends
PRESS_M = 0.002  # of the bristles into the table
INTO_M = 0.055  # travel of the brush beyond the lip

AHEAD_M = 0.125  # ahead of the object, where the pan's lip is held
TILT_RAD = np.deg2rad(40)  # of the gripper at the pan, away from the other one
BEYOND_M = 0.012  # of its fingertips past the handle's middle
LIP_DOWN_RAD = np.deg2rad(2.5)  # tilt of the pan, so that its lip lies on the table
CARRY_M = 0.03  # lift of the pan
RIGHT = 1  # number of the arm


class SweepEnv(AlohaEnv):
    """Success: the object lies in the dustpan, which is held or on the table, and the held brush touched the
    table."""

    end_effectors: ClassVar[tuple[str, ...]] = ("left", "right")
    beside = ((0.02, -0.95, 0.60), (0.0, 0.0, 0.08))
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
        pan = facing(rng.uniform(*PAN_X_RANGE_M), rng.uniform(*PAN_Y_RANGE_M), rng.uniform(*PAN_YAW_RANGE_RAD))
        dust = facing(x, y, rng.uniform(-np.pi, np.pi))
        # Both arms work beside each other: the tools stay as they are, the object lies in any direction already.
        self.layout.place(dust, [(0.0, 0.0)], turn=0.0)
        self.layout.place(facing(x, y, 0.0), SWEPT_M, turn=0.0)
        self.brush.build(spec, "brush", self.layout.place(brush, [(0.0, 0.0)], BRUSH_M, turn=0.0))
        self.pan.build(spec, "dustpan", self.layout.place(pan, [(0.0, 0.0)], PAN_M, turn=0.0))
        self.dust.build(spec, "dust", dust)
        self._touched = 0.0

    def advance(self, command: FloatArray) -> None:
        super().advance(command)
        if self.touch("brush", "world") > 0 and self.is_held("brush"):
            self._touched += 1 / CONTROL_HZ

    def failure(self) -> str:
        x, y, z = transform_points(invert_pose(self.pose_of("dustpan")), self.pose_of("dust")[:3, 3])
        if not (self.pan.lip < x < self.pan.depth and abs(y) < self.pan.width / 2 and z < self.pan.wall):
            return f"the object is not in the dustpan, but {-1e3 * x:.0f} mm before its lip"
        if not (self.is_held("dustpan", "right") or self.touch("dustpan", "world") > 0):
            return "the object is in the dustpan, but the dustpan is neither held nor on the table"
        if self._touched < TOUCHED_SECONDS:
            return "the object is in the dustpan, but the brush touched the table too briefly"
        return ""


def sweep(env: SweepEnv, rng: np.random.Generator) -> list[Stroke]:
    """Hold the pan ahead of the object with one gripper; with the other grasp the brush at its handle, set it down
    behind the object, push the object over the lip, and lift the brush."""
    brush, dust, pan = (env.pose_of(name) for name in ("brush", "dust", "dustpan"))

    def at(x: float, y: float, height: float, yaw: float = 0.0) -> FloatArray:
        return downward(x, y, height, yaw)[None]

    def holding(pan: FloatArray, height: float = 0.0) -> FloatArray:
        return (pan @ grip(over(env.pan.grip, height), TILT_RAD, np.pi, BEYOND_M))[None]

    # The brush stays perpendicular to the table and moves straight over the lip.
    hold = env.brush.height - HOLD_M
    x, y = brush[:2, 3].tolist()
    yaw = float(np.arctan2(brush[1, 0], brush[0, 0]))
    dust_x, dust_y = dust[:2, 3].tolist()
    behind = dust_x - max(env.dust.size[:2]) / 2 - env.brush.depth / 2 - BEHIND_M
    lip = dust_x + AHEAD_M - env.brush.depth / 2
    inside = lip + INTO_M
    ahead = make_pose(Rotation.from_euler("y", -LIP_DOWN_RAD).as_matrix(), (dust_x + AHEAD_M, dust_y, 0.0))

    return [
        Stroke(holding(pan, ABOVE_M), closed=False, free=True, error=0.003, arm=RIGHT),
        Stroke(at(x, y, env.brush.height + ABOVE_M, yaw), closed=False, free=True, error=0.003),
        Stroke(holding(pan), closed=True, speed=0.10, error=0.0015, arm=RIGHT),
        Stroke(at(x, y, hold, yaw), closed=True, speed=0.10, error=0.0015, waits=True),
        Stroke(holding(pan, CARRY_M), closed=True, speed=0.12, error=0.003, arm=RIGHT),
        Stroke(holding(ahead, CARRY_M), closed=True, speed=0.16, error=0.003, arm=RIGHT),
        Stroke(holding(ahead, -PRESS_M), closed=True, speed=0.08, error=0.0015, arm=RIGHT),
        Stroke(at(x, y, hold + LIFT_M, yaw), closed=True, speed=0.12, error=0.003),
        Stroke(at(behind, dust_y, hold + LIFT_M), closed=True, speed=0.20, error=0.004),
        Stroke(at(behind, dust_y, hold - PRESS_M), closed=True, speed=0.10, error=0.0015, pause=0.2),
        Stroke(
            np.concatenate([at(lip, dust_y, hold - PRESS_M), at(inside, dust_y, hold + env.pan.floor)]),
            closed=True,
            speed=0.09,
            error=0.0015,
            pause=0.2,
            waits=True,
        ),
        Stroke(at(inside, dust_y, hold + AWAY_M), closed=True, speed=0.12, error=0.004),
    ]


SPEC = TaskSpec(
    name="aloha-sweep",
    description="sweep the object into the dustpan with the brush",
    goal="the object is in the dustpan",
    expert=sweep,
    object_sets=("seen", "unseen"),
)
