"""A robust trajectory for a gripper: rigid at every step, with a state that is open or closed and does not chatter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.errors import InvalidValueError, UnknownNameError
from robust_instant_policy.geometry import FloatArray, GripperTriangle
from robust_instant_policy.regression.alignment import Candidates
from robust_instant_policy.regression.diagnosis import diagnose
from robust_instant_policy.regression.mixture import StudentTMixture
from robust_instant_policy.regression.network import StudentTNetwork
from robust_instant_policy.regression.student_t import DEFAULT_DOF, StudentTRegression

ARM_DIM = 10  # palm xyz, two fingertips xyz, gripper state
POINT_DIM = 9
SWITCH_COST = 0.5  # of all votes at one step: a change of state must be worth more, so that a blip of one step is not
TOLERANCE_M = 0.015  # a gripper this far off still grasps: what `confidence` is about
ESTIMATORS = ("em", "network", "mixture", "median")


@dataclass(frozen=True, eq=False)
class RobustTrajectory:
    """What Q candidates for A arms agree on.

    ``actions (T, 10·A)`` is a rigid gripper at every step (lengths exact) with state 0 or 1; ``times (T,)`` in [0, 1];
    ``scale (T, 10·A)`` the spread of trustworthy candidates about it; ``weights (Q, T)`` in [0, 1], low = ignored.
    ``hallucinated (Q,)``, ``onset (Q,)`` (the candidate's own step, -1 if not hallucinated), ``dimensions`` and
    ``scores (Q,)`` are the diagnosis; ``confidence`` in [0, 1] is how sure the trajectory is at its least sure step.
    """

    actions: FloatArray
    times: FloatArray
    scale: FloatArray
    weights: FloatArray
    hallucinated: np.ndarray
    onset: np.ndarray
    dimensions: tuple[tuple[int, ...], ...]
    scores: FloatArray
    confidence: float


def robust_gripper_trajectory(
    candidates: Sequence[ArrayLike],
    dof: float = DEFAULT_DOF,
    estimator: str = "em",
    times: Sequence[ArrayLike] | None = None,
    num_steps: int | None = None,
    seed: int = 0,
    triangle: GripperTriangle | None = None,
) -> RobustTrajectory:
    """The robust gripper trajectory of ``candidates``, each ``(T_q, 10·A)``: palm, two fingertips (m), state, per arm.

    ``dof`` = inf is the Gaussian ablation (the mean of the candidates). ``times`` are the candidates' own, within
    [0, 1], evenly spread by default; the result has ``num_steps`` steps, by default the median of the candidates'.
    ``triangle`` is the gripper, by default measured from the candidates.
    """
    if estimator not in ESTIMATORS:
        raise UnknownNameError("estimator", estimator, ESTIMATORS)
    data = Candidates.from_arrays(candidates, times)
    if data.num_dimensions % ARM_DIM:
        raise InvalidValueError(f"candidates must be (T_q, {ARM_DIM}·A), got {data.num_dimensions} dimensions")
    count = int(np.median(data.lengths)) if num_steps is None else num_steps
    if count < 1:
        raise InvalidValueError(f"num_steps must be at least 1, got {num_steps}")
    at = np.linspace(0.0, 1.0, count)
    is_state = np.arange(data.num_dimensions) % ARM_DIM == POINT_DIM
    points = data.values[:, ~is_state]
    rows, clocks = data.split(points), data.split(data.times)
    groups = np.zeros(points.shape[1])
    fit: StudentTRegression | StudentTNetwork | StudentTMixture
    if estimator == "network":
        fit = StudentTNetwork(dof=dof, seed=seed).fit(rows, clocks)
    elif estimator == "mixture":
        fit = StudentTMixture(dof=dof, groups=groups).fit(rows, clocks)
    else:
        fit = StudentTRegression(dof=dof, groups=groups).fit(rows, clocks)
    mean, scale = fit.mean(at), fit.scale(at)
    if estimator == "median":
        mean = np.median(Candidates.from_arrays(rows, clocks).at(at), axis=0)
    weights = np.stack([np.interp(at, clock, weight) for clock, weight in zip(clocks, fit.weights, strict=True)])
    verdict = diagnose([(row - fit.mean(clock)) / fit.scale(clock) for row, clock in zip(rows, clocks, strict=True)])
    actions = np.empty((count, data.num_dimensions))
    spread = np.empty_like(actions)
    held = data.split(data.values)
    for arm in range(data.num_dimensions // ARM_DIM):
        place = slice(arm * ARM_DIM, arm * ARM_DIM + POINT_DIM)
        triplets = mean[:, arm * POINT_DIM : (arm + 1) * POINT_DIM].reshape(count, 3, 3)
        known = triangle or GripperTriangle.from_triplets(data.values[:, place].reshape(-1, 3, 3))
        actions[:, place] = known.triplets(known.poses(triplets)).reshape(count, POINT_DIM)
        spread[:, place] = scale[:, arm * POINT_DIM : (arm + 1) * POINT_DIM]
        votes = np.stack(
            [_held(clock, block[:, place.stop] > 0.5, at) for clock, block in zip(clocks, held, strict=True)]
        )
        actions[:, place.stop] = steady_state(votes, weights)
        spread[:, place.stop] = np.abs(votes - actions[:, place.stop]).mean(axis=0)
    error = spread[:, ~is_state].max(axis=1) / np.sqrt(np.maximum(weights.sum(axis=0), 1.0))
    support = np.minimum(1.0, 2 * weights.mean(axis=0)) if len(data) > 1 else np.zeros(count)
    confidence = float((support * np.exp(-0.5 * (error / TOLERANCE_M) ** 2)).min())
    return RobustTrajectory(
        actions,
        at,
        spread,
        weights,
        verdict.hallucinated,
        verdict.onset,
        verdict.dimensions,
        verdict.scores,
        confidence,
    )


def steady_state(votes: np.ndarray, weights: FloatArray) -> FloatArray:
    """Gripper state ``(T,)``, 0 or 1, closest to weighted ``votes (Q, T)`` with a cost for every change (Viterbi)."""
    closed = (weights * votes).sum(axis=0)
    total = weights.sum(axis=0)
    cost = SWITCH_COST * float(total.mean())
    gain = np.stack([total - closed, closed], axis=1)
    best = gain[0]
    came_from = np.zeros((len(gain), 2), dtype=np.intp)
    for step in range(1, len(gain)):
        switched = best[::-1] - cost > best
        came_from[step] = np.where(switched, [1, 0], [0, 1])
        best = gain[step] + np.where(switched, best[::-1] - cost, best)
    state = np.empty(len(gain))
    current = int(best[1] > best[0])
    for step in range(len(gain) - 1, -1, -1):
        state[step] = current
        current = came_from[step, current]
    return state


def _held(clock: FloatArray, state: np.ndarray, at: FloatArray) -> np.ndarray:
    """The state ``(M,)`` at times ``at``, held from each sample until the next."""
    return state[np.clip(np.searchsorted(clock, at + 1e-9, side="right") - 1, 0, len(state) - 1)]
