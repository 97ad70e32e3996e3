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
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaln, stdtrit

from robust_instant_policy.errors import InvalidValueError, UnknownNameError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression.alignment import Candidates, checked_dof, group_matrix
from robust_instant_policy.regression.basis import BANDS, FAINT, HatBasis, Roughness, solve_banded
from robust_instant_policy.regression.diagnosis import effective_count, error_freedom, small_sample_factor
from robust_instant_policy.regression.smoothing import choose_stiffness, smoothing_share
from robust_instant_policy.regression.switching import persistent
from robust_instant_policy.regression.uncertainty import squared_error

DEFAULT_DOF = 1.5  # the paper's ν
UNITS = ("step", "trajectory", "number")
MAX_ITERATIONS = 200
TOLERANCE = 1e-6  # log-likelihood gained per number: less in an iteration moves nothing that a robot could feel
DRAFT_ITERATIONS = 6  # of the fit without smoothing from which outlying stretches are judged,
REDRAFT_ITERATIONS = 3  # and more without those, from which the smoothing is
SCALE_FLOOR = 1e-3  # of a dimension's motion: models that write few digits often agree to the last one
ROUNDING = 1e-12  # of a dimension's size: below it differences are those of floating-point arithmetic
PRIOR_SAMPLES = 2.0  # candidates' worth of trust in the scale of all steps, against that of one step alone
PAIRWISE_LIMIT = 4_000_000  # numbers compared pair by pair to find a start; beyond it there are enough for a median

STANDS_OUT = 0.7  # -log w of a step from which it speaks against its candidate: about twice the scale
STRETCH_COST = 1.0  # such evidence needed to begin or end a stretch that is left out
LEFT_OUT = 1e-3  # weight of a sample in such a stretch; not 0, so that a step where all stand out still has a mean

CORNER_DOF = 2.0  # accelerations are Student-t as well: most steps go straight, some turn sharply and stay sharp


def log_density(distance: FloatArray, log_scale: FloatArray, dof: float, shared: int | FloatArray = 1) -> FloatArray:
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
    ``unit`` is what is right or wrong together: the numbers of a "step" (whose outlying stretches are then left out
    whole), those of a whole "trajectory", or every "number" by itself, as in the paper's Eq. 1, with ``groups`` unused.
    ``groups (D,)`` are labels of the dimensions that share one scale, such as the coordinates of points, which makes
    the fit independent of the choice of axes; without it each dimension has its own.
    ``bends (B,)``, evenly spread over time, say how sharply the true curve may be expected to turn: the standard
    deviation of a coordinate's second difference between steps 1 / (B - 1) apart. Where candidates disagree the curve
    then goes on as it came, where they agree it hardly matters. All dimensions must share one scale for that.

    After `fit`: ``knots (K,)``; ``weights``, Q arrays ``(T_q,)`` in [0, 1]; ``log_likelihood``, a value an iteration,
    never falling; ``converged`` and ``num_iterations``; ``stiffness``, the price on accelerations that was chosen.
    """

    def __init__(
        self,
        dof: float = DEFAULT_DOF,
        unit: str = "step",
        groups: ArrayLike | None = None,
        bends: ArrayLike | None = None,
    ):
        if unit not in UNITS:
            raise UnknownNameError("unit", unit, UNITS)
        self.dof = checked_dof(dof)
        self.unit = unit
        self.groups = groups
        self.bends = None if bends is None else _checked_bends(bends)

    def fit(self, candidates: Sequence[ArrayLike], times: Sequence[ArrayLike] | None = None) -> StudentTRegression:
        """Fit to ``candidates``, each ``(T_q, D)``, at ``times``, each ``(T_q,)`` in [0, 1] (evenly spread if None)."""
        data = Candidates.from_arrays(candidates, times)
        groups = group_matrix(self.groups, data.num_dimensions)
        if self.bends is not None and self.unit != "number" and not groups.all():
            raise InvalidValueError(f"bends need groups ({data.num_dimensions},) of one label: they are in one unit")
        if self.unit == "number":
            columns = np.arange(data.num_dimensions)[:, None]
            parts = [(replace(data, values=data.values[:, column]), column) for column in columns]
        else:
            parts = [(data, np.arange(data.num_dimensions))]
        self._parts = [
            _fit(part, self.dof, self.unit, groups[np.ix_(column, column)], self.bends) for part, column in parts
        ]
        self.knots = data.grid()
        self.stiffness = float(np.mean([part.model.stiffness for part in self._parts]))
        self.num_iterations = max(len(part.trace) for part in self._parts)
        self.converged = self.num_iterations < MAX_ITERATIONS
        self.log_likelihood = np.sum(
            [np.pad(part.trace, (0, self.num_iterations - len(part.trace)), "edge") for part in self._parts], axis=0
        )
        weights = np.mean([np.minimum(part.model.weights(part.state), 1.0) for part in self._parts], axis=0)
        self.weights = data.split(weights)
        return self

    def mean(self, times: ArrayLike | None = None) -> FloatArray:
        """The robust trajectory μ ``(T, D)`` at ``times (T,)``, by default at the knots (Oh et al. 2025, Eq. 4)."""
        return self._evaluate(np.hstack([part.state.curve for part in self._parts]), times)

    def scale(self, times: ArrayLike | None = None) -> FloatArray:
        """The scale σ ``(T, D)`` of trustworthy candidates about the truth at ``times (T,)``.

        The likelihood's σ is that about the fitted mean, which n candidates draw to themselves by n / (n - 1).
        """
        squared = [
            (part.state.profile * small_sample_factor(part.model.deciding(part.state)))[:, None]
            * part.state.squared_scale
            for part in self._parts
        ]
        return self._evaluate(np.sqrt(np.hstack(squared)), times)

    def standard_error(self, times: ArrayLike | None = None) -> FloatArray:
        """How far ``(T, D)`` the mean may be off at ``times (T,)``; infinite for a single candidate."""
        return self._evaluate(np.sqrt(self._error()[0]), times)

    def interval(self, level: float = 0.9, times: ArrayLike | None = None) -> tuple[FloatArray, FloatArray]:
        """Lower and upper ends, each ``(T, D)``, between which the truth lies with probability ``level``."""
        if not 0 < level < 1:
            raise InvalidValueError(f"level must lie between 0 and 1, got {level} (a scalar, shape ())")
        error, deciding = self._error()
        freedom = error_freedom(deciding)
        reach = self._evaluate(stdtrit(freedom, (1 + level) / 2)[:, None] * np.sqrt(error), times)
        mean = self.mean(times)
        return mean - reach, mean + reach

    def _error(self) -> tuple[FloatArray, FloatArray]:
        if len(self.weights) == 1:
            return np.full_like(self.mean(), np.inf), np.ones(len(self.knots))
        errors, deciding = zip(*[squared_error(part.model, part.state) for part in self._parts], strict=True)
        return np.hstack(errors), np.mean(deciding, axis=0)

    def _evaluate(self, values: FloatArray, times: ArrayLike | None) -> FloatArray:
        if times is None:
            return values.copy()
        times = np.asarray(times, dtype=np.float64)
        if times.ndim != 1 or not np.isfinite(times).all():
            raise InvalidValueError(f"times must be (T,) and finite, got shape {times.shape}")
        return np.stack([np.interp(times, self.knots, column) for column in values.T], axis=1)


@dataclass(frozen=True, eq=False)
class State:
    """What expectation-maximisation improves: the curve ``(K, D)`` and the squared scale, ``(D,)`` times ``(K,)``."""

    curve: FloatArray
    squared_scale: FloatArray
    profile: FloatArray


class _Part(NamedTuple):
    """The dimensions that were fitted together."""

    model: PenalisedLikelihood
    state: State
    trace: list[float]


def _fit(data: Candidates, dof: float, unit: str, groups: FloatArray, bends: FloatArray | None) -> _Part:
    model = PenalisedLikelihood(data, dof, unit, groups, bends)
    state = model.start()
    if np.isfinite(dof):
        for _ in range(DRAFT_ITERATIONS):
            state = model.improve(state)[0]
        if unit != "trajectory":
            model.leave_out_stretches(state)
            for _ in range(REDRAFT_ITERATIONS):
                state = model.improve(state)[0]
        model.stiffness = choose_stiffness(model, state)
        model.scale_is_free = False
    state, trace = model.maximise(state)
    return _Part(model, state, trace)


class PenalisedLikelihood:
    """The penalised likelihood of one set of candidates."""

    def __init__(self, data: Candidates, dof: float, unit: str, groups: FloatArray, bends: FloatArray | None = None):
        self.data, self.dof, self.unit, self.groups = data, dof, unit, groups
        self.basis = HatBasis(data)
        self.roughness = Roughness(self.basis.knots)
        self.straightness = np.zeros(self.roughness.count)  # price on squared accelerations that is known beforehand
        if bends is not None and self.roughness.count:
            knots, known = self.basis.knots, np.linspace(0, 1, len(bends))
            unit_of_bends = (np.diff(knots).mean() * (len(bends) - 1)) ** 2
            self.straightness = (np.interp(knots[1:-1], known, bends) * unit_of_bends) ** -2.0
            self.straightness *= smoothing_share(dof)
        self.trust = np.ones(len(data.values))
        self.stiffness = 0.0
        self.scale_is_free = True
        self._count_trust()

    def _count_trust(self) -> None:
        self._total = self.trust.sum()
        self._per_knot = self.basis.gather(self.trust)

    def start(self) -> State:
        """A curve near the densest candidates, and a scale from what half of them agree on."""
        blocks = self.data.at(self.basis.knots)
        median = np.median(blocks, axis=0)
        deviation = np.median(np.abs(blocks - median), axis=0)
        smallest = SCALE_FLOOR * np.ptp(median, axis=0) + ROUNDING * np.abs(median).max(axis=0) + 1e-100
        self._floor = self.groups @ smallest**2
        squared = self.groups @ (1.5 * deviation.mean(axis=0)) ** 2 + self._floor
        curve = median
        if np.isfinite(self.dof) and blocks.size * len(blocks) < PAIRWISE_LIMIT and len(blocks) > 1:
            gaps = ((blocks[:, None] - blocks[None]) ** 2 @ (1 / squared)) / len(squared)
            # the diagonal is taken out: a candidate does not support itself
            support = expected_precision(gaps / 2, self.dof).sum(axis=1) - (self.dof + 1) / self.dof
            curve = np.einsum("qk,qkd->kd", support / support.sum(axis=0), blocks)
        return State(curve, squared, np.ones(len(self.basis.knots)))

    def weights(self, state: State) -> FloatArray:
        """E-step: expected precision ``(N,)`` of every sample, times the trust in it."""
        return self.trust * expected_precision(self.distance(state), self.dof)

    def distance(self, state: State) -> FloatArray:
        """Mean squared distance δ² ``(N,)`` over the numbers that share one u."""
        return self._distance(self._squares(state), state)

    def _squares(self, state: State) -> FloatArray:
        residuals = self.basis.residuals(self.data.values, state.curve)
        return np.multiply(residuals, residuals, out=residuals)

    def _distance(self, squares: FloatArray, state: State) -> FloatArray:
        distance = _mean_square(squares, state.squared_scale) / self.basis.spread(state.profile)
        if self.unit == "trajectory":
            lengths = self.data.lengths
            distance = np.repeat(np.add.reduceat(distance, self.data.starts[:-1]) / lengths, lengths)
        return distance

    def improve(self, state: State) -> tuple[State, FloatArray, FloatArray]:
        """One iteration; also the distances and accelerations that the likelihood of ``state`` is made of."""
        values, basis = self.data.values, self.basis
        squares = self._squares(state)
        distance = self._distance(squares, state)
        acceleration = self.acceleration(state)
        weights = self.trust * expected_precision(distance, self.dof)
        squared_scale = state.squared_scale
        if self.scale_is_free:
            spread = np.einsum("n,nd->d", weights / basis.spread(state.profile), squares)
            squared_scale = self.groups @ spread / self._total + self._floor
        shared = basis.gather(weights * _mean_square(squares, squared_scale))
        profile = (shared + PRIOR_SAMPLES) / (self._per_knot + PRIOR_SAMPLES)
        precision = weights / basis.spread(profile)
        bands = basis.normal_matrix(precision) + self.price_matrix(squared_scale, acceleration, self.stiffness)
        curve = solve_banded(bands, basis.project(precision, values))
        return State(curve, squared_scale, profile), distance, acceleration

    def maximise(self, state: State) -> tuple[State, list[float]]:
        """Iterate until nothing is gained; returns the log-likelihood of every iteration."""
        trace: list[float] = []
        while len(trace) < MAX_ITERATIONS:
            improved, distance, acceleration = self.improve(state)
            trace.append(self._log_likelihood(distance, acceleration, state))
            if len(trace) > 1 and trace[-1] - trace[-2] < TOLERANCE * self.data.values.size:
                break
            state = improved
        return state, trace

    def leave_out_stretches(self, state: State) -> None:
        """Distrust the stretches in which a candidate stands out: a hallucination is no matter of one number.

        Evidence is -log w, so that nothing is left out where ν → ∞ and no sample is doubted.
        """
        evidence = -np.log(expected_precision(self.distance(state), self.dof)) - STANDS_OUT
        lengths = self.data.lengths
        steps = np.arange(lengths.max())
        ragged = np.full((len(self.data), len(steps)), -np.inf)
        ragged[steps < lengths[:, None]] = evidence
        out = persistent(ragged, STRETCH_COST)[steps < lengths[:, None]]
        self.trust = np.where(out, LEFT_OUT, 1.0)
        self._count_trust()

    def pulls(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Normal matrix ``(3, K)`` of the fit, and how hard each candidate pulls at the curve ``(K, Q, D)``."""
        precision = self.weights(state) / self.basis.spread(state.profile)
        residuals = self.basis.residuals(self.data.values, state.curve)
        return self.basis.normal_matrix(precision), self.basis.project_each(precision, residuals)

    def deciding(self, state: State) -> FloatArray:
        """How many candidates decide the curve at each knot ``(K,)``."""
        weights = self.weights(state)
        return effective_count(self.basis.project_each(weights, np.ones((len(weights), 1)))[:, :, 0].T)

    def acceleration(self, state: State) -> FloatArray:
        """Mean squared acceleration ``(K-2,)``, in scales."""
        if not self.roughness.count:
            return np.zeros(0)
        return _mean_square(self.roughness(state.curve) ** 2, state.squared_scale)

    def price_matrix(self, squared_scale: FloatArray, acceleration: FloatArray, stiffness: float) -> FloatArray:
        """What accelerations cost, as lower bands ``(3, K)``: what is known beforehand, and ``stiffness``, little where
        there already is a corner."""
        if not self.roughness.count:
            return np.zeros((BANDS, 1))
        price = self.straightness * squared_scale.mean()
        if stiffness:
            price = price + stiffness * expected_precision(stiffness * acceleration, CORNER_DOF)
        elif not self.basis.on_knots:
            price = price + FAINT
        return self.roughness.matrix(price)

    def _log_likelihood(self, distance: FloatArray, acceleration: FloatArray, state: State) -> float:
        """Log-likelihood of the candidates plus that of scales and accelerations under their priors."""
        dimension = len(state.squared_scale)
        log_profile = np.log(state.profile)
        if self.unit == "trajectory":
            lengths, firsts = self.data.lengths, self.data.starts[:-1]
            total = log_density(distance[firsts], np.zeros(len(lengths)), self.dof, dimension * lengths).sum()
        else:
            total = (self.trust * log_density(distance, np.zeros_like(distance), self.dof, dimension)).sum()
        total -= 0.5 * dimension * (self._per_knot @ log_profile)
        total -= 0.5 * self._total * (np.log(state.squared_scale) + self._floor / state.squared_scale).sum()
        total -= 0.5 * PRIOR_SAMPLES * dimension * (log_profile + 1 / state.profile).sum()
        if self.stiffness:
            total -= 0.5 * dimension * (CORNER_DOF + 1) * np.log1p(self.stiffness * acceleration / CORNER_DOF).sum()
        elif not self.basis.on_knots:
            total -= 0.5 * dimension * FAINT * acceleration.sum()
        total -= 0.5 * dimension * state.squared_scale.mean() * (self.straightness @ acceleration)
        return float(total)


def _mean_square(squares: FloatArray, squared_scale: FloatArray) -> FloatArray:
    """Mean over the dimensions ``(N,)`` of ``squares (N, D)`` in units of ``squared_scale (D,)``."""
    # einsum, because products this thin are slower on several cores than on one
    return np.einsum("nd,d->n", squares, 1 / (squared_scale * len(squared_scale)))


def _checked_bends(bends: ArrayLike) -> FloatArray:
    values = np.asarray(bends, dtype=np.float64)
    if values.ndim != 1 or len(values) < 2 or not (np.isfinite(values).all() and (values > 0).all()):
        raise InvalidValueError(f"bends must be (B,) with B >= 2, positive and finite, got shape {values.shape}")
    return values
