"""The cell of all ManiSkill tasks: table, arm, top-view RGB-D camera, and a camera for videos.

The world's origin is on the table top, x away from the robot, z up. The image's top points along +x.
"""

from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils
from mani_skill.utils.scene_builder.table import TableSceneBuilder
from mani_skill.utils.structs.types import SimConfig

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, make_pose
from robust_instant_policy.tasks.level import PAPER, Distractor, Layout, Level, Region
from robust_instant_policy.tasks.maniskill.camera import photograph, scene_truth
from robust_instant_policy.tasks.maniskill.carpentry import add_box, add_cylinder
from robust_instant_policy.tasks.maniskill.paint import BLACK, Paint
from robust_instant_policy.tasks.maniskill.robot import FINGER_STIFFNESS, FINGER_TRAVEL_M, GRIP_FORCE_N, UR5eHandE
from robust_instant_policy.tasks.scene_truth import SceneTruth

RECORD_HZ = 55.0  # "recorded at 55 Hz" (Oh et al. 2025, Sec. V-A.1)
SIM_HZ = 220

BASE_POSITION_M = (-0.5, 0.0, 0.0)
HOME_JOINTS = (0.9, -1.9, 2.2, -1.87, -1.5708, -0.67)  # beside the table top, outside the camera's view

CAMERA_POSITION_M = (0.06, 0.0, 1.3)
CAMERA_VIEW_M = 0.8  # side of the square of the table top in the image
CAMERA_PIXELS = 256
VIDEO_WIDTH, VIDEO_HEIGHT = 480, 360

STILL_RAD_S = 0.2  # joint speed below which an arm is at rest, as in ManiSkill's tasks

WORKSPACE = np.array([[-0.34, -0.4, -0.005], [0.46, 0.4, 0.4]])
REGION = Region(BASE_POSITION_M[:2], nearest=0.27, farthest=0.74, view=((-0.29, -0.35), (0.41, 0.35)))
LAMPS = (([-0.45, 0.55, -1.0], [1.2, 1.2, 1.15]), ([0.5, -0.5, -1.0], [0.5, 0.5, 0.55]))  # direction, colour
AMBIENT = 0.42
MAT_M = 0.0005  # height of the cover that gives the table another colour


class CellEnv(BaseEnv):
    """Base of the environments; a subclass adds its objects and its condition of success."""

    SUPPORTED_ROBOTS = ("ur5e_hande",)
    SUPPORTED_REWARD_MODES = ("sparse", "none")
    agent: UR5eHandE

    def __init__(
        self,
        *args: Any,
        robot_uids: str = "ur5e_hande",
        render_backend: str = "cpu",
        objects: str = "seen",
        assets: str = "code",
        level: Level = PAPER,
        **kwargs: Any,
    ):
        """``objects``, ``assets`` and ``level`` as in `tasks.make_task`; everything else as in ManiSkill's
        environments."""
        self.objects, self.assets, self.level = objects, assets, level
        # A used physics scene orders its contacts differently from a new one, which changes results by millimetres.
        # With a new scene at every reset, the same seed gives the same episode.
        kwargs.setdefault("reconfiguration_freq", 1)
        super().__init__(*args, robot_uids=robot_uids, render_backend=render_backend, **kwargs)

    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(sim_freq=SIM_HZ, control_freq=int(RECORD_HZ))

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        down, left, up = (0, 0, -1), (0, 1, 0), (1, 0, 0)
        pose = sapien.Pose(make_pose(np.stack([down, left, up], axis=1), CAMERA_POSITION_M))
        fov = 2 * np.arctan2(CAMERA_VIEW_M / 2, CAMERA_POSITION_M[2])
        return [CameraConfig("top", pose, CAMERA_PIXELS, CAMERA_PIXELS, fov=fov, near=0.05, far=5.0)]

    @property
    def _default_human_render_camera_configs(self) -> CameraConfig:
        pose = sapien_utils.look_at(eye=(-0.22, -0.95, 0.72), target=(-0.1, 0.04, 0.09))
        return CameraConfig("render_camera", pose, VIDEO_WIDTH, VIDEO_HEIGHT, fov=0.95, near=0.05, far=20.0)

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose(p=BASE_POSITION_M))

    def _load_scene(self, options: dict) -> None:
        self.layout = Layout(self.level, int(self._episode_seed[0]), REGION)
        self.table_scene = TableSceneBuilder(env=self)
        self.table_scene.build()
        furnishing = self.layout.furnishing()
        if furnishing is not None:
            builder = self.scene.create_actor_builder()
            paint = Paint(furnishing.table, grain=furnishing.grain)
            add_box(builder, (1.2, 1.6, MAT_M), (0.1, 0, MAT_M / 2), paint, collide=False)
            builder.initial_pose = sapien.Pose()
            builder.build_static(name="mat")
        self.build_objects()

    def _load_lighting(self, options: dict) -> None:
        # Slanted, so that flat metal does not reflect a lamp into the camera. No shadows: on the CPU they would take
        # several times as long to render as the rest of the image.
        furnishing = self.layout.furnishing()
        brightness = np.ones(3) if furnishing is None else furnishing.brightness
        self.scene.set_ambient_light(list(AMBIENT * brightness))
        for direction, color in LAMPS:
            rotated = direction if furnishing is None else furnishing.direction(direction)
            self.scene.add_directional_light(rotated, list(np.array(color) * brightness))

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.table_scene.initialize(env_idx)
        self._told = FINGER_TRAVEL_M
        (joints,) = self.layout.home(np.array([HOME_JOINTS]))
        home = np.array([*joints, FINGER_TRAVEL_M, FINGER_TRAVEL_M], dtype=np.float32)
        self.agent.reset(home)
        self.agent.robot.set_pose(sapien.Pose(p=BASE_POSITION_M))
        self._joints_before = self.agent.robot.get_qpos().clone()
        self.place_objects()
        for index, distractor in enumerate(self.layout.distractors()):
            self._add_distractor(distractor, f"distractor-{index}")
        rod = self.layout.rod(CAMERA_POSITION_M)
        if rod is not None:
            builder = self.scene.create_actor_builder()
            length = float(np.linalg.norm(rod.stop - rod.start))
            middle, along = (rod.start + rod.stop) / 2, rod.stop - rod.start
            add_cylinder(builder, rod.radius, length, middle, along, BLACK, collide=False)
            builder.initial_pose = sapien.Pose()
            builder.build_static(name="rod")

    def build_objects(self) -> None:
        """Add the objects of the episode to the scene."""
        raise NotImplementedError

    def place_objects(self) -> None:
        """Put the objects of the episode where they are, each by `Layout.place`."""
        raise NotImplementedError

    def _add_distractor(self, distractor: Distractor, name: str) -> None:
        builder = self.scene.create_actor_builder()
        paint, width, height = Paint(distractor.color), distractor.width, distractor.height
        if distractor.kind == "box":
            add_box(builder, (width, width, height), (0, 0, 0), paint)
        else:
            add_cylinder(builder, width / 2, height, (0, 0, 0), "z", paint)
        builder.initial_pose = sapien.Pose(distractor.pose)
        builder.build(name=name)

    def advance(self, command: FloatArray) -> None:
        """One control step, with joint angles and finger travel ``(7,)`` commanded, without evaluation.

        `step` also evaluates the task, which for a grasped object takes longer than the physics.
        """
        self.agent.drive(command)
        self._told = float(command[-1])
        self._before_control_step()
        for _ in range(self._sim_steps_per_control):
            self.scene.step()
        self._elapsed_steps += 1

    def _before_control_step(self) -> None:
        self._joints_before = self.agent.robot.get_qpos().clone()

    def failure(self) -> str:
        """Reason why the task is not done; empty if it is done."""
        raise NotImplementedError

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Evaluation in the form that ManiSkill requires."""
        return {"success": torch.tensor([not self.failure()])}

    def arm_is_still(self) -> bool:
        """Whether no arm joint moved faster than `STILL_RAD_S` over the last control step.

        Computed from the angles: with an object between the fingers PhysX reports wrong joint speeds.
        """
        moved = (self.agent.robot.get_qpos() - self._joints_before)[:, : len(HOME_JOINTS)]
        return bool(moved.abs().amax() * self.control_freq <= STILL_RAD_S)

    def draw(self, what: str) -> np.random.Generator:
        """Random generator of the episode for ``what`` ("shape", "pose"), determined by the seed."""
        return np.random.default_rng([int(self._episode_seed[0]), *what.encode()])

    def _get_obs_extra(self, info: dict) -> dict:
        return {"tcp_pose": self.agent.tcp.pose.raw_pose}

    def photograph(self) -> Observation:
        """The current image of the top-view camera."""
        return photograph(self, "top")

    def scene_truth(self) -> SceneTruth:
        """Ground truth of each pixel of the top view."""
        return scene_truth(self, "top")

    def home(self, usual: FloatArray) -> FloatArray:
        """Start pose ``(1, J)`` of the episode, rad."""
        return self.layout.home(usual)

    def video_frame(self) -> np.ndarray:
        """RGB frame ``(H, W, 3)`` uint8 of the camera beside the table."""
        return self.render_rgb_array()[0].cpu().numpy().astype(np.uint8)

    def measured(self) -> FloatArray:
        """Joint angles and finger travel, ``(7,)``."""
        return self.agent.robot.get_qpos()[0, :7].numpy().astype(np.float64)

    def grip_loads(self) -> FloatArray:
        """Force of the gripper as a share of its limit, ``(1,)``, from the deflection of its drive."""
        deflection = self.agent.robot.get_qpos()[0, 6] - self._told
        return np.array([min(abs(FINGER_STIFFNESS * float(deflection)) / GRIP_FORCE_N, 1.0)])

    def tool_poses(self) -> FloatArray:
        """Pose of the arm's tool frame, ``(1, 4, 4)``."""
        return self.agent.tcp._objs[0].pose.to_transformation_matrix().astype(np.float64)[None]
