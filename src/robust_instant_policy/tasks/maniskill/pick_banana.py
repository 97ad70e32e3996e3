"""Pick a banana from the table and hold it up."""

from functools import lru_cache
from typing import Any

import numpy as np
import sapien
import sapien.physx
import sapien.render
from mani_skill.utils.building import actors
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.actor import Actor
from scipy.spatial.transform import Rotation

from robust_instant_policy.geometry import FloatArray, invert_pose
from robust_instant_policy.tasks.banana import Banana
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.maniskill import partnet
from robust_instant_policy.tasks.maniskill.camera import matrix
from robust_instant_policy.tasks.maniskill.cell import CellEnv
from robust_instant_policy.tasks.maniskill.paint import texture
from robust_instant_policy.tasks.picking import Pick, failure_of_pick
from robust_instant_policy.tasks.poses import facing
from robust_instant_policy.tasks.simulated_task import TaskSpec

X_RANGE_M, Y_RANGE_M = (-0.08, 0.16), (-0.15, 0.15)
YAW_RANGE_RAD = np.deg2rad(30)
HALF_LENGTH_M = 0.09  # of the longest banana
DENSITY = 650.0  # kg/m³: its capsules overlap
SKIN_FRICTION = 0.8

LIFTED_M = 0.05

PICK = Pick(above=0.12, grasp=0.007, lift=0.16, reach_speed=0.35, down_speed=0.14, lift_speed=0.16, error=0.005)

_skin = lru_cache(maxsize=4)(Banana.skin)  # each execution builds the scene again


@register_env("RIP-PickBanana-v1", max_episode_steps=600)
class PickBananaEnv(CellEnv):
    """Success: the banana is off the table between both fingers, and the arm is still."""

    banana: Actor
    lie: FloatArray  # the frame of `Banana` in the actor's frame
    rest_height: float  # of the banana's middle over the table

    def build_objects(self) -> None:
        if self.assets == "maniskill":
            partnet.require_banana()
            builder = actors.get_actor_builder(self.scene, id=f"ycb:{partnet.YCB_BANANA}")
            builder.initial_pose = sapien.Pose([0, 0, 0.1])
            self.banana = builder.build(name="banana")
            mesh = self.banana.get_first_collision_mesh(to_world_frame=False)
            self.lie = partnet.banana_frame(mesh)
            self.rest_height = float(self.lie[2, 3] - mesh.bounds[0, 2])
        else:
            shape = Banana.draw(self.draw("shape"))
            self.banana = _build(shape, self.scene)
            self.lie, self.rest_height = np.eye(4), shape.radius

    def place_objects(self) -> None:
        rng = self.draw("pose")
        pose = facing(rng.uniform(*X_RANGE_M), rng.uniform(*Y_RANGE_M), rng.uniform(-YAW_RANGE_RAD, YAW_RANGE_RAD))
        pose = self.layout.place(pose, [(-HALF_LENGTH_M, 0.0), (HALF_LENGTH_M, 0.0)])
        pose[2, 3] = self.rest_height
        self.banana.set_pose(sapien.Pose(pose @ invert_pose(self.lie)))

    def middle(self) -> FloatArray:
        """The banana's frame ``(4, 4)`` in the world: its middle, x along the fruit."""
        return matrix(self.banana.pose) @ self.lie

    def failure(self) -> str:
        lifted = bool(self.middle()[2, 3] > self.rest_height + LIFTED_M)
        return failure_of_pick("banana", lifted, bool(self.agent.is_grasping(self.banana)), self.arm_is_still())


def _build(shape: Banana, scene: Any) -> Actor:
    builder = scene.create_actor_builder()
    friction = sapien.physx.PhysxMaterial(SKIN_FRICTION, SKIN_FRICTION, 0.0)
    for start, stop, radius in shape.capsules():
        turn = Rotation.align_vectors((stop - start)[None], [[1.0, 0.0, 0.0]])[0].as_quat()[[3, 0, 1, 2]]
        half_length = float(np.linalg.norm(stop - start)) / 2
        pose = sapien.Pose((start + stop) / 2, turn)
        builder.add_capsule_collision(pose, radius, half_length, material=friction, density=DENSITY)
    skin = sapien.render.RenderMaterial()
    skin.base_color, skin.roughness, skin.specular = [1.0, 1.0, 1.0, 1.0], 0.55, 0.3
    skin.base_color_texture = texture(_skin(shape))
    builder._procedural_shapes.append(sapien.render.RenderShapeTriangleMesh(*shape.mesh(), skin))
    builder.initial_pose = sapien.Pose([0, 0, shape.radius])
    return builder.build(name="banana")


def pick(env: PickBananaEnv, rng: np.random.Generator) -> list[Stroke]:
    """Across the middle of the fruit."""
    return PICK.strokes(env.middle(), rng)


SPEC = TaskSpec(
    name="pick-banana",
    description="pick the banana from the table",
    goal="the banana is held above the table",
    expert=pick,
    asset_sources=("code", "maniskill"),
)
