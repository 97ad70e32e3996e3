"""A simulated environment with a demonstrator, behind the contract of `tasks.task.Task`."""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import RipError, UnreachableError
from robust_instant_policy.tasks.demonstrator import Stroke, perform
from robust_instant_policy.tasks.maniskill.arm import EXECUTE_HZ, ur5e_hande
from robust_instant_policy.tasks.maniskill.cell import RECORD_HZ, WORKSPACE, CellEnv
from robust_instant_policy.tasks.maniskill.renderer import require_renderer
from robust_instant_policy.tasks.motion import Motion, plan_poses, plan_waypoints
from robust_instant_policy.tasks.scene_truth import SceneTruth
from robust_instant_policy.tasks.task import Attempt, Execution, FrameSink
from robust_instant_policy.trajectory import Trajectory

HAND_STREAM = 1  # the demonstrator's random numbers, apart from the scene's
SETTLE_STEPS = 27  # half a second at rest before a demonstration is judged
STEPS_PER_FRAME = 4
VIDEO_HZ = RECORD_HZ / STEPS_PER_FRAME

Expert = Callable[[Any, np.random.Generator], Sequence[Stroke]]
Verdict = Callable[[Any], str]


@dataclass(frozen=True)
class TaskSpec:
    """What makes a task: its environment, what the person does in it, and why it failed, in words.

    ``expert(env, rng)`` sees the simulator's state, as a person sees the scene; ``verdict(env)`` returns the
    reason of failure, or nothing after success. ``object_sets`` and ``asset_sources`` are what there is to
    choose from.
    """

    name: str
    description: str
    goal: str
    env_id: str
    expert: Expert
    verdict: Verdict
    object_sets: tuple[str, ...] = ("seen",)
    asset_sources: tuple[str, ...] = ("code", "maniskill")


class SimulatedTask:
    """See `tasks.task.Task`. One scene at a time; scenes are rebuilt only where their objects differ."""

    record_hz = RECORD_HZ
    execute_hz = EXECUTE_HZ
    video_hz = VIDEO_HZ
    workspace = WORKSPACE

    def __init__(self, spec: TaskSpec, objects: str, assets: str):
        require_renderer()
        self.name, self.description, self.goal = spec.name, spec.description, spec.goal
        self._spec = spec
        self._env = gymnasium.make(spec.env_id, obs_mode="none", reward_mode="none", objects=objects, assets=assets)
        self._cell: CellEnv = self._env.unwrapped
        # The simulator searches the whole process for garbage whenever it rebuilds a scene. What lives by now (torch
        # and its like) lives on; sparing it makes a reset several times faster.
        gc.collect()
        gc.freeze()
        self._arm = ur5e_hande()
        self._seed: int | None = None
        self._fresh = False  # nothing has moved since the scene was built

    def reset(self, seed: int) -> Observation:
        self._rebuild(seed)
        return self._cell.photograph()

    def execute(self, trajectory: Trajectory, on_frame: FrameSink | None = None) -> Execution:
        if self._seed is None:
            raise RipError("there is no scene to execute in; call reset(seed) first")
        if not self._fresh:
            self._rebuild(self._seed)
        motion = plan_waypoints(trajectory, self._arm, EXECUTE_HZ, RECORD_HZ)
        tracking_error = self._play(motion, on_frame)
        failure = self._spec.verdict(self._cell)
        return Execution(not failure, failure, len(motion.joints) / RECORD_HZ, tracking_error)

    def demonstrate(self, seed: int, with_images: bool = False) -> Attempt:
        observation = self.reset(seed)
        rng = np.random.default_rng([seed, HAND_STREAM])
        strokes = self._spec.expert(self._cell, rng)
        poses, closed = perform(self._arm.home_pose, strokes, rng, RECORD_HZ)
        images: list[np.ndarray] = []
        try:
            motion = plan_poses(poses, closed, self._arm, RECORD_HZ)
        except UnreachableError as error:
            failure = str(error)
        else:
            poses, closed = motion.poses, motion.closed
            self._play(motion, None, images if with_images else None)
            self._rest(motion)
            failure = self._spec.verdict(self._cell)
        trajectory = Trajectory.from_poses(poses, closed.astype(np.float64), self._arm.triangle)
        demonstration = Demonstration(observation, trajectory, RECORD_HZ, self.name, seed)
        return Attempt(demonstration, not failure, failure, np.array(images) if images else None)

    def scene_truth(self) -> SceneTruth:
        """What the camera's pixels show: for measuring perception, never for a policy."""
        return self._cell.scene_truth()

    def _rebuild(self, seed: int) -> None:
        self._env.reset(seed=seed)
        self._seed, self._fresh = seed, True

    def close(self) -> None:
        self._env.close()
        gc.unfreeze()

    def _play(self, motion: Motion, on_frame: FrameSink | None, images: list[np.ndarray] | None = None) -> float:
        """Run the commands; the largest distance between the palm commanded and reached, in metres."""
        palm = np.array([0.0, 0.0, -self._arm.triangle.length])
        self._fresh = False
        worst = 0.0
        for step, (joints, fingers, pose) in enumerate(zip(motion.joints, motion.fingers, motion.poses, strict=True)):
            if images is not None:
                images.append(self._cell.photograph().rgb)
            if on_frame is not None and step % STEPS_PER_FRAME == 0:
                on_frame(self._cell.video_frame())
            self._cell.advance(np.append(joints, fingers))
            reached = self._cell.tool_pose()
            missed = (pose[:3, :3] @ palm + pose[:3, 3]) - (reached[:3, :3] @ palm + reached[:3, 3])
            worst = max(worst, float(np.linalg.norm(missed)))
        return worst

    def _rest(self, motion: Motion) -> None:
        for _ in range(SETTLE_STEPS):
            self._cell.advance(np.append(motion.joints[-1], motion.fingers[-1]))
