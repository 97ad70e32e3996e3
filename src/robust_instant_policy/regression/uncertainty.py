"""How far the robust trajectory may be from the truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression.basis import FAINT, multiply_banded, solve_banded
from robust_instant_policy.regression.diagnosis import small_sample_factor

if TYPE_CHECKING:
    from robust_instant_policy.regression.student_t import PenalisedLikelihood, State

MIN_SLOPE = 0.2  # curvature of the likelihood, against w, that is still believed
ALONE = 1.5  # effective candidates below which a step is decided by one, whose error nobody can see: it gets the scale
POOLED_STEPS = 2  # neighbours on either side over which errors are averaged


def squared_error(model: PenalisedLikelihood, state: State) -> tuple[FloatArray, FloatArray]:
    """Expected squared error of the curve ``(K, D)``, and the number of candidates ``(K,)`` that decide it.

    The scatter of the candidates' pulls, each as a whole, so that errors that wander along a candidate count in
    full; plus what smoothing moved the curve beyond what it took out of that scatter, its bias (the smoothness that is
    known beforehand has none). A residual shows less than the error: the mean of n candidates moves with each of them
    (n - 1) / n; and moves more than w says, because w falls with the residual: the curvature of the likelihood is
    w (1 - 2/p · δ² / (ν + δ²)).
    """
    distance = model.distance(state)
    weights = model.weights(state)
    shared = len(state.squared_scale) * (model.data.lengths.mean() if model.unit == "trajectory" else 1)
    slope = 1 - 2 / shared * (weights @ (distance / (model.dof + distance))) / weights.sum()
    deciding = model.deciding(state)
    inflation = small_sample_factor(deciding) / max(slope, MIN_SLOPE) ** 2

    normal, pulls = model.pulls(state)
    flat = pulls.reshape(len(pulls), -1)
    acceleration = model.acceleration(state)
    bands = normal + model.price_matrix(state.squared_scale, acceleration, model.stiffness)
    smoothed = solve_banded(bands, flat).reshape(pulls.shape)
    error = inflation[:, None] * (smoothed**2).sum(axis=1)
    if model.stiffness:
        known = model.price_matrix(state.squared_scale, acceleration, 0.0)
        faint = normal + known + model.roughness.matrix(np.full(model.roughness.count, FAINT))
        unsmoothed = solve_banded(faint, flat).reshape(pulls.shape)
        moved = solve_banded(faint, pulls.sum(axis=1) - multiply_banded(known, state.curve)) ** 2
        removed = inflation[:, None] * ((unsmoothed - smoothed) ** 2).sum(axis=1)
        error += np.maximum(_pooled((moved - removed) @ model.groups), 0.0)
    error = _pooled(error @ model.groups)
    if model.straightness.any():  # where the curve goes on as expected nothing scatters, and yet it may be wrong
        unsure = np.diag(solve_banded(bands, np.eye(len(bands[0]))))
        error = np.maximum(error, unsure[:, None] * state.squared_scale)
    alone = deciding < ALONE
    error[alone] += (state.profile[:, None] * state.squared_scale)[alone]
    return error, deciding


def _pooled(rows: FloatArray) -> FloatArray:
    """Means ``(K, D)`` of ``rows (K, D)`` over each one and its neighbours."""
    sums = np.concatenate([np.zeros((1, rows.shape[1])), np.cumsum(rows, axis=0)])
    index = np.arange(len(rows))
    last, first = np.minimum(index + POOLED_STEPS + 1, len(rows)), np.maximum(index - POOLED_STEPS, 0)
    return (sums[last] - sums[first]) / (last - first)[:, None]
