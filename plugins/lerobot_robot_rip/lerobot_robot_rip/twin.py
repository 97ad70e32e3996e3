from __future__ import annotations

from functools import cached_property
from typing import Any, ClassVar, cast

import numpy as np
from lerobot.robots import Robot
from lerobot_policy_rip.embodiment import POSE_AXES, Embodiment
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robust_instant_policy.datasets import coded_depth
from robust_instant_policy.datasets.images import millimetres
from robust_instant_policy.errors import UnknownNameError, UsageError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.arm import Motion
from robust_instant_policy.motion.waypoints import plan_poses
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.simulated_task import SimulatedTask

from .config_rip import RipTwinConfig

DEPTHS = ("native", "coded", "none")
CAMERA = "top"


class RipTwin(Robot):
    """A simulated arm, or two, with a depth camera; joints in degrees, grippers from 0 (closed) to 100.

    Observations also have the measured tool pose: ``ee.x … ee.wz``, metres and a rotation vector.
    """

    config_class = RipTwinConfig
    name = "rip_twin"
    connected: ClassVar[RipTwin | None] = None  # for the leader, which sees the scene as a person does

    def __init__(self, config: RipTwinConfig):
        super().__init__(config)
        if config.depth not in DEPTHS:
            raise UnknownNameError("depth", config.depth, DEPTHS)
        self.config = config
        self.cameras = {CAMERA: None}
        self.seed = config.seed

    @cached_property
    def task(self) -> SimulatedTask:
        task = cast(SimulatedTask, make_task(self.config.task))
        if self.config.fps <= 0 or task.control_hz % self.config.fps:
            raise UsageError(f"fps must divide the {task.control_hz:g} Hz of the cell's control, got {self.config.fps}")
        task.reset(self.seed)
        return task

    @cached_property
    def embodiment(self) -> Embodiment:
        return Embodiment.simulated(self.task.end_effectors, [arm.triangle for arm in self.task.arms])

    @property
    def _pose_axes(self) -> list[str]:
        arms = self.task.end_effectors
        return [f"{arm}_{axis}" if len(arms) > 1 else axis for arm in arms for axis in POSE_AXES]

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(self.embodiment.axes, float)

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        features: dict[str, Any] = dict.fromkeys([*self.embodiment.axes, *self._pose_axes], float)
        seen = self.task.look()
        images = {CAMERA: seen.rgb, **self._depth(seen.depth)}
        return features | {name: image.shape for name, image in images.items()}

    @property
    def is_connected(self) -> bool:
        return RipTwin.connected is self

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        """A simulated arm needs no calibration."""

    def configure(self) -> None:
        """Nor has it settings."""

    def connect(self, calibrate: bool = True) -> None:
        self.lay_out(self.seed)
        RipTwin.connected = self

    def disconnect(self) -> None:
        print(f"twin: scene {self.seed}: {self.task.cell.failure() or 'done'}", flush=True)
        RipTwin.connected = None
        self.task.close()

    def lay_out(self, seed: int) -> None:
        """Build the scene of ``seed``, with the arms at home."""
        self.seed = seed
        self.task.reset(seed)
        self._command = Motion.at_home(self.task.arms).commands[0]

    def demonstration(self) -> FloatArray:
        """Actions ``(N, D)`` of the task's demonstrator in the present scene."""
        motion = plan_poses(*self.task.expert_path(), self.task.arms, self.task.control_hz)
        stride = round(self.task.control_hz / self.config.fps)
        last = len(motion.commands) - 1
        return self.embodiment.to_robot(motion.commands[np.minimum(np.arange(stride, last + stride, stride), last)])

    def home(self) -> FloatArray:
        """The action ``(D,)`` that holds the arms at home, grippers open."""
        return self.embodiment.to_robot(Motion.at_home(self.task.arms).commands[0])

    def get_observation(self) -> dict[str, Any]:
        cell = self.task.cell
        poses = cell.tool_poses()
        turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
        numbers = [*self.embodiment.to_robot(cell.measured()), *np.concatenate([poses[:, :3, 3], turns], 1).ravel()]
        seen = self.task.look()
        observation = dict(zip([*self.embodiment.axes, *self._pose_axes], map(float, numbers), strict=True))
        return {**observation, CAMERA: seen.rgb.copy(), **self._depth(seen.depth)}

    def _depth(self, depth: NDArray) -> dict[str, NDArray]:
        """``depth (H, W)``, metres, as it is recorded."""
        if self.config.depth == "none":
            return {}
        is_native = self.config.depth == "native"
        return {f"{CAMERA}_depth": millimetres(depth)[..., None] if is_native else coded_depth.encode(depth)}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        command = self.embodiment.from_robot([action[axis] for axis in self.embodiment.axes])
        steps = round(self.task.control_hz / self.config.fps)
        for share in np.arange(1, steps + 1) / steps:
            self.task.cell.advance((1 - share) * self._command + share * command)
        self._command = command
        return action
