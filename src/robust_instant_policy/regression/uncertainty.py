"""How far the robust trajectory may be from the truth."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import convolve1d
from scipy.special import fdtr

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression.curve import multiply_banded, solve_banded
from robust_instant_policy.regression.likelihood import (
    FAINT_PRICE,
    Fit,
    Problem,
    deciding_candidates,
    effective_count,
    normal_equations,
    prices,
)

MIN_SLOPE = 0.2  # curvature of the likelihood, against w, that is still believed
ALONE = 1.5  # deciding candidates below which a step is decided by one, whose error cannot be seen: it gets the scale
POOLED_STEPS = 2  # neighbours on either side over which errors are averaged
FREEDOM_PER_CANDIDATE = (
    4.0  # degrees of freedom of errors pooled over steps and dimensions; set so that intervals cover
)
MIN_FREEDOM = 0.25  # candidates beyond the first, at least, that an error is estimated from
MAJORITY = 0.5  # share of the candidates that must agree before their agreement counts in full
COORDINATES = 3.0  # a point is off in three directions at once


def squared_error(problem: Problem, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Expected squared error of the curve ``(K, D)``, and the number of candidates ``(K,)`` that decide it.

    With c_q the score contribution of candidate q, A the normal matrix and P that of the penalty,

        error² = n/(n-1) · Σ_q ((A + P)⁻¹ c_q)² / slope² + bias²

    The contributions count each candidate as a whole, so that errors correlated along a candidate count in full. Of
    n deciding candidates a residual shows (n-1)/n of the error. The likelihood is flatter than w says, because w
    falls with the residual: slope = 1 - 2/p · E[δ²/(ν+δ²)]. The bias is what smoothing moved the curve by, beyond what
    it took out of the scatter; a known curvature has none.
    """
    differences = problem.differences
    outlying = fit.distance / (problem.dof + fit.distance)
    slope = 1 - 2 / problem.data.num_dimensions * (fit.weights @ outlying) / fit.weights.sum()
    deciding = deciding_candidates(problem, fit)
    inflation = (small_sample_factor(deciding) / max(slope, MIN_SLOPE) ** 2)[:, None]

    bands, contributions = normal_equations(problem, fit)
    flat = contributions.reshape(len(contributions), -1)
    known = np.zeros_like(bands)
    if differences.count:
        unsmoothed_prices = prices(replace(problem, stiffness=0.0), fit.squared_scale, fit.curvature, bands)
        known = differences.penalty_matrix(unsmoothed_prices)
        faint = bands + known + differences.penalty_matrix(np.full(differences.count, FAINT_PRICE))
        bands = bands + differences.penalty_matrix(prices(problem, fit.squared_scale, fit.curvature, bands))
    smoothed = solve_banded(bands, flat).reshape(contributions.shape)
    error = inflation * (smoothed**2).sum(axis=1)
    if problem.stiffness:
        unsmoothed = solve_banded(faint, flat).reshape(contributions.shape)
        moved = solve_banded(faint, contributions.sum(axis=1) - multiply_banded(known, fit.curve)) ** 2
        removed = inflation * ((unsmoothed - smoothed) ** 2).sum(axis=1)
        error += np.maximum(_pooled((moved - removed) @ problem.groups), 0.0)
    error = _pooled(error @ problem.groups)
    if (
        problem.known_precision.any()
    ):  # where the curve follows the known curvature alone nothing scatters, and yet it may be wrong
        unsure = np.diag(solve_banded(bands, np.eye(len(bands[0]))))
        error = np.maximum(error, unsure[:, None] * fit.squared_scale)
    alone = deciding < ALONE
    error[alone] += (fit.profile[:, None] * fit.squared_scale)[alone]
    return error, deciding


def squared_scatter(problem: Problem, fit: Fit) -> FloatArray:
    """σ² ``(K, D)`` of trustworthy candidates about the truth: n/(n-1) times that about the fitted mean."""
    factor = small_sample_factor(deciding_candidates(problem, fit))
    return (fit.profile * factor)[:, None] * fit.squared_scale


def small_sample_factor(deciding: FloatArray) -> FloatArray:
    """n/(n-1): what squared residuals about a mean of n = ``deciding (T,)`` candidates lack of squared errors."""
    return deciding / np.maximum(deciding - 1, MIN_FREEDOM)


def error_freedom(deciding: FloatArray) -> FloatArray:
    """Degrees of freedom of an error that was estimated from ``deciding (T,)`` candidates."""
    return FREEDOM_PER_CANDIDATE * np.maximum(deciding - 1, MIN_FREEDOM)


def confidence(standard_error: FloatArray, weights: FloatArray, tolerance: float) -> float:
    """min_t P(|error_t| ≤ tolerance), of a point of the trajectory; 3 F(3, m)-distributed over the squared error.

    ``standard_error (T, D)`` is that of coordinates, in the unit of ``tolerance``; ``weights (Q, T)`` are those of the
    candidates. Where less than half of them agree the probability shrinks: it may be the wrong ones that agree.
    """
    if np.isinf(standard_error).any():
        return 0.0
    worst = np.maximum(standard_error.max(axis=1), np.finfo(float).eps * tolerance)
    freedom = error_freedom(effective_count(weights))
    within = fdtr(COORDINATES, freedom, (tolerance / worst) ** 2 / COORDINATES)
    return float((within * np.minimum(1.0, weights.mean(axis=0) / MAJORITY)).min())


def _pooled(rows: FloatArray) -> FloatArray:
    """Means ``(K, D)`` of ``rows (K, D)`` over each one and its neighbours."""
    window = np.ones(2 * POOLED_STEPS + 1)
    counts = convolve1d(np.ones((len(rows), 1)), window, axis=0, mode="constant")
    return convolve1d(rows, window, axis=0, mode="constant") / counts
