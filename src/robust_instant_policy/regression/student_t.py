"""Student's t-regression over time by expectation-maximisation (Oh et al. 2025, Eq. 1-4).

The paper fits the mean and the scale of a Student's t-distribution to the candidates with two networks and Adam. The
same likelihood (Eq. 2) has a closed expectation-maximisation, also known as iteratively reweighted least squares
(Lange, Little and Taylor 1989): a t-distributed sample is a Gaussian one whose precision was multiplied by an unknown
u ~ Gamma(ν/2, ν/2). Given the fit, u is expected to be

    w = (ν + 1) / (ν + δ²),    δ² = (a - μ(t))² / σ²(t),

and given w the fit is weighted least squares. Samples far from the rest get w near 0: they are ignored.

Numbers that are right or wrong together share one u. With p of them u ~ Gamma(pν/2, pν/2): w is the same formula with
δ² their mean, and ν goes on meaning what it means in the paper. (With ν itself, the likelihood of p numbers would have
no maximum for Q - 1 < p/ν: it grows without bound as the fit shrinks onto a single candidate.)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaln

from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression.alignment import Candidates, checked_dof
from robust_instant_policy.regression.basis import HatBasis, Roughness, solve_banded

DEFAULT_DOF = 1.5  # the paper's ν
MAX_ITERATIONS = 100
TOLERANCE = 1e-5  # of log-likelihood per sample: below this gain an iteration changes nothing that a robot could feel
SCALE_FLOOR = 1e-9  # of the data's extent: candidates that agree to the last digit still have a likelihood
PRIOR_SAMPLES = 2.0  # candidates' worth of trust in the pooled scale, against that of one step alone
PAIRWISE_LIMIT = 4_000_000  # numbers compared pair by pair to find a start; beyond it, there are enough for a median


def log_density(distance: FloatArray, log_scale: FloatArray, dof: float, shared: int = 1) -> FloatArray:
    """Log of the t-density at mean squared ``distance`` δ² of ``shared`` numbers with one u (Eq. 1 for one number).

    ``log_scale`` is the sum of log σ over those numbers; ``dof`` = inf is the Gaussian.
    """
    if np.isinf(dof):
        return -0.5 * shared * (distance + np.log(2 * np.pi)) - log_scale
    constant = gammaln(shared * (dof + 1) / 2) - gammaln(shared * dof / 2) - 0.5 * shared * np.log(shared * dof * np.pi)
    return constant - log_scale - 0.5 * shared * (dof + 1) * np.log1p(distance / dof)


def expected_precision(distance: FloatArray, dof: float) -> FloatArray:
    """E-step: the expected precision w of samples at mean squared ``distance`` δ²; 1 everywhere for ``dof`` = inf."""
    if np.isinf(dof):
        return np.ones_like(distance)
    return (dof + 1) / (dof + distance)


class StudentTRegression:
    """Robust trajectory of Q candidates that ignores the hallucinated ones (Oh et al. 2025, Algorithm 1, lines 4-5).

    >>> fit = StudentTRegression(dof=1.5).fit([a_1, ..., a_Q])      # each (T_q, D)
    >>> fit.mean(times), fit.scale(times), fit.weights              # (T, D), (T, D), list of (T_q,)

    ``dof`` is the paper's ν; ``inf`` is the Gaussian ablation, whose mean is the mean of the candidates.
    ``groups (D,)`` are labels of the dimensions that share one scale, such as the coordinates of points, which makes
    the fit independent of the choice of axes; without it each dimension has its own.

    After `fit`: ``knots (K,)``, ``weights``, ``log_likelihood`` (one value an iteration, never falling), ``converged``
    and ``num_iterations``.
    """

    def __init__(self, dof: float = DEFAULT_DOF, groups: ArrayLike | None = None):
        self.dof = checked_dof(dof)
        self.groups = None if groups is None else np.asarray(groups)

    def fit(self, candidates: Sequence[ArrayLike], times: Sequence[ArrayLike] | None = None) -> StudentTRegression:
        """Fit to ``candidates``, each ``(T_q, D)``, at ``times``, each ``(T_q,)`` in [0, 1] (evenly spread if None)."""
        data = Candidates.from_arrays(candidates, times)
        groups = self._group_matrix(data.num_dimensions)
        self.knots = data.grid()
        basis = HatBasis(self.knots, data.times)
        roughness = Roughness(self.knots)
        smoothing = np.full(roughness.count, 0.0 if basis.on_knots else 1e-6)
        curve, squared_scale = _start(data, self.knots, groups, self.dof)
        profile = np.ones(len(self.knots))
        dimension = data.num_dimensions
        samples = np.bincount(basis.nearest, minlength=len(self.knots)).astype(float)
        floor = squared_scale * SCALE_FLOOR
        trace: list[float] = []
        self.converged = False
        for _ in range(MAX_ITERATIONS):
            squares = (data.values - basis(curve)) ** 2
            relative = (squares / squared_scale).sum(axis=1)
            at_samples = profile[basis.nearest]
            distance = relative / at_samples / dimension
            log_scale = 0.5 * (dimension * np.log(at_samples) + np.log(squared_scale).sum())
            prior = PRIOR_SAMPLES * dimension * 0.5 * (np.log(profile) + 1 / profile).sum()
            trace.append(float(log_density(distance, log_scale, self.dof, dimension).sum() - prior))
            if len(trace) > 1 and trace[-1] - trace[-2] < TOLERANCE * len(data.values):
                self.converged = True
                break
            weights = expected_precision(distance, self.dof)
            squared_scale = (groups @ ((weights / at_samples) @ squares)) / len(data.values) + floor
            relative = (squares / squared_scale).sum(axis=1)
            shared = np.bincount(basis.nearest, weights * relative, len(self.knots)) / dimension
            profile = (shared + PRIOR_SAMPLES) / (samples + PRIOR_SAMPLES)
            precision = weights / profile[basis.nearest]
            bands = basis.normal_matrix(precision)
            bands += roughness.matrix(smoothing) if smoothing.any() else 0.0
            curve = solve_banded(bands, basis.project(precision[:, None] * data.values))
        self.num_iterations = len(trace)
        self.log_likelihood = np.array(trace)
        self.weights = data.split(np.minimum(expected_precision(distance, self.dof), 1.0))
        self._curve = curve
        self._scale = np.sqrt(profile[:, None] * squared_scale)
        return self

    def mean(self, times: ArrayLike | None = None) -> FloatArray:
        """The robust trajectory μ ``(T, D)`` at ``times (T,)``, by default at the knots (Oh et al. 2025, Eq. 4)."""
        return self._evaluate(self._curve, times)

    def scale(self, times: ArrayLike | None = None) -> FloatArray:
        """The scale σ ``(T, D)`` of trustworthy candidates about the mean at ``times (T,)``."""
        return self._evaluate(self._scale, times)

    def _evaluate(self, values: FloatArray, times: ArrayLike | None) -> FloatArray:
        if times is None:
            return values.copy()
        times = np.asarray(times, dtype=np.float64)
        if times.ndim != 1 or not np.isfinite(times).all():
            raise InvalidValueError(f"times must be (T,) and finite, got shape {times.shape}")
        return np.stack([np.interp(times, self.knots, column) for column in values.T], axis=1)

    def _group_matrix(self, dimension: int) -> FloatArray:
        """Averages over the dimensions of a group ``(D, D)``."""
        if self.groups is None:
            return np.eye(dimension)
        if self.groups.shape != (dimension,):
            raise InvalidValueError(f"groups must be ({dimension},), one label a dimension, got {self.groups.shape}")
        same = self.groups[:, None] == self.groups
        return same / same.sum(axis=1)


def _start(data: Candidates, knots: FloatArray, groups: FloatArray, dof: float) -> tuple[FloatArray, FloatArray]:
    """A first curve ``(K, D)`` near the densest candidates, and a first squared scale ``(D,)``."""
    blocks = data.at(knots)
    median = np.median(blocks, axis=0)
    deviation = np.abs(blocks - median)
    extent = np.abs(median).max(axis=0) + np.median(deviation, axis=(0, 1)) + 1e-100
    squared = groups @ np.median(1.5 * np.median(deviation, axis=0), axis=0) ** 2
    squared = np.maximum(squared, groups @ (SCALE_FLOOR * extent) ** 2)
    if np.isinf(dof) or blocks.size * len(blocks) > PAIRWISE_LIMIT:
        return median, squared
    gaps = ((blocks[:, None] - blocks[None]) ** 2 / squared).mean(axis=-1)
    support = expected_precision(gaps / 2, dof).sum(axis=1)
    support -= expected_precision(np.zeros(1), dof) * (len(blocks) > 1)  # not by itself
    support = support / support.sum(axis=0)
    return np.einsum("qk,qkd->kd", support, blocks), squared
