"""Pull a drawer of a small chest open by its handle."""

import numpy as np
from mani_skill.utils.registration import register_env

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.maniskill import partnet
from robust_instant_policy.tasks.maniskill.cell import CellEnv
from robust_instant_policy.tasks.maniskill.chest import Chest
from robust_instant_policy.tasks.maniskill.mechanism import Drawer, Mechanism
from robust_instant_policy.tasks.poses import downward, facing
from robust_instant_policy.tasks.simulated_task import TaskSpec

X_RANGE_M, Y_RANGE_M = (0.06, 0.14), (-0.13, 0.13)  # of the middle of the chest's front
YAW_RANGE_RAD = np.deg2rad(20)
BODY_M = ((0.0, -0.12), (0.0, 0.12), (0.20, -0.12), (0.20, 0.12))  # corners of the largest chest

OPEN_SHARE = 0.9
STILL_M_S, STILL_RAD_S = 0.1, 1.0  # as in ManiSkill's OpenCabinetDrawer

ABOVE_M = 0.09
FINGERS_BELOW_M = 0.010  # fingertips under the middle of the handle
PULL_FURTHER_M = 0.004  # the demonstrator pulls to the stop


@register_env("RIP-OpenDrawer-v1", max_episode_steps=600)
class OpenDrawerEnv(CellEnv):
    """Success: the drawer is open by `OPEN_SHARE` of its travel and rests."""

    drawer: Drawer
    chest: Mechanism

    def build_objects(self) -> None:
        if self.assets == "maniskill":
            self.chest, self.drawer = partnet.load_chest(self.scene, self.draw("shape"))
        else:
            shape = Chest.draw(self.draw("shape"))
            self.chest, self.drawer = shape.build(self.scene), shape.drawer

    def place_objects(self) -> None:
        rng = self.draw("pose")
        pose = facing(rng.uniform(*X_RANGE_M), rng.uniform(*Y_RANGE_M), rng.uniform(-YAW_RANGE_RAD, YAW_RANGE_RAD))
        out = self.drawer.handle[0] - self.drawer.travel
        self.front_pose = self.layout.place(pose, [(out, 0.0), (0.0, 0.0)], BODY_M)
        self.chest.place(self.front_pose, 0.0)

    def failure(self) -> str:
        share = float(self.chest.position / self.drawer.travel)
        if share < OPEN_SHARE:
            return f"the drawer is {max(share, 0.0):.0%} open, {OPEN_SHARE:.0%} wanted"
        return "" if self.chest.is_still(STILL_M_S, STILL_RAD_S) else "the drawer is open but still moving"


def pull(env: OpenDrawerEnv, rng: np.random.Generator) -> list[Stroke]:
    """Descend with one finger on either side of the handle, close, pull straight out."""
    x, y, z = env.drawer.handle - (rng.uniform(-0.002, 0.002), 0.0, FINGERS_BELOW_M)

    def at(out: float, up: float) -> FloatArray:
        return env.front_pose @ downward(x - out, y, z + up)

    return [
        Stroke(np.array([at(0.0, ABOVE_M)]), closed=False, free=True, speed=0.35, error=0.005),
        Stroke(np.array([at(0.0, 0.0)]), closed=True, speed=0.14, error=0.0015),
        Stroke(np.array([at(env.drawer.travel + PULL_FURTHER_M, 0.0)]), closed=True, speed=0.12),
    ]


SPEC = TaskSpec(
    name="open-drawer",
    description="pull the drawer open by its handle",
    goal="the drawer is open",
    expert=pull,
    asset_sources=("code", "maniskill"),
)
