"""A keypoint method in closed loop: it plans again from a new image after some waypoints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Self

import numpy as np

from robust_instant_policy.checks import checked_whole
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies.keypoint_policy import KeypointPolicy
from robust_instant_policy.policies.policy import UNPLANNABLE, Plan
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX

ROUNDS = 2  # times that the whole motion is made, at most
Z = slice(2, STATE_INDEX, 3)  # heights of an arm's three points


class Replanning:
    """``policy``, which plans again after every ``every`` waypoints. See `policies.ClosedLoopPolicy`.

    While a gripper is closed the plan is kept, because what it holds moves with the hand. After its end the whole
    motion is planned and made once more; the caller ends the episode where the task is done.
    """

    max_seconds = math.inf  # the controller ends by itself

    def __init__(self, policy: KeypointPolicy, every: int):
        self.policy, self.every = policy, checked_whole("every", every, 1)

    @property
    def name(self) -> str:
        return self.policy.name

    def fit(self, demonstrations: Sequence[Demonstration]) -> Self:
        self.policy.fit(demonstrations)
        return self

    def controller(self, observation: Observation) -> ReplanningController:
        return ReplanningController(self.policy, self.every)


class ReplanningController:
    """One episode of `Replanning`; ends where its first look gives no plan."""

    rate_hz = None

    def __init__(self, policy: KeypointPolicy, every: int):
        self._policy, self._every = policy, every
        self._actions: FloatArray = np.zeros((0, ACTION_DIM))
        self._next, self._round = 0, 0

    def act(self, observation: Observation, action: FloatArray) -> FloatArray | None:
        ended = self._next >= len(self._actions)
        if ended and self._round == ROUNDS:
            return None
        if ended or not (action[STATE_INDEX::ACTION_DIM] > 0.5).any():
            plan = self._plan(observation)
            if plan is not None:
                self._actions = plan.trajectory.actions
                self._next = 0 if ended else min(self._nearest(action), len(self._actions) - 1)
            elif ended:
                return None
        waypoints = self._actions[self._next : self._next + self._every]
        if ended:
            self._round += 1
            waypoints = np.concatenate([_above(action, waypoints[0])[None], waypoints])
        self._next += self._every
        return waypoints

    def _plan(self, observation: Observation) -> Plan | None:
        try:
            return self._policy.plan(observation)
        except UNPLANNABLE:
            return None

    def _nearest(self, action: FloatArray) -> int:
        """The waypoint after the one nearest to the grippers, among those within ``every`` of the next."""
        first = min(max(self._next - self._every, 0), len(self._actions) - 1)
        near = self._actions[first : self._next + self._every]
        return first + 1 + int(np.linalg.norm(near - action, axis=1).argmin())


def _above(action: FloatArray, first: FloatArray) -> FloatArray:
    """``action`` with the gripper states of the ``first`` waypoint, raised to its height where that is higher."""
    raised = action.reshape(-1, ACTION_DIM).copy()
    raised[:, STATE_INDEX] = first[STATE_INDEX::ACTION_DIM]
    lift = np.maximum(first.reshape(-1, ACTION_DIM)[:, Z] - raised[:, Z], 0).max(axis=1, keepdims=True)
    raised[:, Z] += lift
    return raised.reshape(-1)
