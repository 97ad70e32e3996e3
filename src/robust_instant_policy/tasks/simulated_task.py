"""A simulated environment with a demonstrator, behind the contract of `tasks.task.Task`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import count
from typing import Any, Protocol

import numpy as np

from robust_instant_policy.checks import check_name
from robust_instant_policy.controller import Controller
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import RipError, UnreachableError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.arm import Arm, Motion
from robust_instant_policy.motion.waypoints import plan_onward, plan_poses, plan_waypoints
from robust_instant_policy.tasks.demonstrator import Stroke, perform, shorter_turns
from robust_instant_policy.tasks.level import PAPER, Level
from robust_instant_policy.tasks.scene_truth import SceneTruth
from robust_instant_policy.tasks.task import Attempt, Execution, FrameSink, Image, bounded_seed
from robust_instant_policy.trajectory import Trajectory

HAND_STREAM = 1  # stream of the demonstrator's random numbers, separate from the scene's
SEED_BITS = 32  # accepted by the simulators
GRIPPER_DIGITS = 3  # of a measured gripper state: encoders of real grippers resolve no more
SETTLE_SECONDS = 0.5  # at rest before a demonstration is judged

Expert = Callable[[Any, np.random.Generator], Sequence[Stroke]]


@dataclass(frozen=True)
class TaskSpec:
    """Definition of a task, and the expert that demonstrates it.

    ``expert(env, rng)`` has access to the simulator's state. ``object_sets`` and ``asset_sources`` are the available
    choices.
    """

    name: str
    description: str
    goal: str
    expert: Expert
    object_sets: tuple[str, ...] = ("seen",)
    asset_sources: tuple[str, ...] = ("code",)

    @property
    def env_id(self) -> str:
        """Name of the environment: "push-cube" is "RIP-PushCube-v1"."""
        return f"RIP-{self.name.title().replace('-', '')}-v1"


def spec_of(module: str, objects: str, assets: str) -> TaskSpec:
    """``SPEC`` of ``module``, if it has the set of ``objects`` and the source of ``assets``; else raises
    `UnknownNameError`."""
    spec: TaskSpec = import_module(module).SPEC
    check_name(f"set of objects of {spec.name}", objects, spec.object_sets)
    check_name(f"source of assets of {spec.name}", assets, spec.asset_sources)
    return spec


class Cell(Protocol):
    """A gymnasium environment that holds a scene with A arms; see the methods of the same names in `Task`.

    ``advance`` takes one control step towards ``command (A·(J + 1),)``: for each arm the joint angles and the finger
    travel, rad and m; ``measured`` returns the same quantities, ``grip_loads (A,)`` each gripper's share of its force
    limit. ``tool_poses`` are the arms' tool frames ``(A, 4, 4)``. ``failure`` is the reason why the task is not done,
    empty if it is done. ``home`` are the joint angles ``(A, J)`` at the start of the scene, of arms that start at
    ``usual (A, J)`` unless the scene says otherwise.
    """

    def reset(self, *, seed: int) -> Any: ...
    def photograph(self) -> Observation: ...
    def scene_truth(self) -> SceneTruth: ...
    def advance(self, command: FloatArray) -> None: ...
    def measured(self) -> FloatArray: ...
    def grip_loads(self) -> FloatArray: ...
    def tool_poses(self) -> FloatArray: ...
    def video_frame(self) -> np.ndarray: ...
    def failure(self) -> str: ...
    def home(self, usual: FloatArray) -> FloatArray: ...
    def close(self) -> None: ...


@dataclass(frozen=True)
class Timing:
    """Control rate in Hz; every ``record_every``-th step is recorded, every ``frame_every``-th is a video frame.

    ``execute_hz`` is the rate of executed waypoints.
    """

    control_hz: float
    record_every: int
    frame_every: int
    execute_hz: float


class SimulatedTask:
    """See `tasks.task.Task`. Each execution has a new scene, built from its seed.

    ``arms`` are the working arms, with equal grippers, in the order of the commands of ``cell``.
    """

    def __init__(
        self,
        spec: TaskSpec,
        cell: Cell,
        arms: Sequence[Arm],
        timing: Timing,
        workspace: FloatArray,
        level: Level = PAPER,
    ):
        self.name, self.description, self.goal = spec.name, spec.description, spec.goal
        self.end_effectors = tuple(arm.name for arm in arms)
        self.record_hz = timing.control_hz / timing.record_every
        self.execute_hz = timing.execute_hz
        self.video_hz = timing.control_hz / timing.frame_every
        self.workspace = workspace
        self._spec, self._cell, self._timing, self._level = spec, cell, timing, level
        self._usual_arms = self._arms = arms  # with the usual start pose, and with that of the scene
        self._triangle = arms[0].triangle
        self._seed: int | None = None
        self._fresh = False  # no motion since the scene was built

    def reset(self, seed: int) -> Observation:
        self._rebuild(seed)
        return self.look()

    def execute(self, trajectory: Trajectory, on_frame: FrameSink | None = None) -> Execution:
        self._begin()
        control_hz = self._timing.control_hz
        motion = plan_waypoints(trajectory, self._arms, self.execute_hz, control_hz)
        tracking_error = self._play(motion, self._filming(on_frame))
        failure = self._cell.failure()
        return Execution(not failure, failure, len(motion.joints) / control_hz, tracking_error)

    def follow(self, controller: Controller, max_seconds: float, on_frame: FrameSink | None = None) -> Execution:
        self._begin()
        control_hz = self._timing.control_hz
        before_step = self._filming(on_frame)
        motion = Motion.at_home(self._arms)
        rate_hz = controller.rate_hz or self.execute_hz
        steps, worst, failure = 0, 0.0, ""
        while steps < max_seconds * control_hz and not failure:
            waypoints = controller.act(self.look(), self._action(motion.closed[-1]))
            if waypoints is None:
                break
            try:
                motion = plan_onward(waypoints, rate_hz, motion, self._arms, control_hz)
            except UnreachableError as error:
                failure = f"refused after {steps / control_hz:.1f} s: {error}"
            else:
                worst = max(worst, self._play(motion, before_step))
                steps += len(motion.joints)
        self._rest(motion)
        failure = failure or self._cell.failure()
        return Execution(not failure, failure, steps / control_hz, worst)

    @property
    def control_hz(self) -> float:
        """Rate of `advance`."""
        return self._timing.control_hz

    @property
    def arms(self) -> Sequence[Arm]:
        """The working arms, with the start pose of the present scene as their home."""
        return self._arms

    def expert_path(self) -> tuple[FloatArray, np.ndarray]:
        """Tool poses ``(N, A, 4, 4)`` and gripper commands ``(N, A)`` of the demonstrator in the scene of `reset`."""
        rng = np.random.default_rng([self._seed or 0, HAND_STREAM])
        strokes = self._spec.expert(self._cell, rng)
        home = np.stack([arm.home_pose for arm in self._arms])
        if self._level.turn:
            strokes = shorter_turns(strokes)
        return perform(home, strokes, rng, self._timing.control_hz)

    def demonstrate(self, seed: int, with_images: bool = False, every: int = 1) -> Attempt:
        observation = self.reset(seed)
        poses, closed = self.expert_path()
        images: list[Image] = []
        grippers: list[FloatArray] = []
        try:
            motion = plan_poses(poses, closed, self._arms, self._timing.control_hz)
        except UnreachableError as error:
            failure = str(error)
        else:
            poses, closed = motion.poses, motion.closed
            steps = self._recorded(poses, every)
            self._play(motion, self._observing(grippers, images if with_images else None, steps))
            self._rest(motion)
            failure = self._cell.failure()
        recorded = self._recorded(poses, every)
        trajectory = Trajectory.from_poses(poses[recorded], closed[recorded], self._triangle)
        demonstration = Demonstration(observation, trajectory, self.record_hz / every, self.name, seed)
        measured = np.array(grippers) if grippers else None
        return Attempt(demonstration, not failure, failure, np.array(images) if images else None, measured)

    @property
    def cell(self) -> Cell:
        """The environment, as physics of an emulated robot."""
        return self._cell

    def scene_truth(self) -> SceneTruth:
        """Ground truth of the camera's pixels, to measure perception; not for policies."""
        return self._cell.scene_truth()

    def close(self) -> None:
        self._cell.close()

    def _begin(self) -> None:
        """Have the scene of the last `reset` as it was drawn."""
        if self._seed is None:
            raise RipError("no scene to execute in; call reset(seed) first")
        if not self._fresh:
            self._rebuild(self._seed)

    def _rebuild(self, seed: int) -> None:
        self._cell.reset(seed=bounded_seed(seed, SEED_BITS))
        self._seed, self._fresh, self._images = seed, True, 0
        home = self._cell.home(np.stack([arm.home for arm in self._usual_arms]))
        self._arms = [replace(arm, home=joints) for arm, joints in zip(self._usual_arms, home, strict=True)]

    def look(self) -> Observation:
        """What the camera sees now, with the noise of the level."""
        self._images += 1
        return self._level.photographed(self._cell.photograph(), self._seed or 0, self._images)

    def _recorded(self, poses: FloatArray, every: int) -> range:
        """Indices of the recorded control steps; they include the last one, at which success is judged."""
        interval = every * self._timing.record_every
        return range((len(poses) - 1) % interval, len(poses), interval)

    def _play(self, motion: Motion, before_step: Callable[[], None]) -> float:
        """Run the commands; returns the largest distance between commanded and reached gripper point, metres."""
        gripper_point = np.array([0.0, 0.0, -self._triangle.length])
        self._fresh = False
        worst = 0.0
        for command, poses in zip(motion.commands, motion.poses, strict=True):
            before_step()
            self._cell.advance(command)
            reached = self._cell.tool_poses()
            commanded = poses[:, :3, :3] @ gripper_point + poses[:, :3, 3]
            missed = commanded - (reached[:, :3, :3] @ gripper_point + reached[:, :3, 3])
            worst = max(worst, float(np.linalg.norm(missed, axis=1).max()))
        return worst

    def _filming(self, on_frame: FrameSink | None) -> Callable[[], None]:
        """Returns a function to call before each control step; it passes video frames to ``on_frame``."""
        step = count()

        def before_step() -> None:
            if on_frame is not None and next(step) % self._timing.frame_every == 0:
                on_frame(self._cell.video_frame())

        return before_step

    def _observing(self, grippers: list[FloatArray], images: list[Image] | None, steps: range) -> Callable[[], None]:
        """Returns a function to call before each control step; at ``steps`` it appends the measured gripper states
        ``(A,)`` to ``grippers``, and the image to ``images``."""
        step = count()

        def before_step() -> None:
            if next(step) in steps:
                travel = self._cell.measured().reshape(len(self._arms), -1)[:, -1]
                closed = 1 - travel / [arm.finger_travel for arm in self._arms]
                grippers.append(np.round(closed, GRIPPER_DIGITS))
                if images is not None:
                    images.append(self.look().rgb)

        return before_step

    def _action(self, closed: np.ndarray) -> FloatArray:
        """Current gripper poses with the commanded states ``closed (A,)``, as an action ``(10·A,)``."""
        return Trajectory.from_poses(self._cell.tool_poses()[None], closed[None], self._triangle).actions[0]

    def _rest(self, motion: Motion) -> None:
        for _ in range(int(SETTLE_SECONDS * self._timing.control_hz)):
            self._cell.advance(motion.commands[-1])
