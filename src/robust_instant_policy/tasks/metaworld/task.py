"""Meta-World's tasks as `tasks.task.Task`.

The hand is moved as the benchmark moves it, by a mocap body and at most 10 mm an axis and control step; it never turns,
so the rotation of a trajectory's triplets is not followed. A task is done if the environment says so at any step.
"""

from collections.abc import Iterator

import numpy as np

from robust_instant_policy.checks import check_name
from robust_instant_policy.controller import Controller
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import RipError
from robust_instant_policy.geometry import FloatArray, GripperTriangle, make_pose
from robust_instant_policy.motion.gripper_changes import state_of_opening
from robust_instant_policy.tasks.aloha.renderer import require_renderer
from robust_instant_policy.tasks.level import CAMERA_LEVELS, PAPER, Level, make_level
from robust_instant_policy.tasks.metaworld.benchmark import PREFIX
from robust_instant_policy.tasks.scene_truth import SceneTruth
from robust_instant_policy.tasks.task import Attempt, Execution, FrameSink, bounded_seed
from robust_instant_policy.trajectory import Trajectory

TRIANGLE = GripperTriangle(length=0.10, opening=0.10)  # the fingers are 0.1 m apart when they are open
DOWN = np.diag([1.0, -1.0, -1.0])  # rotation of the hand: fingers down, opening along y
FINGERTIPS_M = np.array([0.0, 0.0, -0.045])  # from the hand's origin to the middle between the fingertips
WAYPOINT_STEPS = 8  # control steps from waypoint to waypoint
GRIPPER_STEPS = 24  # at a waypoint where the gripper opens or closes
SETTLE_STEPS = 20  # at the last waypoint
FOLLOW_GAIN = 0.25  # share of the hand's error that an action corrects, as in most of the scripted experts
MAX_STEP_M = 0.008  # of the commanded hand, so that an action of at most 10 mm an axis can correct it
CLOSE_EFFORT, OPEN_EFFORT = 0.8, -1.0  # of the fingers; the scripted experts close with 0.6 to 1
AFTER_SUCCESS_STEPS = 30  # of a demonstration after success, so that it does not end at the border of the goal
FRAME_EVERY = 4  # control steps from video frame to video frame
SEED_BITS = 31


class MetaWorldTask:
    """See `tasks.task.Task`; ``level`` "paper" or "noise"."""

    end_effectors = ("sawyer",)
    workspace = np.array([[-0.55, 0.35, -0.15], [0.55, 0.97, 0.55]])

    def __init__(self, name: str, level: Level = PAPER):
        require_renderer()
        from robust_instant_policy.tasks.metaworld.environment import CONTROL_HZ, Environment

        self.name = name
        task = name.removeprefix(PREFIX)
        self.description = f"Meta-World: {task.replace('-', ' ')}"
        self.goal = "the environment reports success"
        self.record_hz, self.execute_hz = CONTROL_HZ, CONTROL_HZ / WAYPOINT_STEPS
        self.video_hz = CONTROL_HZ / FRAME_EVERY
        self._env, self._level = Environment(task), level
        self._seed: int | None = None
        self._images = 0

    def reset(self, seed: int) -> Observation:
        self._rebuild(seed)
        return self._photograph()

    def execute(self, trajectory: Trajectory, on_frame: FrameSink | None = None) -> Execution:
        self._rebuild(self._last_seed())
        tracking_error = self._follow_hand(
            _hand_path(self._env.hand, trajectory, WAYPOINT_STEPS, SETTLE_STEPS), on_frame
        )
        return self._result(tracking_error)

    def follow(self, controller: Controller, max_seconds: float, on_frame: FrameSink | None = None) -> Execution:
        self._rebuild(self._last_seed())
        steps = max(1, round(self.record_hz / (controller.rate_hz or self.execute_hz)))
        closed, worst = False, 0.0
        while self._env.steps < max_seconds * self.record_hz and not (self._env.over or self._env.success):
            waypoints = controller.act(self._photograph(), self._action(closed))
            if waypoints is None:
                break
            trajectory = Trajectory.from_actions(waypoints)
            worst = max(worst, self._follow_hand(_hand_path(self._env.hand, trajectory, steps, 0, closed), on_frame))
            closed = bool(trajectory.gripper_state[-1, 0] > 0.5)
        return self._result(worst)

    def demonstrate(self, seed: int, with_images: bool = False, every: int = 1) -> Attempt:
        """The expert's hand, with the gripper state where it is measured, see `state_of_opening`."""
        observation = self.reset(seed)
        env = self._env
        hands, openings, images = [env.hand], [env.opening], [observation.rgb]
        left = AFTER_SUCCESS_STEPS
        while not env.over and left > 0:
            env.step_expert()
            hands.append(env.hand)
            openings.append(env.opening)
            images.append(self._photograph().rgb if with_images else observation.rgb)
            left -= env.success
        points = np.array(hands) + FINGERTIPS_M
        closed = state_of_opening(np.array(openings), points)
        recorded = range((len(points) - 1) % every, len(points), every)
        poses = np.array([make_pose(DOWN, point) for point in points[recorded]])
        trajectory = Trajectory.from_poses(poses, closed[recorded], TRIANGLE)
        demonstration = Demonstration(observation, trajectory, self.record_hz / every, self.name, seed)
        shown = np.array([images[step] for step in recorded]) if with_images else None
        return Attempt(demonstration, env.success, "" if env.success else "the scripted expert does not succeed", shown)

    def scene_truth(self) -> SceneTruth:
        return self._env.scene_truth()

    def close(self) -> None:
        self._env.close()

    def _last_seed(self) -> int:
        if self._seed is None:
            raise RipError("no scene to execute in; call reset(seed) first")
        return self._seed

    def _rebuild(self, seed: int) -> None:
        self._env.reset(bounded_seed(seed, SEED_BITS))
        self._seed, self._images = seed, 0

    def _photograph(self) -> Observation:
        self._images += 1
        return self._level.photographed(self._env.photograph(), self._last_seed(), self._images)

    def _follow_hand(self, path: Iterator[tuple[FloatArray, bool]], on_frame: FrameSink | None) -> float:
        """Command the hand along ``path`` of fingertip points and gripper states, one a control step, until success or
        the horizon; returns the largest distance between commanded and reached point, metres."""
        env, worst = self._env, 0.0
        commanded = env.hand
        for point, closed in path:
            if env.over or env.success:
                break
            if on_frame is not None and env.steps % FRAME_EVERY == 0:
                on_frame(env.video_frame())
            wanted = point - FINGERTIPS_M
            env.step(wanted - commanded + FOLLOW_GAIN * (commanded - env.hand), CLOSE_EFFORT if closed else OPEN_EFFORT)
            commanded = wanted
            worst = max(worst, float(np.linalg.norm(commanded - env.hand)))
        return worst

    def _action(self, closed: bool) -> FloatArray:
        pose = make_pose(DOWN, self._env.hand + FINGERTIPS_M)
        return Trajectory.from_poses(pose[None], np.array([closed]), TRIANGLE).actions[0]

    def _result(self, tracking_error: float) -> Execution:
        env = self._env
        failure = "" if env.success else f"not done after {env.steps} control steps"
        return Execution(env.success, failure, env.steps / self.record_hz, tracking_error)


def _hand_path(
    hand: FloatArray, trajectory: Trajectory, steps: int, settle: int, closed: bool = False
) -> Iterator[tuple[FloatArray, bool]]:
    """Fingertip point ``(3,)`` and gripper state at each control step.

    A waypoint is reached in ``steps``, or more where it is far; where the state, at first ``closed``, changes there,
    the hand waits.
    """
    points = trajectory.triplets[:, 0, 1:].mean(axis=1)
    at = hand + FINGERTIPS_M
    for point, state in zip(points, trajectory.gripper_state[:, 0] > 0.5, strict=True):
        count = max(steps, int(np.ceil(np.abs(point - at).max() / MAX_STEP_M)))
        for share in np.arange(1, count + 1) / count:
            yield at + share * (point - at), closed
        if state != closed:
            yield from [(point, bool(state))] * GRIPPER_STEPS
        at, closed = point, bool(state)
    yield from [(at, closed)] * settle


def make(name: str, objects: str, assets: str, level: str) -> MetaWorldTask:
    """The task ``name``; Meta-World has one set of objects."""
    check_name(f"set of objects of {name}", objects, ("seen",))
    check_name(f"source of assets of {name}", assets, ("code",))
    check_name(f"level of {name}", level, CAMERA_LEVELS)
    return MetaWorldTask(name, make_level(level))
