"""Execute one plan in one scene, or run one closed-loop policy in it."""

import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import partial

from robust_instant_policy.controller import Controller
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import RipError, UnreachableError, UsageError
from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.evaluation.variant import Scene, Variant
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies import ClosedLoopPolicy, KeypointPolicy, LocatedScene, Plan
from robust_instant_policy.policies.policy import UNPLANNABLE
from robust_instant_policy.tasks.task import Execution, FrameSink, Task, require
from robust_instant_policy.trajectory import Trajectory


def reason(error: Exception) -> str:
    """One line; an error that is none of this package's is named."""
    return str(error) if isinstance(error, RipError) else f"unexpected {type(error).__name__}: {error}"


@dataclass(frozen=True)
class ScenePolicy:
    """Plans for the current scene, from its image or from given keypoints; ``executions`` are a plan's trajectories to
    execute. ``fitted`` is the policy that plans, None for another source of plans."""

    plan: Callable[[Observation], Plan]
    plan_scene: Callable[[LocatedScene], Plan]
    executions: Callable[[Plan], tuple[Trajectory, ...]] = lambda plan: (plan.trajectory,)
    fitted: KeypointPolicy | None = None


def roll_out(
    task: Task,
    policy: ScenePolicy | ClosedLoopPolicy,
    observation: Observation,
    scene: Scene,
    variant: Variant,
    done: Collection[int] = (),
) -> Iterator[Episode]:
    """Plan from ``observation``, the image of the task's last reset, and execute the trajectories of the policy.

    Every execution starts from a new build of the scene; the candidates in ``done`` are skipped. A plan that cannot be
    made, or that the motion checks refuse, is a failed episode, not an error.
    """
    row = partial(Episode, scene=scene, variant=variant, candidate=0, candidates=1, tokens=0, confidence=None)
    if isinstance(policy, ClosedLoopPolicy):
        yield _follow(task, policy, observation, row)
        return
    start = time.perf_counter()
    try:
        plan = policy.plan(observation)
    except UNPLANNABLE as error:
        yield row(
            success=False,
            seconds=time.perf_counter() - start,
            physics_seconds=0.0,
            executed_seconds=0.0,
            failure=f"no plan: {reason(error)}",
        )
        return
    trajectories = policy.executions(plan)
    for index, trajectory in enumerate(trajectories):
        if index in done:
            continue
        start = time.perf_counter()
        execution = execute(task, trajectory)
        yield row(
            candidate=index,
            candidates=len(trajectories),
            success=execution.success,
            seconds=plan.usage.seconds,
            physics_seconds=time.perf_counter() - start,
            executed_seconds=execution.seconds,
            tokens=plan.usage.tokens,
            confidence=plan.confidence,
            failure=execution.failure,
        )


def execute(task: Task, trajectory: Trajectory, on_frame: FrameSink | None = None) -> Execution:
    """Execute ``trajectory`` in the task's scene; a trajectory that the motion checks refuse is a failed execution."""
    try:
        execution = task.execute(trajectory, on_frame)
    except UnreachableError as error:
        return Execution(success=False, failure=f"refused: {error}", seconds=0.0, tracking_error=0.0)
    if not isinstance(execution, Execution):  # of a user's task
        got = type(execution).__name__
        raise UsageError(f"execute(…) of {task.name} must return Execution, got {got}; try rip new-task --check")
    return execution


def _follow(task: Task, policy: ClosedLoopPolicy, observation: Observation, row: partial[Episode]) -> Episode:
    require(task, "follow")
    start = time.perf_counter()
    controller = _Timed(policy.controller(observation))
    execution = task.follow(controller, policy.max_seconds)
    return row(
        success=execution.success,
        seconds=controller.seconds,
        physics_seconds=time.perf_counter() - start - controller.seconds,
        executed_seconds=execution.seconds,
        failure=execution.failure,
    )


class _Timed:
    """A controller that measures its own wall time, ``seconds``."""

    def __init__(self, controller: Controller):
        self._controller = controller
        self.rate_hz = controller.rate_hz
        self.seconds = 0.0

    def act(self, observation: Observation, action: FloatArray) -> FloatArray | None:
        start = time.perf_counter()
        waypoints = self._controller.act(observation, action)
        self.seconds += time.perf_counter() - start
        return waypoints
