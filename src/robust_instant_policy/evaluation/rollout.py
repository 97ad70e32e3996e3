"""One plan in one scene, executed."""

from __future__ import annotations

import time

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import KeypointError, PlanningError, UnreachableError
from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.policies import Policy
from robust_instant_policy.tasks.task import Task


def roll_out(
    task: Task, policy: Policy, observation: Observation, seed: int, num_demonstrations: int, objects: str = "seen"
) -> list[Episode]:
    """Plan from ``observation`` and execute what the policy wants executed, each from a fresh reset to ``seed``.

    Methods that share an instant policy share its samples if they are given the same observation object.
    A plan that cannot be made, or that the arm refuses, is a failed episode, not an error.
    """
    about = {"task": task.name, "objects": objects, "method": policy.name, "demos": num_demonstrations, "seed": seed}
    start = time.perf_counter()
    try:
        plan = policy.plan(observation)
    except (KeypointError, PlanningError) as error:
        return [
            Episode(
                **about,  # type: ignore[arg-type]
                candidate=0,
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
            Episode(
                **about,  # type: ignore[arg-type]
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
