"""Pick a banana from the table and hold it up."""

import mujoco
import numpy as np

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.aloha.cell import AlohaEnv
from robust_instant_policy.tasks.aloha.surfaces import Surface, add_bar, add_surface, free_body
from robust_instant_policy.tasks.banana import Banana
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.picking import Pick, failure_of_pick
from robust_instant_policy.tasks.poses import facing
from robust_instant_policy.tasks.simulated_task import TaskSpec

X_RANGE_M, Y_RANGE_M = (-0.22, 0.04), (-0.20, 0.20)
YAW_RANGE_RAD = np.deg2rad(40)
HALF_LENGTH_M = 0.09  # of the longest banana
MASS_KG = 0.12
SKIN_FRICTION = 0.8

LIFTED_M = 0.05

PICK = Pick(above=0.10, grasp=0.004, lift=0.15, reach_speed=0.20, down_speed=0.08, lift_speed=0.10, error=0.004)


class PickBananaEnv(AlohaEnv):
    """Success: the banana is off the table between both fingers, and the arm is still."""

    shape: Banana

    def build(self, spec: mujoco.MjSpec) -> None:
        self.shape = Banana.draw(self.draw("shape"))
        rng = self.draw("pose")
        pose = facing(rng.uniform(*X_RANGE_M), rng.uniform(*Y_RANGE_M), rng.uniform(-YAW_RANGE_RAD, YAW_RANGE_RAD))
        pose = self.layout.place(pose, [(-HALF_LENGTH_M, 0.0), (HALF_LENGTH_M, 0.0)])
        pose[2, 3] = self.shape.radius
        body = free_body(spec, "banana", pose)
        vertices, faces, _, uvs = self.shape.mesh()
        add_surface(spec, body, "banana", Surface(vertices, faces, uvs), self.shape.skin(), shine=0.3)
        capsules = self.shape.capsules()
        volumes = np.array([radius**2 * np.linalg.norm(stop - start) for start, stop, radius in capsules])
        for (start, stop, radius), mass in zip(capsules, MASS_KG * volumes / volumes.sum(), strict=True):
            add_bar(body, start, stop, radius, mass=float(mass), friction=SKIN_FRICTION)

    def middle(self) -> FloatArray:
        """The banana's frame ``(4, 4)`` in the world: its middle, x along the fruit."""
        return self.pose_of("banana")

    def failure(self) -> str:
        lifted = bool(self.middle()[2, 3] > self.shape.radius + LIFTED_M)
        return failure_of_pick("banana", lifted, self.is_held("banana"), self.arm_is_still())


def pick(env: PickBananaEnv, rng: np.random.Generator) -> list[Stroke]:
    """Across the middle of the fruit."""
    return PICK.strokes(env.middle(), rng)


SPEC = TaskSpec(
    name="aloha-pick-banana",
    description="pick the banana from the table",
    goal="the banana is held above the table",
    expert=pick,
)
