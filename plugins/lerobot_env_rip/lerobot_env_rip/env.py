from __future__ import annotations

from typing import Any, ClassVar, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from lerobot_policy_rip.embodiment import Embodiment

from robust_instant_policy.datasets.images import millimetres
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.simulated_task import SimulatedTask

HOLD_SECONDS = 3.0  # of equal commands, after which the episode is over; waypoints are at most 1 s apart
VIDEO_SECONDS = {True: 0.1, False: 0.5}  # between new frames of a video, with live images and without


class RipEnv(gymnasium.Env):
    """A simulated task as LeRobot sees it.

    Actions and ``agent_pos (7·A,)`` are joints in degrees and grippers from 0 (closed) to 100; ``pixels["top"]`` is the
    camera's image ``(H, W, 3)`` uint8, ``images.top_depth (H, W)`` its depth, uint16 millimetres. The task is judged
    once, when the commands stay the same: as ``rip eval`` does at the end of a plan.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(self, task: str, live_images: bool = True, max_seconds: float = 120.0):
        self._task = cast(SimulatedTask, make_task(task))
        self.task, self.task_description = task, self._task.description
        self.render_mode, self._live_images = "rgb_array", live_images
        self.metadata = {**RipEnv.metadata, "render_fps": round(self._task.control_hz)}
        self._max_episode_steps = round(max_seconds * self._task.control_hz)
        arms = self._task.arms
        self._embodiment = Embodiment.simulated(self._task.end_effectors, [arm.triangle for arm in arms])
        self._frame_steps = round(VIDEO_SECONDS[live_images] * self._task.control_hz)
        self._seed = 0
        size = self._task.reset(self._seed).rgb.shape[:2]
        unbounded = Box(-np.inf, np.inf, (len(self._embodiment.axes),), np.float64)
        self.action_space = unbounded
        self.observation_space = gymnasium.spaces.Dict(
            {
                "agent_pos": unbounded,
                "pixels": gymnasium.spaces.Dict({"top": Box(0, 255, (*size, 3), np.uint8)}),
                "images.top_depth": Box(0, 2**16 - 1, size, np.uint16),
            }
        )

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        self._seed = self._seed + 1 if seed is None else seed
        self._seen = self._task.reset(self._seed)
        self._steps = self._held = 0
        self._action: np.ndarray | None = None
        self._frame: np.ndarray | None = None
        return self._observe(), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        self._held = self._held + 1 if self._action is not None and np.array_equal(action, self._action) else 0
        self._action = np.array(action)
        self._task.cell.advance(self._embodiment.from_robot(action))
        self._steps += 1
        if self._live_images:
            self._seen = self._task.look()
        terminated = self._held >= HOLD_SECONDS * self._task.control_hz
        truncated = self._steps >= self._max_episode_steps
        success = (terminated or truncated) and not self._task.cell.failure()
        return self._observe(), float(success), terminated, truncated, {"is_success": success}

    def render(self) -> np.ndarray:
        if self._frame is None or self._steps % self._frame_steps == 0:
            self._frame = self._task.cell.video_frame()
        return self._frame

    def close(self) -> None:
        self._task.close()

    def _observe(self) -> dict[str, Any]:
        depth = millimetres(self._seen.depth)
        state = self._embodiment.to_robot(self._task.cell.measured())
        return {"agent_pos": state, "pixels": {"top": self._seen.rgb}, "images.top_depth": depth}
