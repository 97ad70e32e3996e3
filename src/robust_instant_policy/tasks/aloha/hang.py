"""Hang a clothes hanger on a level rod."""

import mujoco
import numpy as np

from robust_instant_policy.tasks.aloha.cell import AlohaEnv
from robust_instant_policy.tasks.aloha.hanger import ROD_RADIUS_M, Hanger, Stand
from robust_instant_policy.tasks.aloha.tool_poses import back, bearing, grip, over
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.poses import facing
from robust_instant_policy.tasks.simulated_task import TaskSpec

HANGER_X_RANGE_M, HANGER_Y_RANGE_M = (-0.21, -0.17), (-0.05, 0.05)
HANGER_YAW_RAD = np.deg2rad(10)
HANGER_TURN_RAD = np.deg2rad(15)  # more at the hard level: the neck is grasped along the arm
HANGER_M = ((-0.05, -0.10), (-0.05, 0.10), (0.08, 0.0))
STAND_M = ((-0.12, -0.10), (-0.12, 0.10), (0.08, -0.08), (0.08, 0.08))  # with the hanger before it
STAND_X_RANGE_M, STAND_Y_RANGE_M = (0.08, 0.15), (-0.14, 0.14)
STAND_YAW_RAD = np.deg2rad(12)  # deviation from facing the arm, to either side

SLOW_M_S = 0.15  # a hanging hanger may swing; a falling one is faster

PITCH_RAD = np.deg2rad(-10)  # of the descending gripper
HOLD_M = 0.016  # of the neck's length, from its foot
BEYOND_M = 0.0025  # fingertips past the neck
APPROACH_M = 0.08
LIFT_M = 0.08
TURN_FIRST_RAD = np.deg2rad(20)
INWARDS_M = 0.035  # from the rod's free end to where the hanger hangs
SHORT_M = 0.07  # of that place, where the hanger is first held up
DROP_M = 0.003  # of the hook above the rod at release
DRAW_BACK_M = 0.09


class HangEnv(AlohaEnv):
    """Success: the hanger hangs on the rod, touching nothing else."""

    hanger: Hanger
    stand: Stand

    def build(self, spec: mujoco.MjSpec) -> None:
        self.hanger, self.stand = Hanger.draw(self.draw("hanger")), Stand.draw(self.draw("stand"))
        rng = self.draw("pose")
        x, y = rng.uniform(*HANGER_X_RANGE_M), rng.uniform(*HANGER_Y_RANGE_M)
        pose = facing(x, y, rng.uniform(-HANGER_YAW_RAD, HANGER_YAW_RAD))
        self.hanger.build(spec, "hanger", self.layout.place(pose, [(0.0, 0.0)], HANGER_M, HANGER_TURN_RAD))
        x, y = rng.uniform(*STAND_X_RANGE_M), rng.uniform(*STAND_Y_RANGE_M)
        yaw = bearing(np.array([x, y, 0.0])) + rng.uniform(-STAND_YAW_RAD, STAND_YAW_RAD)
        stand = self.layout.place(facing(x, y, yaw), [(0.0, 0.0)], STAND_M, turn=0.0)  # the hook goes over one end
        self.stand.build(spec, "stand", stand)

    def failure(self) -> str:
        if self.is_held("hanger"):
            return "the hanger is still in the fingers"
        if self.touch("hanger", "world") > 0 or self.touch("hanger", "stand-board") > 0:
            return "the hanger fell, or was never lifted"
        slow = float(np.linalg.norm(self.data.joint("hanger").qvel[:3])) < SLOW_M_S
        return "" if self.touch("hanger", "stand") > 0 and slow else "the hanger does not hang on the rod"


def hang(env: HangEnv, rng: np.random.Generator) -> list[Stroke]:
    """Grasp the hanger at its neck, rotate it up, move the hook over the rod, lower it, release and retreat."""
    lying = env.pose_of("hanger")
    yaw = float(np.arctan2(lying[1, 0], lying[0, 0]))
    neck = lying[:3, 3] + HOLD_M * lying[:3, 0]
    hold = grip(neck, PITCH_RAD, yaw, BEYOND_M)
    lifted = grip(over(neck, LIFT_M), PITCH_RAD + TURN_FIRST_RAD, bearing(neck), BEYOND_M)

    rod = env.stand.rod_pose(env.pose_of("stand"), INWARDS_M)
    along = float(np.arctan2(rod[1, 0], rod[0, 0]))
    upright = PITCH_RAD + np.pi / 2
    hung = over(rod[:3, 3], ROD_RADIUS_M - (env.hanger.hang_height - HOLD_M) + DROP_M)
    threaded = over(rod[:3, 3], HOLD_M - env.hanger.hook_middle)
    end = grip(hung, upright, along, BEYOND_M)
    return [
        Stroke(back(hold, APPROACH_M)[None], closed=False, free=True, speed=0.20, error=0.003),
        Stroke(hold[None], closed=True, speed=0.08, error=0.001),
        Stroke(
            np.array([lifted, grip(threaded - SHORT_M * rod[:3, 0], upright, along, BEYOND_M)]),
            closed=True,
            speed=0.16,
            error=0.003,
        ),
        Stroke(grip(threaded, upright, along, BEYOND_M)[None], closed=True, speed=0.10, error=0.0025, pause=0.2),
        Stroke(end[None], closed=False, speed=0.06, error=0.0015, pause=0.4),
        Stroke(back(end, DRAW_BACK_M)[None], closed=False, speed=0.10, error=0.003, pause=0.4),
    ]


SPEC = TaskSpec(
    name="aloha-hang",
    description="hang the clothes hanger on the rod",
    goal="the hanger hangs on the rod",
    expert=hang,
)
