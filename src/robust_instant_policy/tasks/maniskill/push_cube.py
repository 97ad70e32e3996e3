"""Push a cube into a goal disc: the scene and rules of ManiSkill's PushCube-v1, with the UR5e."""

from __future__ import annotations

import numpy as np
import sapien
import torch
from mani_skill.utils.building import actors
from mani_skill.utils.registration import register_env

from robust_instant_policy.geometry import FloatArray
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
APPROACH_M = 0.05  # between fingers and cube while the gripper descends
CLEARANCE_M = 0.1  # travel height of the gripper
PUSH_HEIGHT_M = 0.015
OVERSHOOT_M = 0.02  # the demonstrator stops within ± this of the middle of the goal


@register_env("RIP-PushCube-v1", max_episode_steps=600)
class PushCubeEnv(CellEnv):
    """Success: the cube's centre within the goal disc, the cube still on the table."""

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
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

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        (x, y), goal = self.draw_places(self.draw("pose"))
        self.cube.set_pose(sapien.Pose([x, y, CUBE_HALF_SIZE_M]))
        flat = [np.sqrt(0.5), 0, np.sqrt(0.5), 0]  # the disc's axis is its x axis
        self.goal.set_pose(sapien.Pose([*goal, 1e-3], flat))

    def draw_places(self, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Where cube and goal are: x and y ``(2,)`` of each, metres."""
        cube = rng.uniform(-CUBE_RANGE_M, CUBE_RANGE_M, 2)
        return cube, cube + np.array([GOAL_DISTANCE_M, 0.0])

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
    cube, goal = (actor.pose.p[0, :2].cpu().numpy().astype(np.float64) for actor in (env.cube, env.goal))
    distance = float(np.linalg.norm(goal - cube))
    x, y = (goal - cube) / distance
    line = facing(*cube, float(np.arctan2(y, x)))  # x from the cube to the goal
    contact = -CUBE_HALF_SIZE_M - FINGER_HALF_WIDTH_M
    behind, end = contact - APPROACH_M, contact + distance + rng.uniform(-OVERSHOOT_M, OVERSHOOT_M)

    def at(along: float, z: float) -> FloatArray:
        return (line @ downward(along, 0.0, z))[None]

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
    env_id="RIP-PushCube-v1",
    expert=push,
)
