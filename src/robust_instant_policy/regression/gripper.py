"""A robust trajectory for a gripper: rigid at every step, with a state that is open or closed and does not chatter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.errors import InvalidValueError, UnknownNameError
from robust_instant_policy.geometry import FloatArray, GripperTriangle
from robust_instant_policy.regression.alignment import Candidates
from robust_instant_policy.regression.diagnosis import confidence, judge, scaled_residuals
from robust_instant_policy.regression.mixture import StudentTMixture
from robust_instant_policy.regression.network import StudentTNetwork
from robust_instant_policy.regression.student_t import DEFAULT_DOF, StudentTRegression
from robust_instant_policy.regression.switching import persistent

ARM_DIM = 10  # palm xyz, two fingertips xyz, gripper state
POINT_DIM = 9
SWITCH_COST = 0.55  # votes, of all at one step, that a change of state must win: a blip of one step never does
STATE_SCALE = 1 / 7  # a gripper state wrong for four steps is a hallucination, for fewer it is a matter of timing
TOLERANCE_M = 0.015  # a gripper this far off still grasps
NETWORKS = {"network": "fast", "network-sim": "sim", "network-real": "real"}  # and the recipe that each is trained by
ESTIMATORS = ("em", *NETWORKS, "mixture", "median")


@dataclass(frozen=True, eq=False)
class RobustTrajectory:
    """What Q candidates for A arms agree on.

    ``actions (T, 10·A)`` is a rigid gripper at every step (lengths exact) with state 0 or 1; ``times (T,)`` in [0, 1];
    ``scale (T, 10·A)`` is the spread of trustworthy candidates about it, of the state the share that disagrees;
    ``weights (Q, T)`` in [0, 1], low = ignored. ``scores (Q,)``, ``hallucinated (Q,)``, ``onset (Q,)`` (the candidate's
    own step, -1 if it is not hallucinated) and ``dimensions`` are its diagnosis. ``confidence`` in [0, 1] is how
    probably every point lies within ``tolerance`` of the truth, at the step where that is least so.
    """

    actions: FloatArray
    times: FloatArray
    scale: FloatArray
    weights: FloatArray
    scores: FloatArray
    hallucinated: np.ndarray
    onset: np.ndarray
    dimensions: tuple[tuple[int, ...], ...]
    confidence: float


def robust_gripper_trajectory(
    candidates: Sequence[ArrayLike],
    dof: float = DEFAULT_DOF,
    estimator: str = "em",
    times: Sequence[ArrayLike] | None = None,
    num_steps: int | None = None,
    seed: int = 0,
    triangle: GripperTriangle | None = None,
    tolerance: float = TOLERANCE_M,
    bends: ArrayLike | None = None,
    variation: ArrayLike | None = None,
) -> RobustTrajectory:
    """The robust gripper trajectory of ``candidates``, each ``(T_q, 10·A)``: palm, two fingertips (m), state, per arm.

    ``estimator`` is "em", "network" (the paper's; "network-sim" and "network-real" train it exactly by the columns of
    its parameter table), "mixture" (one whole way of several) or "median" (of each number at each step, as a
    reference); ``dof`` = inf is the Gaussian ablation, the mean of the candidates. ``times`` are the candidates' own,
    within [0, 1], evenly spread by default; the result has ``num_steps`` steps, by default the median of the
    candidates'. ``triangle`` is the gripper, by default measured from the candidates. ``seed`` is the network's.
    ``tolerance``, metres, is what `RobustTrajectory.confidence` is about. ``bends (B,)``, metres, say how sharply such
    a gripper's points turn (see `StudentTRegression`); only "em" asks for them. ``variation (V,)``, metres and evenly
    spread over time as well, is how far demonstrations differ along the way (see `InContextPrompt`): who strays by less
    is not called hallucinated. The trajectory does not depend on it.
    """
    if estimator not in ESTIMATORS:
        raise UnknownNameError("estimator", estimator, ESTIMATORS)
    data = Candidates.from_arrays(candidates, times)
    if data.num_dimensions % ARM_DIM:
        raise InvalidValueError(
            f"candidates must be (T_q, {ARM_DIM}·A), got shape {data.values[: data.starts[1]].shape} for the first"
        )
    count = int(np.median(data.lengths)) if num_steps is None else num_steps
    if count < 1:
        raise InvalidValueError(f"num_steps must be at least 1, got {num_steps}")
    at = np.linspace(0.0, 1.0, count)
    is_state = np.arange(data.num_dimensions) % ARM_DIM == POINT_DIM
    points = Candidates(data.values[:, ~is_state], data.times, data.starts)
    fit, residuals = _fit_points(points, dof, estimator, seed, bends, _checked(variation))
    clocks = data.split(data.times)
    weights = np.stack([np.interp(at, clock, weight) for clock, weight in zip(clocks, fit.weights, strict=True)])

    actions, scale = np.empty((count, data.num_dimensions)), np.empty((count, data.num_dimensions))
    mean = np.median(points.at(at), axis=0) if estimator == "median" else fit.mean(at)
    scale[:, ~is_state] = fit.scale(at)
    shown = np.zeros_like(data.values)
    shown[:, ~is_state] = residuals
    for arm, column in enumerate(np.flatnonzero(is_state)):
        place = slice(column - POINT_DIM, column)
        triplets = mean[:, arm * POINT_DIM : (arm + 1) * POINT_DIM].reshape(count, 3, 3)
        known = triangle or GripperTriangle.from_triplets(data.values[:, place].reshape(-1, 3, 3))
        actions[:, place] = known.triplets(known.poses(triplets)).reshape(count, POINT_DIM)
        closed = data.values[:, column] > 0.5
        votes = np.stack([_held(c, state, at) for c, state in zip(clocks, data.split(closed), strict=True)])
        state = steady_state(votes, weights)
        actions[:, column] = state
        scale[:, column] = (weights * (votes != state)).sum(axis=0) / np.maximum(weights.sum(axis=0), 1e-12)
        shown[:, column] = (closed != _held(at, state, data.times)) / STATE_SCALE
    verdict = judge(data.split(shown))
    return RobustTrajectory(
        actions,
        at,
        scale,
        weights,
        verdict.scores,
        verdict.hallucinated,
        verdict.onset,
        verdict.dimensions,
        confidence(fit.standard_error(at), weights, tolerance),
    )


def _fit_points(
    points: Candidates,
    dof: float,
    estimator: str,
    seed: int,
    bends: ArrayLike | None,
    variation: FloatArray | None,
) -> tuple[StudentTRegression | StudentTNetwork | StudentTMixture, FloatArray]:
    """The fitted regression, and each candidate's residuals ``(N, D)`` about the way it goes."""
    rows, clocks = points.split(points.values), points.split(points.times)
    alike = np.zeros(points.num_dimensions)  # coordinates share one scale, so that the choice of axes does not matter
    if estimator == "mixture":
        mixture = StudentTMixture(dof, groups=alike).fit(rows, clocks)
        own = np.maximum(mixture.labels, 0)[points.owners]
        by_mode = [np.concatenate(scaled_residuals(mode, points, variation)) for mode in mixture.modes]
        return mixture, np.stack(by_mode)[own, np.arange(len(own))]
    fit: StudentTRegression | StudentTNetwork
    if estimator in NETWORKS:
        fit = StudentTNetwork(dof, NETWORKS[estimator], seed).fit(rows, clocks)
    else:
        fit = StudentTRegression(dof, groups=alike, bends=bends).fit(rows, clocks)
    return fit, np.concatenate(scaled_residuals(fit, points, variation))


def _checked(variation: ArrayLike | None) -> FloatArray | None:
    if variation is None:
        return None
    values = np.asarray(variation, dtype=np.float64)
    if values.ndim != 1 or not len(values) or not (np.isfinite(values) & (values >= 0)).all():
        raise InvalidValueError(f"variation must be (V,), finite and not negative, got {values}")
    return values


def steady_state(votes: np.ndarray, weights: FloatArray) -> np.ndarray:
    """Gripper state ``(T,)``, whether closed, that weighted ``votes (Q, T)`` elect, with a price on every change.

    The price keeps the changes in their order and a blip of a single step out, even a unanimous one.
    """
    majority = np.where(votes, weights, -weights).sum(axis=0)
    return persistent(majority, SWITCH_COST * float(weights.sum(axis=0).mean()))


def _held(clock: FloatArray, state: np.ndarray, at: FloatArray) -> np.ndarray:
    """The state ``(M,)`` at times ``at``: that of the sample nearest in time."""
    return state[np.searchsorted((clock[1:] + clock[:-1]) / 2, at)]
