"""The likelihood that is fitted: Eq. 1 of the paper for curves in time, with priors on scale and curvature.

Of N samples a_n (D,) at times t_n, with one u for the D numbers of a step, the fit maximises

    Σ_n r_n log S(a_n | t_n; ν)                                          Eq. 1; σ²(t) = s · p(t), r_n: `Problem.trust`
    - D (ν_G+1)/2 Σ_k log(1 + λ g_k²/ν_G)                                second differences g, in scales: Student's t
    - D/2 Σ_k s̄ g_k²/b_k²                                                and Gaussian, where the curvature b is known
    - R/2 Σ_d f_d/s_d - D m/2 Σ_k (log p_k + 1/p_k)                      scale floor f, scale profile p near 1

over the curve, the squared scale s (D,) and its profile p (K,), where R is the sum of all r and m `PRIOR_SAMPLES`.
Each of the three updates of an iteration maximises its expected value, so that it never falls. (Only the scale's leaves
out `FAINT_PRICE`, where that applies.)
"""

from dataclasses import dataclass

import numpy as np

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression.candidates import Candidates
from robust_instant_policy.regression.curve import HatBasis, SecondDifferences, solve_banded
from robust_instant_policy.regression.em import (
    MAX_ITERATIONS,
    ROUNDING,
    SCALE_FLOOR,
    TOLERANCE,
    expected_precision,
    log_density,
)

PRIOR_SAMPLES = 2.0  # weight, in candidates, of the scale of all steps against that of one step
PAIRWISE_LIMIT = 4_000_000  # numbers compared pair by pair to find a start; beyond it there are enough for a median
CORNER_DOF = 2.0  # ν_G: most second differences are small, a few are corners, which are not smoothed
FAINT_PRICE = 1e-6  # on second differences, which ties down knots between which no candidate has a sample
STRAIGHT = 1e10  # times the precision of the data: at higher prices the curve is straight to every digit


@dataclass(frozen=True, eq=False)
class Fit:
    """What is estimated: the ``curve (K, D)`` and the squared scale, ``squared_scale (D,)`` times ``profile (K,)``.

    The rest follows from these: ``residuals (N, D)`` a - μ(t); ``distance (N,)`` δ², the mean of (a - μ(t))²/σ²(t) over
    the D numbers of a step; ``weights (N,)`` r w; ``curvature (K-2,)`` g², squared second differences in scales.
    """

    curve: FloatArray
    squared_scale: FloatArray
    profile: FloatArray
    residuals: FloatArray
    distance: FloatArray
    weights: FloatArray
    curvature: FloatArray


@dataclass(frozen=True, eq=False)
class Problem:
    """What is given: the samples, and how far each of them is trusted.

    ``groups (D, D)`` averages over dimensions with one scale. ``floor (D,)`` bounds the squared scale.
    ``known_precision (K-2,)`` is 1/b² of a known curvature. ``trust (N,)`` is r. ``stiffness`` is λ.
    ``fixed_scale (D,)`` is the squared scale where it is not estimated.
    """

    data: Candidates
    basis: HatBasis
    differences: SecondDifferences
    dof: float
    groups: FloatArray
    floor: FloatArray
    known_precision: FloatArray
    trust: FloatArray
    stiffness: float = 0.0
    fixed_scale: FloatArray | None = None


def pose_problem(data: Candidates, dof: float, groups: FloatArray, curvature: FloatArray | None) -> tuple[Problem, Fit]:
    """The problem for ``data`` and the fit to start from: a curve near the densest candidates.

    The first scale is that of the half of the candidates nearest to the median. ``curvature (B,)``, evenly spread over
    time, is the standard deviation of second differences between steps 1 / (B - 1) apart.
    """
    basis = HatBasis(data)
    differences = SecondDifferences(basis.knots)
    blocks = data.at(basis.knots)
    median = np.median(blocks, axis=0)
    deviation = np.median(np.abs(blocks - median), axis=0)
    floor = groups @ squared_scale_floor(median)
    squared = groups @ (1.5 * deviation.mean(axis=0)) ** 2 + floor
    curve = median
    if blocks.size * len(blocks) < PAIRWISE_LIMIT and len(blocks) > 1:
        gaps = ((blocks[:, None] - blocks[None]) ** 2 @ (1 / squared)) / len(squared)
        # the diagonal is taken out: a candidate does not support itself
        support = expected_precision(gaps / 2, dof).sum(axis=1) - expected_precision(np.zeros(1), dof)
        curve = np.einsum("qk,qkd->kd", support / support.sum(axis=0), blocks)

    precision = np.zeros(differences.count)
    if curvature is not None and differences.count:
        knots, known = basis.knots, np.linspace(0, 1, len(curvature))
        expected = np.interp(knots[1:-1], known, curvature) * (np.diff(knots).mean() * (len(curvature) - 1)) ** 2
        precision = expected**-2.0
    trust = np.ones(len(data.values))
    problem = Problem(data, basis, differences, dof, groups, floor, precision, trust)
    return problem, evaluate(problem, curve, squared, np.ones(len(basis.knots)))


def squared_scale_floor(curve: FloatArray) -> FloatArray:
    """The least squared scale ``(D,)`` about a ``curve (K, D)``: a thousandth of its motion, and rounding errors."""
    return (SCALE_FLOOR * np.ptp(curve, axis=0) + ROUNDING * np.abs(curve).max(axis=0) + 1e-100) ** 2


def mean_over_scale(squares: FloatArray, squared_scale: FloatArray) -> FloatArray:
    """Mean over the dimensions ``(N,)`` of ``squares (N, D)`` in units of ``squared_scale (D,)``."""
    # einsum, because products this thin are slower on several cores than on one
    return np.einsum("nd,d->n", squares, 1 / (squared_scale * len(squared_scale)))


def evaluate(problem: Problem, curve: FloatArray, squared_scale: FloatArray, profile: FloatArray) -> Fit:
    """The `Fit` of a curve and a scale: the E-step."""
    residuals = problem.basis.residuals(problem.data.values, curve)
    distance = mean_over_scale(residuals**2, squared_scale) / problem.basis.spread(profile)
    weights = problem.trust * expected_precision(distance, problem.dof)
    curvature = mean_over_scale(problem.differences(curve) ** 2, squared_scale)
    return Fit(curve, squared_scale, profile, residuals, distance, weights, curvature)


def prices(problem: Problem, squared_scale: FloatArray, curvature: FloatArray, normal: FloatArray) -> FloatArray:
    """Prices ``(K-2,)`` on squared second differences, in 1/σ²: known ones, and λ w_G with w_G the E-step's of g².

    They are bounded by the precision of the data, the diagonal of the ``normal`` matrix ``(3, K)``.
    """
    corners = problem.stiffness * expected_precision(problem.stiffness * curvature, CORNER_DOF)
    return np.minimum(known_prices(problem, squared_scale) + corners, STRAIGHT * normal[0].mean())


def known_prices(problem: Problem, squared_scale: FloatArray) -> FloatArray:
    """Prices ``(K-2,)`` of the known curvature, in 1/σ², and the faint one that makes the curve unique."""
    faint = 0.0 if problem.stiffness or problem.basis.on_knots else FAINT_PRICE
    return problem.known_precision * squared_scale.mean() + faint


def normal_equations(problem: Problem, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Normal matrix ``(3, K)`` of the least squares and the score contributions of the candidates ``(K, Q, D)``.

    Without a penalty the contributions of all candidates add up to 0.
    """
    precision = fit.weights / problem.basis.spread(fit.profile)
    return problem.basis.normal_matrix(precision), problem.basis.project_each(precision, fit.residuals)


def deciding_candidates(problem: Problem, fit: Fit) -> FloatArray:
    """How many candidates decide the curve at each knot ``(K,)``."""
    return effective_count(problem.basis.project_each(fit.weights, np.ones((len(fit.weights), 1)))[:, :, 0].T)


def effective_count(weights: FloatArray) -> FloatArray:
    """(Σ w)² / Σ w² ``(T,)``: how many candidates with ``weights (Q, T)`` decide."""
    return weights.sum(axis=0) ** 2 / np.maximum((weights**2).sum(axis=0), np.finfo(float).tiny)


def improve(problem: Problem, fit: Fit) -> Fit:
    """One iteration of expectation-maximisation: scale, profile and curve, each given the others, then w."""
    basis, differences = problem.basis, problem.differences
    squares = fit.residuals**2
    squared_scale = problem.fixed_scale
    if squared_scale is None:  # s = Σ w (a - μ)²/p / R, with its floor
        spread = np.einsum("n,nd->d", fit.weights / basis.spread(fit.profile), squares)
        squared_scale = problem.groups @ spread / problem.trust.sum() + problem.floor
    shared = basis.gather(fit.weights * mean_over_scale(squares, squared_scale))  # p = (Σ w δ² + m) / (Σ r + m)
    profile = (shared + PRIOR_SAMPLES) / (basis.gather(problem.trust) + PRIOR_SAMPLES)

    # The curve by weighted least squares. Solving for its change keeps the digits of large coordinates.
    precision = fit.weights / basis.spread(profile)
    matrix, score = basis.normal_matrix(precision), basis.project(precision, fit.residuals)
    price = prices(problem, squared_scale, fit.curvature, matrix)  # with a stiffness the scale is fixed
    if price.any():
        matrix += differences.penalty_matrix(price)
        score -= differences.transpose(price[:, None] * differences(fit.curve))
    return evaluate(problem, fit.curve + solve_banded(matrix, score), squared_scale, profile)


def log_likelihood(problem: Problem, fit: Fit) -> float:
    """The penalised log-likelihood that `improve` raises; the terms are those at the head of this file."""
    dimension, total_trust = len(fit.squared_scale), problem.trust.sum()
    total = problem.trust @ log_density(fit.distance, 0.0, problem.dof, dimension)
    log_profile = np.log(fit.profile)
    total -= 0.5 * dimension * (problem.basis.gather(problem.trust) @ log_profile)
    total -= 0.5 * total_trust * (np.log(fit.squared_scale) + problem.floor / fit.squared_scale).sum()
    total -= 0.5 * PRIOR_SAMPLES * dimension * (log_profile + 1 / fit.profile).sum()
    total -= 0.5 * dimension * (CORNER_DOF + 1) * np.log1p(problem.stiffness * fit.curvature / CORNER_DOF).sum()
    return float(total - 0.5 * dimension * (known_prices(problem, fit.squared_scale) @ fit.curvature))


def maximise(problem: Problem, fit: Fit) -> tuple[Fit, list[float]]:
    """Iterate until nothing is gained (Oh et al. 2025, Eq. 3); also the log-likelihood of every iteration.

    An iteration that loses has reached the limit of floating-point arithmetic and is not taken.
    """
    trace = [log_likelihood(problem, fit)]
    while len(trace) < MAX_ITERATIONS:
        improved = improve(problem, fit)
        value = log_likelihood(problem, improved)
        if value < trace[-1]:
            break
        fit = improved
        trace.append(value)
        if trace[-1] - trace[-2] < TOLERANCE * problem.data.values.size:
            break
    return fit, trace
