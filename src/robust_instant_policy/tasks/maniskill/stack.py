"""Stack a cube on another one of any size."""

import numpy as np
import sapien
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.actor import Actor

from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.maniskill.block import Block, apart, corners, is_still, scattered
from robust_instant_policy.tasks.maniskill.camera import matrix
from robust_instant_policy.tasks.maniskill.cell import CellEnv
from robust_instant_policy.tasks.maniskill.paint import BLACK, BRASS, RED, WHITE, Paint
from robust_instant_policy.tasks.picking import Pick, set_down
from robust_instant_policy.tasks.poses import facing
from robust_instant_policy.tasks.simulated_task import TaskSpec

TABLE_M = np.array([[-0.12, -0.22], [0.2, 0.22]])  # corners of the area in which the cubes lie
APART_M = 0.13
YAW_RANGE_RAD = np.deg2rad(30)

EDGE_M = 0.036  # of the cube that is stacked
BASE_EDGES_M = (0.04, 0.075)  # of the one below
GREEN, BLUE = Paint((0.15, 0.45, 0.2)), Paint((0.1, 0.2, 0.62))
PAINTS = {"seen": (BLUE, RED, WHITE), "unseen": (GREEN, BRASS, BLACK)}  # of the cube, of the base, and of the marks

OFFSET_SHARE = 0.5  # of half the cube's edge: how far its middle may lie from the base's
HEIGHT_TOLERANCE_M = 5e-3
GRASP_M, RELEASE_M = 0.016, 0.003  # fingertips over the foot of the cube, and the foot over the base
PICK = Pick(above=0.12, grasp=GRASP_M, lift=0.16, reach_speed=0.35, down_speed=0.14, lift_speed=0.16, error=0.005)


@register_env("RIP-Stack-v1", max_episode_steps=600)
class StackEnv(CellEnv):
    """Success: the cube rests on the base, released."""

    cube: Actor
    base: Actor
    base_edge: float

    def build_objects(self) -> None:
        self.base_edge = float(self.draw("shape").uniform(*BASE_EDGES_M))
        paint, base_paint, mark = PAINTS[self.objects]
        self.cube = Block((EDGE_M,) * 3, paint, (mark,)).build(self.scene, "cube")
        self.base = Block((self.base_edge,) * 3, base_paint, (mark,)).build(self.scene, "base")

    def place_objects(self) -> None:
        rng = self.draw("pose")
        places = scattered(rng, TABLE_M, 2, lambda places: apart(places) >= APART_M)
        for actor, edge, (x, y) in zip((self.cube, self.base), (EDGE_M, self.base_edge), places, strict=True):
            pose = facing(x, y, rng.uniform(-YAW_RANGE_RAD, YAW_RANGE_RAD))
            actor.set_pose(sapien.Pose(self.layout.place(pose, [(0.0, 0.0)], corners(edge, edge))))

    def failure(self) -> str:
        if self.agent.is_grasping(self.cube):
            return "the cube is still in the fingers"
        x, y, z = (matrix(self.cube.pose) - matrix(self.base.pose))[:3, 3]
        offset = float(np.hypot(x, y))
        if abs(z - self.base_edge) > HEIGHT_TOLERANCE_M:
            return f"the cube's foot is {1e3 * z:.0f} mm above the base's, {1e3 * self.base_edge:.0f} mm wanted"
        if offset > (self.base_edge + OFFSET_SHARE * EDGE_M) / 2:
            return f"the cube's middle is {1e3 * offset:.0f} mm beside the base's"
        return "" if is_still(self.cube) else "the cube is on the base but still moving"


def stack(env: StackEnv, rng: np.random.Generator) -> list[Stroke]:
    """Grasp the cube, carry it over the base, set it down turned like the base, and let go."""
    target = matrix(env.base.pose)
    target[2, 3] += env.base_edge + RELEASE_M
    return [*PICK.strokes(matrix(env.cube.pose), rng), *set_down(target, PICK)]


SPEC = TaskSpec(
    name="stack",
    description="stack the cube on the other one",
    goal="the cube is on the other one",
    expert=stack,
    object_sets=("seen", "unseen"),
)
