"""Turn a faucet on by its lever."""

import numpy as np
from mani_skill.utils.registration import register_env

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.maniskill import partnet
from robust_instant_policy.tasks.maniskill.cell import CellEnv
from robust_instant_policy.tasks.maniskill.faucet import Faucet
from robust_instant_policy.tasks.maniskill.mechanism import Lever, Mechanism
from robust_instant_policy.tasks.object_sets import draw_object
from robust_instant_policy.tasks.poses import downward, facing
from robust_instant_policy.tasks.simulated_task import TaskSpec

X_RANGE_M, Y_RANGE_M = (-0.02, 0.16), (-0.14, 0.10)
YAW_RANGE_RAD = np.deg2rad(30)
REACH_M = ((-0.06, 0.0), (0.0, 0.12), (0.12, 0.0), (0.0, -0.06))  # where the longest lever is pushed to and from

TARGET_SHARE = 0.9  # of the lever's range, as in ManiSkill's TurnFaucet

FINGER_RADIUS_M = 0.013  # of the closed fingers
PUSH_SHARE = 0.75  # of the lever's length, from its axis
APPROACH_M = 0.035
FINGERS_BELOW_M = 0.02  # fingertips under the lever's middle
ABOVE_M = 0.07
PUSH_FURTHER_RAD = 0.04  # the demonstrator turns to the stop
ARC_POINTS = 7


@register_env("RIP-TurnFaucet-v1", max_episode_steps=600)
class TurnFaucetEnv(CellEnv):
    """Success: the lever is past `TARGET_SHARE` of its range."""

    lever: Lever
    faucet: Mechanism

    def build_objects(self) -> None:
        rng = self.draw("shape")
        if self.assets == "maniskill":
            self.faucet, self.lever = partnet.load_faucet(self.scene, self.objects, rng)
        else:
            shape = draw_object({"seen": Faucet.draw_seen, "unseen": Faucet.draw_unseen}, self.objects, rng)
            self.faucet, self.lever = shape.build(self.scene), shape.lever_geometry

    def place_objects(self) -> None:
        rng = self.draw("pose")
        pose = facing(rng.uniform(*X_RANGE_M), rng.uniform(*Y_RANGE_M), rng.uniform(-YAW_RANGE_RAD, YAW_RANGE_RAD))
        self.foot_pose = self.layout.place(pose, REACH_M, [(-0.13, 0.0)])
        self.faucet.place(self.foot_pose, 0.0)

    def failure(self) -> str:
        share = float(self.faucet.position / self.lever.turn)
        if share > TARGET_SHARE:
            return ""
        return f"the lever is turned by {max(share, 0.0):.0%} of its range, {TARGET_SHARE:.0%} wanted"


def turn(env: TurnFaucetEnv, rng: np.random.Generator) -> list[Stroke]:
    """Close the gripper, descend behind the lever, and push it to its stop."""
    lever, height = env.lever, env.lever.height - FINGERS_BELOW_M
    radius = lever.length * PUSH_SHARE * rng.uniform(0.95, 1.05)

    def at(turned: float, away: float, z: float) -> FloatArray:
        """Fingers ``away`` m behind a lever ``turned`` rad, ``radius`` from its axis."""
        angle = lever.start + lever.sign * turned
        along = np.array([np.cos(angle), np.sin(angle)])
        behind = lever.sign * np.array([np.sin(angle), -np.cos(angle)])
        x, y = lever.pivot + radius * along + (lever.half_width + FINGER_RADIUS_M + away) * behind
        return env.foot_pose @ downward(x, y, z)

    end = lever.turn + PUSH_FURTHER_RAD
    arc = np.array([at(turned, 0.0, height) for turned in np.linspace(0.0, end, ARC_POINTS)])
    return [
        Stroke(np.array([at(0.0, APPROACH_M, height + ABOVE_M)]), closed=True, free=True, speed=0.35, error=0.005),
        Stroke(np.array([at(0.0, APPROACH_M, height)]), closed=True, speed=0.15, error=0.003),
        Stroke(arc, closed=True, speed=0.13),
        Stroke(np.array([at(end, APPROACH_M, height + 0.03)]), closed=True, free=True, error=0.005),
    ]


SPEC = TaskSpec(
    name="turn-faucet",
    description="turn the faucet's lever",
    goal="the faucet is turned on",
    expert=turn,
    object_sets=("seen", "unseen"),
    asset_sources=("code", "maniskill"),
)
