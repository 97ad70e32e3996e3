"""`StudentTRegression`: EM, rejection of stretches, smoothing, EM again; then scale and uncertainty."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from robust_instant_policy.checks import checked_array, checked_positive
from robust_instant_policy.errors import InvalidValueError, UsageError
from robust_instant_policy.geometry import FloatArray, interpolate
from robust_instant_policy.regression.candidates import Candidates, group_matrix
from robust_instant_policy.regression.em import DEFAULT_DOF, MAX_ITERATIONS
from robust_instant_policy.regression.likelihood import Fit, Problem, improve, maximise, pose_problem
from robust_instant_policy.regression.modes import share_at_ties
from robust_instant_policy.regression.smoothing import choose_stiffness
from robust_instant_policy.regression.stretches import reject_stretches
from robust_instant_policy.regression.uncertainty import error_freedom, squared_error, squared_scatter

DRAFT_ITERATIONS = 6  # of the fit from which outlying stretches are rejected,
REDRAFT_ITERATIONS = 3  # and more without those, from which the smoothing is chosen


@dataclass(frozen=True, eq=False)
class Solution:
    """A fit; ``trace`` is the log-likelihood of every iteration."""

    problem: Problem
    fit: Fit
    trace: list[float]


def solve(data: Candidates, dof: float, groups: FloatArray, curvature: FloatArray | None) -> Solution:
    """The robust pipeline: EM → reject stretches → EM → choose the stiffness → EM to convergence.

    It is the same for every ``dof``. At inf all weights are 1, so no stretch is rejected; smoothing and prior stay.
    """
    problem, fit = pose_problem(data, dof, groups, curvature)
    for _ in range(DRAFT_ITERATIONS):
        fit = improve(problem, fit)
    problem, fit = reject_stretches(problem, fit)
    for _ in range(REDRAFT_ITERATIONS):
        fit = improve(problem, fit)
    problem = choose_stiffness(problem, fit)
    return Solution(problem, *maximise(problem, fit))


class StudentTRegression:
    """Robust trajectory of Q candidates that ignores the hallucinated ones (Oh et al. 2025, Algorithm 1, lines 4-5).

    >>> fit = StudentTRegression(dof=1.5).fit([a_1, ..., a_Q])      # each (T_q, D)
    >>> fit.mean(times), fit.scale(times), fit.weights              # (T, D), (T, D), list of (T_q,)

    ``dof`` is the paper's ν; ``inf`` is the Gaussian ablation: the same estimator, with a weight of 1 for everyone.
    The numbers of a step are right or wrong together; `StudentTNumbers` fits each by itself, as in the paper's Eq. 1.
    ``groups (D,)`` are labels of the dimensions that share one scale, such as the coordinates of points, which makes
    the fit independent of the choice of axes; without it each dimension has its own.
    ``curvature (B,)``, evenly spread over time, is the expected standard deviation of a coordinate's second difference
    between steps 1 / (B - 1) apart. Where candidates disagree the curve then goes straight on; where they agree it
    hardly matters. All dimensions must share one scale for that. ``bends`` is its old name.

    After `fit`: ``knots (K,)``; ``weights``, Q arrays ``(T_q,)`` in [0, 1], at most 1/2 where candidates tie;
    ``log_likelihood``, a value an iteration, never falling; ``converged`` and ``num_iterations``; ``stiffness``, the
    price on squared second differences that was chosen.
    """

    def __init__(
        self,
        dof: float = DEFAULT_DOF,
        groups: ArrayLike | None = None,
        curvature: ArrayLike | None = None,
        *,
        bends: ArrayLike | None = None,
    ):
        self.dof = checked_positive("dof", dof, infinite=True)
        self.groups = groups
        self.curvature = checked_curvature(curvature, bends)

    def fit(self, candidates: Sequence[ArrayLike], times: Sequence[ArrayLike] | None = None) -> StudentTRegression:
        """Fit to ``candidates``, each ``(T_q, D)``, at ``times``, each ``(T_q,)`` in [0, 1] (evenly spread if None)."""
        data = Candidates.from_arrays(candidates, times)
        groups = group_matrix(self.groups, data.num_dimensions)
        if self.curvature is not None and not groups.all():
            raise InvalidValueError(f"curvature needs groups ({data.num_dimensions},) of one label: it is in one unit")
        self._solution = solution = solve(data, self.dof, groups, self.curvature)
        self.knots = data.grid()
        self.stiffness = solution.problem.stiffness
        self.num_iterations = len(solution.trace)
        self.converged = self.num_iterations < MAX_ITERATIONS
        self.log_likelihood = np.array(solution.trace)
        share = np.interp(data.times, self.knots, share_at_ties(data, groups, self.knots))
        self.weights = data.split(np.minimum(np.minimum(solution.fit.weights, 1.0), share))
        return self

    def mean(self, times: ArrayLike | None = None) -> FloatArray:
        """The robust trajectory μ ``(T, D)`` at ``times (T,)``, by default at the knots (Oh et al. 2025, Eq. 4)."""
        return self._evaluate(self._solved().fit.curve, times)

    def scale(self, times: ArrayLike | None = None) -> FloatArray:
        """The scale σ ``(T, D)`` of trustworthy candidates about the truth at ``times (T,)``."""
        solution = self._solved()
        return self._evaluate(np.sqrt(squared_scatter(solution.problem, solution.fit)), times)

    def standard_error(self, times: ArrayLike | None = None) -> FloatArray:
        """How far ``(T, D)`` the mean may be off at ``times (T,)``; infinite for a single candidate."""
        return self._evaluate(np.sqrt(self._error()[0]), times)

    def interval(self, level: float = 0.9, times: ArrayLike | None = None) -> tuple[FloatArray, FloatArray]:
        """Lower and upper ends, each ``(T, D)``, between which the truth lies with probability ``level``."""
        if not checked_positive("level", level) < 1:
            raise InvalidValueError(f"level must lie between 0 and 1, got {level}")
        error, deciding = self._error()
        quantile = stdtrit(error_freedom(deciding), (1 + level) / 2)
        mean, reach = self.mean(times), self._evaluate(quantile[:, None] * np.sqrt(error), times)
        return mean - reach, mean + reach

    def _solved(self) -> Solution:
        if not hasattr(self, "_solution"):
            raise UsageError("nothing is fitted yet; call fit(candidates) first")
        return self._solution

    def _error(self) -> tuple[FloatArray, FloatArray]:
        solution = self._solved()
        if len(self.weights) == 1:
            return np.full_like(solution.fit.curve, np.inf), np.ones(len(self.knots))
        return squared_error(solution.problem, solution.fit)

    def _evaluate(self, values: FloatArray, times: ArrayLike | None) -> FloatArray:
        if times is None:
            return values.copy()
        return interpolate(checked_array("times", times, "(T,)"), self.knots, values)


def checked_curvature(curvature: ArrayLike | None, bends: ArrayLike | None = None) -> FloatArray | None:
    """``curvature (B,)`` or its old name ``bends``, positive and finite."""
    if bends is not None:
        warnings.warn("bends is called curvature now; the old name goes in the next version", DeprecationWarning, 3)
        if curvature is not None:
            raise UsageError("curvature and its old name bends are both given; give curvature alone")
        curvature = bends
    if curvature is None:
        return None
    values = checked_array("curvature", curvature, "(B,)")
    if len(values) < 2 or not (values > 0).all():
        raise InvalidValueError(f"curvature must be (B,) with B >= 2 and positive, got {values}")
    return values
