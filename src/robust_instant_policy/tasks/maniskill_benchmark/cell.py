"""An environment of ManiSkill, unchanged, as `simulated_task.Cell`, with an RGB-D camera of ours."""

import logging
from dataclasses import dataclass
from typing import Any

import gymnasium
import mani_skill
import mani_skill.envs  # registers the environments
import numpy as np
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils import sapien_utils
from sapien.render import RenderBodyComponent

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.maniskill.camera import matrix, photograph, scene_truth
from robust_instant_policy.tasks.maniskill_benchmark.robot import FINGER_TRAVEL_M, NUM_JOINTS
from robust_instant_policy.tasks.scene_truth import SceneTruth

SENSOR = "base_camera"  # as all these environments call it
PIXELS = 256

mani_skill.logger.setLevel(logging.ERROR)  # the environments warn of their own code at every reset


@dataclass(frozen=True)
class View:
    """A camera at ``eye`` that looks at ``target``, world frame, metres, and shows ``width`` metres there."""

    eye: tuple[float, float, float] = (0.45, 0.0, 1.15)
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    width: float = 0.8

    def config(self) -> dict[str, Any]:
        """As ManiSkill's cameras are configured."""
        distance = float(np.linalg.norm(np.subtract(self.eye, self.target)))
        pose = sapien_utils.look_at(self.eye, self.target).sp
        fov = 2 * np.arctan2(self.width / 2, distance)
        return {"pose": pose, "width": PIXELS, "height": PIXELS, "fov": fov, "near": 0.05, "far": 5.0}


class PandaCell:
    """The environment ``env_id``, in its own robot's control mode ``pd_joint_pos``.

    The arm is hidden from the camera, as if it stood out of its sight, and goals are shown that are only drawn for
    people. Success is decided by the environment's ``evaluate``. As in ManiSkill, where the first success ends the
    episode, it counts whenever it occurs.
    """

    def __init__(self, env_id: str, view: View):
        # With a new scene at every reset, the same seed gives the same episode, as in `maniskill.cell`.
        self.env: BaseEnv = gymnasium.make(
            env_id,
            obs_mode="none",
            reward_mode="none",
            control_mode="pd_joint_pos",
            sim_backend="physx_cpu",
            render_backend="cpu",
            sensor_configs={SENSOR: view.config()},
            reconfiguration_freq=1,
        ).unwrapped
        self._failure = ""

    @property
    def base(self) -> FloatArray:
        """Pose ``(4, 4)`` of the arm's base."""
        return matrix(self.env.agent.robot.pose)

    def reset(self, *, seed: int) -> None:
        self.env.reset(seed=seed)
        self._failure = "nothing was done"

    def photograph(self) -> Observation:
        self._stage(for_camera=True)
        return photograph(self.env, SENSOR)

    def scene_truth(self) -> SceneTruth:
        self._stage(for_camera=True)
        return scene_truth(self.env, SENSOR)

    def video_frame(self) -> np.ndarray:
        """RGB frame ``(H, W, 3)`` uint8 of the environment's own camera for videos."""
        self._stage(for_camera=False)
        return self.env.render_rgb_array()[0].cpu().numpy().astype(np.uint8)

    def home(self, usual: FloatArray) -> FloatArray:
        """The start pose ``(1, J)`` that the environment drew."""
        return self.env.agent.robot.get_qpos()[:, :NUM_JOINTS].cpu().numpy().astype(np.float64)

    def measured(self) -> FloatArray:
        """Joint angles and finger travel, ``(8,)``."""
        return self.env.agent.robot.get_qpos()[0, : NUM_JOINTS + 1].cpu().numpy().astype(np.float64)

    def grip_loads(self) -> FloatArray:
        """Force of the gripper as a share of its limit, ``(1,)``, from the deflection of its drive."""
        agent = self.env.agent
        target = float(agent.controller.controllers["gripper"]._target_qpos[0, 0])
        force = agent.gripper_stiffness * (self.measured()[-1] - target)
        return np.array([min(abs(force) / agent.gripper_force_limit, 1.0)])

    def tool_poses(self) -> FloatArray:
        return matrix(self.env.agent.tcp.pose)[None]

    def advance(self, command: FloatArray) -> None:
        gripper = 2 * command[-1] / FINGER_TRAVEL_M - 1  # of the controller: 1 open, -1 closed
        self.env._step_action(np.append(command[:-1], gripper).astype(np.float32))
        if self._failure:
            self._failure = self._judged()

    def failure(self) -> str:
        return self._failure

    def close(self) -> None:
        self.env.close()

    def _judged(self) -> str:
        """Reason why the task is not done now, from what the environment evaluates."""
        told = {name: np.asarray(value).ravel() for name, value in self.env.evaluate().items()}
        if told.pop("success").all():
            return ""
        missing = [name for name, value in told.items() if value.dtype == bool and not value.all()]
        return f"no success by {self.env.spec.id}'s own rule" + (f" (not {', '.join(missing)})" if missing else "")

    def _stage(self, for_camera: bool) -> None:
        """Show the goals; hide the arm ``for_camera``, else show it."""
        for goal in self.env._hidden_objects:
            goal.show_visual()
        for link in self.env.agent.robot.links:
            body = link._objs[0].entity.find_component_by_type(RenderBodyComponent)
            if body is not None:
                body.visibility = 0.0 if for_camera else 1.0
