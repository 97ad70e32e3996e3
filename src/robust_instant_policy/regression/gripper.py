"""A robust trajectory for a gripper: rigid at every step, with a state that is open or closed and does not chatter."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.checks import check_name, checked_array, checked_positive, checked_whole
from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.geometry import FloatArray, GripperTriangle
from robust_instant_policy.regression.candidates import Candidates, group_matrix
from robust_instant_policy.regression.diagnosis import judge, scaled_residuals
from robust_instant_policy.regression.em import DEFAULT_DOF
from robust_instant_policy.regression.mixture import StudentTMixture
from robust_instant_policy.regression.modes import share_at_ties
from robust_instant_policy.regression.network import StudentTNetwork
from robust_instant_policy.regression.numbers import StudentTNumbers
from robust_instant_policy.regression.student_t import StudentTRegression, checked_curvature
from robust_instant_policy.regression.uncertainty import confidence
from robust_instant_policy.regression.viterbi import viterbi
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX

TRANSITION_COST = 0.55  # votes, of all at one step, that a change of state must win: a single step never does
STATE_SCALE = 1 / 7  # scale of the gripper state: wrong for four steps it is a hallucination, for fewer a late change
TOLERANCE_M = 0.015  # a gripper this far off still grasps
PAPER_NETWORKS = {"network-sim": "sim", "network-real": "real"}  # estimator to column of the paper's Table II
PAPER_ESTIMATORS = ("em-number", *PAPER_NETWORKS)  # fitted to every number, the gripper state too, as in the paper
ESTIMATORS = ("em", *PAPER_ESTIMATORS, "network", "mixture", "median", "mean")


@dataclass(frozen=True, eq=False)
class RobustTrajectory:
    """What Q candidates for A arms agree on.

    ``actions (T, 10·A)`` is a rigid gripper at every step (lengths exact) with state 0 or 1; ``times (T,)`` in [0, 1];
    ``scale (T, 10·A)`` is the spread of trustworthy candidates about it, of the state the share that disagrees;
    ``weights (Q, T)`` in [0, 1], low = ignored. ``scores (Q,)``, ``hallucinated (Q,)``, ``onset (Q,)`` (the candidate's
    own step, -1 if it is not hallucinated) and ``dimensions`` are its diagnosis. ``confidence`` in [0, 1] is how
    probably every point lies within ``tolerance`` of the truth, at the step where that is least so; 0 where two
    groups of candidates of the same size disagree.
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
    curvature: ArrayLike | None = None,
    variation: ArrayLike | None = None,
    *,
    bends: ArrayLike | None = None,
) -> RobustTrajectory:
    """The robust gripper trajectory of ``candidates``, each ``(T_q, 10·A)``: three points (m) and the state, per arm.

    ``estimator`` is "em" (`StudentTRegression`); one of `PAPER_ESTIMATORS`: the paper's mean of every number, the
    gripper state included, by networks trained by a column of its Table II or fitted exactly (`StudentTNumbers`);
    "network", the paper's networks with a faster training; "mixture" (one whole way of several); or "mean" or "median"
    of each number at each step, as references. Rotation and state are made rigid and 0 or 1 in every case, which an
    arm needs. ``dof`` = inf is the Gaussian ablation of any of them. ``times`` are the candidates' own,
    within [0, 1], evenly spread by default; the result has ``num_steps`` steps, by default the median of the
    candidates'. ``triangle`` is the gripper, by default measured from the candidates. ``seed`` is the network's.
    ``tolerance``, metres, is what `RobustTrajectory.confidence` is about. ``curvature (B,)``, metres, is the expected
    standard deviation of the points' second differences (see `StudentTRegression`); only "em" uses it. ``variation
    (V,)``, metres and evenly spread over time, is how far demonstrations differ along the way: a candidate that is off
    by less is not called hallucinated. The trajectory does not depend on it. ``bends`` is the old name of curvature.
    """
    dof, seed = checked_positive("dof", dof, infinite=True), checked_whole("seed", seed)
    check_name("estimator", estimator, ESTIMATORS)
    tolerance, expected = checked_positive("tolerance", tolerance), checked_curvature(curvature, bends)
    usual = None if variation is None else _checked_variation(variation)
    if not isinstance(triangle, GripperTriangle | None):
        raise InvalidValueError(f"triangle must be a GripperTriangle, got {type(triangle).__name__}")
    data = Candidates.from_arrays(candidates, times)
    if data.num_dimensions % ACTION_DIM:
        raise InvalidValueError(
            f"candidates must be (T_q, {ACTION_DIM}·A), got shape {data.values[: data.starts[1]].shape} for the first"
        )
    count = int(np.median(data.lengths)) if num_steps is None else checked_whole("num_steps", num_steps, 1)
    at = np.linspace(0.0, 1.0, count)
    is_state = np.arange(data.num_dimensions) % ACTION_DIM == STATE_INDEX

    # 1. Fit the points: where the grippers go, and how much each candidate counts.
    points = Candidates(data.values[:, ~is_state], data.times, data.starts)
    fit, residuals = _fit_points(points, dof, estimator, seed, expected, usual)
    by_number = _fit_numbers(data, dof, estimator, seed)
    clocks = data.split(data.times)
    counted = fit.weights if by_number is None else by_number.weights
    weights = np.stack([np.interp(at, clock, weight) for clock, weight in zip(clocks, counted, strict=True)])
    share = _share_at_ties(points, at, tolerance)
    if estimator != "mean":
        weights = np.minimum(weights, share)
    if by_number is not None:
        mean = by_number.mean(at)[:, ~is_state]
    else:
        mean = np.median(points.at(at), axis=0) if estimator == "median" else fit.mean(at)

    # 2. Vote on the states, with these weights.
    closed = data.values[:, is_state] > 0.5  # (N, A)
    votes = np.stack([_nearest_in_time(at, c, own) for c, own in zip(clocks, data.split(closed), strict=True)])
    each = weights[..., None]  # (Q, T, 1)
    if by_number is not None:
        state = by_number.mean(at)[:, is_state] > 0.5
    else:
        # the cost keeps out a change for a single step, even a unanimous one
        cost = TRANSITION_COST * float(weights.sum(axis=0).mean())
        state = viterbi(np.where(votes, each, -each).sum(axis=0).T, cost).T

    # 3. What the arm executes: rigid grippers, open or closed.
    actions, scale = np.empty((count, data.num_dimensions)), np.empty((count, data.num_dimensions))
    actions[:, ~is_state], actions[:, is_state] = _rigid(mean, points.values, triangle), state
    scale[:, ~is_state] = fit.scale(at)
    scale[:, is_state] = (each * (votes != state)).sum(axis=0) / np.maximum(each.sum(axis=0), 1e-12)

    # 4. Which candidates leave the agreement.
    scaled = np.empty_like(data.values)
    scaled[:, ~is_state] = residuals
    scaled[:, is_state] = (closed != _nearest_in_time(data.times, at, state)) / STATE_SCALE
    verdict = judge(data.split(scaled))
    return RobustTrajectory(
        actions,
        at,
        scale,
        weights,
        verdict.scores,
        verdict.hallucinated,
        verdict.onset,
        verdict.dimensions,
        0.0 if (share < 1).any() else confidence(fit.standard_error(at), weights, tolerance),
    )


def _rigid(mean: FloatArray, measured: FloatArray, triangle: GripperTriangle | None) -> FloatArray:
    """The points ``mean (T, 9·A)`` of rigid grippers of the shape ``triangle``, or else as ``measured (N, 9·A)``."""
    num_arms, rigid = mean.shape[1] // STATE_INDEX, []
    for triplets, own in zip(np.split(mean, num_arms, axis=1), np.split(measured, num_arms, axis=1), strict=True):
        known = triangle or GripperTriangle.from_triplets(own.reshape(-1, 3, 3))
        rigid.append(known.triplets(known.poses(triplets.reshape(-1, 3, 3))).reshape(triplets.shape))
    return np.concatenate(rigid, axis=1)


def _fit_points(
    points: Candidates,
    dof: float,
    estimator: str,
    seed: int,
    curvature: FloatArray | None,
    variation: FloatArray | None,
) -> tuple[StudentTRegression | StudentTNetwork | StudentTMixture, FloatArray]:
    """The fitted regression, and each candidate's residuals ``(N, D)`` about the way it goes."""
    rows, clocks = points.split(points.values), points.split(points.times)
    one_group = np.zeros(points.num_dimensions)  # coordinates share one scale: the choice of axes does not matter
    if estimator == "mixture":
        mixture = StudentTMixture(dof, groups=one_group).fit(rows, clocks)
        own = np.maximum(mixture.labels, 0)[points.owners]
        by_mode = np.stack([scaled_residuals(mode, points, variation) for mode in mixture.modes])
        return mixture, by_mode[own, np.arange(len(own))]
    fit: StudentTRegression | StudentTNetwork
    if estimator == "network":
        fit = StudentTNetwork(dof, seed=seed).fit(rows, clocks)
    else:  # of estimators that follow each number by itself, for scale, diagnosis and confidence
        fit = StudentTRegression(dof, groups=one_group, curvature=curvature).fit(rows, clocks)
    return fit, scaled_residuals(fit, points, variation)


def _fit_numbers(data: Candidates, dof: float, estimator: str, seed: int) -> StudentTNumbers | StudentTNetwork | None:
    """The regression of every number whose mean is followed; None for estimators that fit points."""
    rows, clocks = data.split(data.values), data.split(data.times)
    if estimator in PAPER_NETWORKS:
        return StudentTNetwork(dof, PAPER_NETWORKS[estimator], seed).fit(rows, clocks)
    if estimator in ("em-number", "mean"):
        return StudentTNumbers(np.inf if estimator == "mean" else dof).fit(rows, clocks)
    return None


def _share_at_ties(points: Candidates, at: FloatArray, tolerance: float) -> FloatArray:
    """`share_at_ties` ``(T,)``; two candidates tie where some point is beyond ``tolerance`` of the middle of both."""
    if len(points) != 2:
        return share_at_ties(points, group_matrix(np.zeros(points.num_dimensions), points.num_dimensions), at)
    one, other = points.at(at)
    apart = np.linalg.norm((one - other).reshape(len(at), -1, 3), axis=-1).max(axis=1)
    return np.where(apart > 2 * tolerance, 0.5, 1.0)


def _checked_variation(variation: ArrayLike) -> FloatArray:
    values = checked_array("variation", variation, "(V,)")
    if not len(values) or not (values >= 0).all():
        raise InvalidValueError(f"variation must be (V,), finite and not negative, got {values}")
    return values


def _nearest_in_time(at: FloatArray, times: FloatArray, values: np.ndarray) -> np.ndarray:
    """``values (T,)`` of the sample nearest in ``times (T,)`` to each of ``at (M,)``."""
    return values[np.searchsorted((times[1:] + times[:-1]) / 2, at)]
