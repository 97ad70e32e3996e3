"""Push a cube into a goal disc: the scene and rules of ManiSkill's PushCube-v1, with the UR5e."""

import numpy as np
import sapien
import torch
from mani_skill.utils.building import actors
from mani_skill.utils.registration import register_env
from scipy.spatial.transform import Rotation

from robust_instant_policy.geometry import FloatArray, make_pose
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.maniskill.cell import CellEnv
from robust_instant_policy.tasks.poses import downward, facing
from robust_instant_policy.tasks.simulated_task import TaskSpec

CUBE_HALF_SIZE_M = 0.02
CUBE_RANGE_M = 0.1  # the cube's x and y lie within ± this
CUBE_COLORS = {"seen": (12 / 255, 42 / 255, 160 / 255, 1.0), "unseen": (0.05, 0.35, 0.12, 1.0)}
GOAL_RADIUS_M = 0.1
GOAL_DISTANCE_M = 0.1 + GOAL_RADIUS_M  # from the cube, along +x
HEIGHT_TOLERANCE_M = 5e-3

FINGER_HALF_WIDTH_M = 0.011
BEHIND_M = -CUBE_HALF_SIZE_M - FINGER_HALF_WIDTH_M  # fingers that touch the cube, from its middle
APPROACH_M = 0.05  # between fingers and cube while the gripper descends
CLEARANCE_M = 0.1  # travel height of the gripper
PUSH_HEIGHT_M = 0.015
OVERSHOOT_M = 0.02  # the demonstrator stops within ± this of the middle of the goal


@register_env("RIP-PushCube-v1", max_episode_steps=600)
class PushCubeEnv(CellEnv):
    """Success: the cube's centre within the goal disc, the cube still on the table.

    ``push_pose (4, 4)`` is the frame on the table under the cube, x towards the goal, ``distance`` metres away.
    """

    push_pose: FloatArray
    distance: float

    def build_objects(self) -> None:
        self.cube = actors.build_cube(
            self.scene,
            half_size=CUBE_HALF_SIZE_M,
            color=np.array(CUBE_COLORS[self.objects]),
            name="cube",
            initial_pose=sapien.Pose(p=[0, 0, CUBE_HALF_SIZE_M]),
        )
        self.goal = actors.build_red_white_target(
            self.scene,
            radius=GOAL_RADIUS_M,
            thickness=1e-5,
            name="goal",
            add_collision=False,
            body_type="kinematic",
            initial_pose=sapien.Pose(p=[GOAL_DISTANCE_M, 0, 1e-3]),
        )

    def place_objects(self) -> None:
        pose, self.distance, turn = self.draw_push(self.draw("pose"))
        self.push_pose = self.layout.place(pose, [(BEHIND_M - APPROACH_M, 0.0), (self.distance, 0.0)])
        cube = facing(0.0, 0.0, turn) @ make_pose(np.eye(3), (0.0, 0.0, CUBE_HALF_SIZE_M))
        self.cube.set_pose(sapien.Pose(self.push_pose @ cube))
        on_its_face = Rotation.from_euler("y", 90, degrees=True).as_matrix()  # the disc's axis is its x axis
        self.goal.set_pose(sapien.Pose(self.push_pose @ make_pose(on_its_face, (self.distance, 0.0, 1e-3))))

    def draw_push(self, rng: np.random.Generator) -> tuple[FloatArray, float, float]:
        """The pose and the distance of the push, and how far the cube is turned in it, rad."""
        x, y = rng.uniform(-CUBE_RANGE_M, CUBE_RANGE_M, 2)
        return facing(x, y, 0.0), GOAL_DISTANCE_M, 0.0

    def failure(self) -> str:
        cube, goal = self.cube.pose.p[0], self.goal.pose.p[0]
        if cube[2] >= CUBE_HALF_SIZE_M + HEIGHT_TOLERANCE_M:
            return "the cube left the table top"
        distance = float(torch.linalg.norm(cube[:2] - goal[:2]))
        if distance >= GOAL_RADIUS_M:
            allowed = f"{1e3 * GOAL_RADIUS_M:.0f} mm allowed"
            return f"the cube stopped {1e3 * distance:.0f} mm from the goal's centre, {allowed}"
        return ""


def push(env: PushCubeEnv, rng: np.random.Generator) -> list[Stroke]:
    """Close the gripper, descend behind the cube, push it straight into the goal, and retreat."""
    behind = BEHIND_M - APPROACH_M
    end = BEHIND_M + env.distance + rng.uniform(-OVERSHOOT_M, OVERSHOOT_M)

    cube = env.push_pose.copy()
    cube[:2, 3] = env.cube.pose.p[0, :2].tolist()  # in the simulator's precision

    def at(along: float, z: float) -> FloatArray:
        return (cube @ downward(along, 0.0, z))[None]

    return [
        Stroke(at(behind, CLEARANCE_M), closed=True, free=True, speed=0.35, error=0.004),
        Stroke(at(behind, PUSH_HEIGHT_M), closed=True, speed=0.15),
        Stroke(at(end, PUSH_HEIGHT_M), closed=True, speed=0.18),
        Stroke(at(end - APPROACH_M, CLEARANCE_M), closed=True, free=True, error=0.006),
    ]


SPEC = TaskSpec(
    name="push-cube",
    description="push the cube into the goal disc",
    goal="the cube is in the goal disc",
    expert=push,
)
