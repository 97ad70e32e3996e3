"""Grasp a lying cup and stand it upright."""

import mujoco
import numpy as np

from robust_instant_policy.tasks.aloha.cell import AlohaEnv
from robust_instant_policy.tasks.aloha.cup import Cup
from robust_instant_policy.tasks.aloha.tool_poses import back, bearing, grip, over
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.poses import facing
from robust_instant_policy.tasks.simulated_task import TaskSpec

X_RANGE_M, Y_RANGE_M = (-0.14, -0.02), (-0.13, 0.13)
YAW_RANGE_RAD = np.deg2rad(30)
TURN_RAD = np.deg2rad(30)  # more at the hard level: a cup that points to the arm cannot be lifted by its rotation
BODY_M = ((-0.06, -0.05), (-0.06, 0.05), (0.16, -0.05), (0.16, 0.05))  # the cup, lying and standing

UPRIGHT_RAD = np.deg2rad(8)

PITCH_RAD = np.deg2rad(-15)  # of the descending gripper: rotated by 90 degrees it still clears the table
HOLD_SHARE = 0.5  # of the cup's height
BEYOND_M = 0.012  # fingertips past the cup's axis
APPROACH_M = 0.08
FORWARD_M = 0.09  # from where the cup's middle lay to where it stands
LIFT_M = 0.05
TURN_FIRST_RAD = np.deg2rad(20)  # rotation of the gripper during the lift
OVER_M = 0.02  # of the cup's foot over the table before it is set down
SET_DOWN_M = 0.003  # of its foot over the table at release


class CupUprightEnv(AlohaEnv):
    """Success: the cup stands on the table on its foot, released and at rest."""

    cup: Cup

    def build(self, spec: mujoco.MjSpec) -> None:
        self.cup = Cup.draw(self.draw("shape"))
        rng = self.draw("pose")
        yaw = rng.uniform(-YAW_RANGE_RAD, YAW_RANGE_RAD)
        pose = facing(rng.uniform(*X_RANGE_M), rng.uniform(*Y_RANGE_M), yaw)
        pose = self.layout.place(pose, [(0.0, 0.0), (FORWARD_M, 0.0)], BODY_M, TURN_RAD)
        self.cup.build(spec, "cup", pose @ self.cup.lying())

    def failure(self) -> str:
        lean = float(np.arccos(np.clip(self.pose_of("cup")[2, 2], -1, 1)))
        if self.is_held("cup"):
            return "the cup is still in the fingers"
        if lean >= UPRIGHT_RAD:
            return f"the cup leans by {np.rad2deg(lean):.0f} degrees"
        at_rest = self.touch("cup", "world") > 0 and self.is_still("cup")
        return "" if at_rest else "the cup is upright but not at rest on the table"


def stand_up(env: CupUprightEnv, rng: np.random.Generator) -> list[Stroke]:
    """Grasp the cup across its middle, rotate it upright while moving, set it down, release and retreat."""
    lying = env.pose_of("cup")
    axis = lying[:3, 2]
    yaw, rise = float(np.arctan2(axis[1], axis[0])), float(np.arcsin(axis[2]))
    middle = lying[:3, 3] + HOLD_SHARE * env.cup.height * axis
    hold = grip(middle, PITCH_RAD, yaw, BEYOND_M)
    lifted = grip(over(middle, LIFT_M), PITCH_RAD + TURN_FIRST_RAD, bearing(middle), BEYOND_M)
    upright = PITCH_RAD + np.pi / 2 - rise
    stand = middle + FORWARD_M * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    stand[2] = SET_DOWN_M + HOLD_SHARE * env.cup.height
    above = grip(over(stand, OVER_M), upright, bearing(stand), BEYOND_M)
    end = grip(stand, upright, bearing(stand), BEYOND_M)
    return [
        Stroke(back(hold, APPROACH_M)[None], closed=False, free=True, speed=0.20, error=0.003),
        Stroke(hold[None], closed=True, speed=0.08, error=0.0015),
        Stroke(np.array([lifted, above]), closed=True, speed=0.14, error=0.003, pause=0.2),
        Stroke(end[None], closed=False, speed=0.05, error=0.001, pause=0.3),
        Stroke(back(end, APPROACH_M)[None], closed=False, speed=0.10, error=0.002),
    ]


SPEC = TaskSpec(
    name="aloha-cup-upright",
    description="stand the lying cup upright",
    goal="the cup stands upright on the table",
    expert=stand_up,
)
