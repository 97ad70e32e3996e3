"""The paper's Student's t-regression of one number, and its expectation-maximisation (Oh et al. 2025, Eq. 1-4).

    Eq. 1   S(a | t; ν) = Γ((ν+1)/2) / (Γ(ν/2) √(νπσ²(t))) · {1 + (a - μ(t))² / (νσ²(t))}^(-(ν+1)/2)
    Eq. 2   L = Σ_q Σ_t -log S(a_t^q | t; ν)
    Eq. 3   μ, σ = argmin L
    Eq. 4   ξ_RIP = {μ(t)} for t = 1 … T

The paper minimises Eq. 2 over two networks by Adam. Expectation-maximisation reaches a minimum in closed steps (Lange,
Little and Taylor 1989): a t-distributed number is a Gaussian one of unknown precision,

    a | u ~ N(μ, σ²/u),   u ~ Gamma(ν/2, ν/2)   ⟹   u | a ~ Gamma((ν+1)/2, (ν+δ²)/2),   δ = (a - μ)/σ

    E-step   w = E[u | a] = (ν+1)/(ν+δ²)
    M-step   μ = Σ_q w a / Σ_q w,   σ² = Σ_q w (a - μ)² / Q

Numbers that are right or wrong together share one u. With p of them u ~ Gamma(pν/2, pν/2): w is the same formula with
δ² their mean. (With ν itself the likelihood of p numbers would be unbounded for Q - 1 < p/ν: it grows without limit as
the scale shrinks onto a single candidate.)
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaln

from robust_instant_policy.checks import checked_array, checked_positive
from robust_instant_policy.geometry import FloatArray

DEFAULT_DOF = 1.5  # the paper's ν
MAX_ITERATIONS = 200
TOLERANCE = 1e-6  # log-likelihood gained per number in an iteration, below which nothing moves noticeably
SCALE_FLOOR = 1e-3  # σ, of the motion: models that write few digits often agree to the last one
ROUNDING = 1e-12  # σ, of the largest number: differences below it are those of floating-point arithmetic


@dataclass(frozen=True, eq=False)
class Estimate:
    """The fitted ``mean (T,)`` μ, which is Eq. 4, and ``scale (T,)`` σ; ``weights (Q, T)`` w of every number."""

    mean: FloatArray
    scale: FloatArray
    weights: FloatArray


def log_density(
    distance: FloatArray, log_scale: FloatArray | float, dof: float, count: int | FloatArray = 1
) -> FloatArray:
    """log S of Eq. 1 at squared ``distance`` δ² = (a - μ)²/σ² and ``log_scale`` log σ (Oh et al. 2025, Eq. 1).

        log S = log Γ((ν+1)/2) - log Γ(ν/2) - ½ log(νπ) - log σ - (ν+1)/2 · log(1 + δ²/ν)

    For ``count`` p numbers that share one u, ν is pν, ν+1 is p(ν+1), δ² is their mean and log σ their sum.
    ``dof`` = inf is the Gaussian.
    """
    if np.isinf(dof):
        return -0.5 * count * (distance + np.log(2 * np.pi)) - log_scale
    constant = gammaln(count * (dof + 1) / 2) - gammaln(count * dof / 2) - 0.5 * count * np.log(count * dof * np.pi)
    return constant - log_scale - 0.5 * count * (dof + 1) * np.log1p(distance / dof)


def loss(actions: FloatArray, mean: FloatArray, scale: FloatArray, dof: float) -> float:
    """L = Σ_q Σ_t -log S(a_t^q | t; ν) of ``actions (Q, T)``, ``mean (T,)``, ``scale (T,)`` (Oh et al. 2025, Eq. 2)."""
    return float(-log_density(((actions - mean) / scale) ** 2, np.log(scale), dof).sum())


def expected_precision(distance: FloatArray, dof: float) -> FloatArray:
    """E-step: w = (ν+1)/(ν+δ²) at squared ``distance`` δ²; 1 everywhere for ``dof`` = inf."""
    if np.isinf(dof):
        return np.ones_like(distance)
    return (dof + 1) / (dof + distance)


def fit_numbers(actions: ArrayLike, dof: float = DEFAULT_DOF) -> Estimate:
    """Minimise Eq. 2 for one number, given by Q candidates at T steps: ``actions (Q, T)`` (Oh et al. 2025, Eq. 3).

    This is the paper's model and nothing else: every step has its own μ and σ; σ has a floor, without which L is
    unbounded below where most candidates coincide. `StudentTRegression` is the estimator to use.
    """
    values, dof = checked_array("actions", actions, "(Q, T)"), checked_positive("dof", dof, infinite=True)
    mean = np.median(values, axis=0)
    floor = SCALE_FLOOR * np.ptp(mean) + ROUNDING * np.abs(values).max() + np.finfo(float).tiny
    scale = np.maximum(np.median(np.abs(values - mean), axis=0), floor)
    previous = np.inf
    for _ in range(MAX_ITERATIONS):
        weights = expected_precision(((values - mean) / scale) ** 2, dof)
        current = loss(values, mean, scale, dof)
        if previous - current < TOLERANCE * values.size:
            break
        previous = current
        mean = (weights * values).sum(axis=0) / weights.sum(axis=0)
        scale = np.maximum(np.sqrt((weights * (values - mean) ** 2).mean(axis=0)), floor)
    return Estimate(mean, scale, weights)
