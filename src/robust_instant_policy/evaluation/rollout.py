"""One plan in one scene, executed; or one closed-loop policy let loose in it."""

from __future__ import annotations

import time
from functools import partial

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.controller import Controller
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import KeypointError, PlanningError, UnreachableError
from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies import ClosedLoopPolicy, Policy
from robust_instant_policy.tasks.task import Task


def roll_out(
    task: Task,
    policy: Policy | ClosedLoopPolicy,
    observation: Observation,
    seed: int,
    num_demonstrations: int,
    objects: str = "seen",
) -> list[Episode]:
    """Plan from ``observation`` and execute what the policy wants executed, each from a fresh reset to ``seed``.

    Methods that share an instant policy share its samples if they are given the same observation object.
    A plan that cannot be made, or that the arm refuses, is a failed episode, not an error.
    """
    row = partial(
        Episode, task=task.name, objects=objects, method=policy.name, demos=num_demonstrations, seed=seed, candidate=0
    )
    if isinstance(policy, ClosedLoopPolicy):
        return [_follow(task, policy, observation, seed, row)]
    start = time.perf_counter()
    try:
        plan = policy.plan(observation)
    except (KeypointError, PlanningError) as error:
        return [
            row(
                success=False,
                seconds=time.perf_counter() - start,
                executed_seconds=0.0,
                tokens=0,
                confidence=None,
                failure=f"no plan: {error}",
            )
        ]
    episodes = []
    for index, trajectory in enumerate(policy.executions(plan)):
        task.reset(seed)
        try:
            execution = task.execute(trajectory)
            success, seconds, failure = execution.success, execution.seconds, execution.failure
        except UnreachableError as error:
            success, seconds, failure = False, 0.0, f"refused: {error}"
        episodes.append(
            row(
                candidate=index,
                success=success,
                seconds=plan.usage.seconds,
                executed_seconds=seconds,
                tokens=plan.usage.tokens,
                confidence=plan.confidence,
                failure=failure,
            )
        )
    return episodes


def _follow(
    task: Task, policy: ClosedLoopPolicy, observation: Observation, seed: int, row: partial[Episode]
) -> Episode:
    controller = _Timed(policy.controller(observation))
    task.reset(seed)
    execution = task.follow(controller, policy.max_seconds)
    return row(
        success=execution.success,
        seconds=controller.seconds,
        executed_seconds=execution.seconds,
        tokens=0,
        confidence=None,
        failure=execution.failure,
    )


class _Timed:
    """A controller, and the wall ``seconds`` it has thought so far."""

    def __init__(self, controller: Controller):
        self._controller = controller
        self.rate_hz = controller.rate_hz
        self.seconds = 0.0

    def act(self, image: NDArray[np.uint8], action: FloatArray) -> FloatArray | None:
        start = time.perf_counter()
        waypoints = self._controller.act(image, action)
        self.seconds += time.perf_counter() - start
        return waypoints
