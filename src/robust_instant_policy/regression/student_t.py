"""`StudentTRegression`: EM, rejection of stretches, smoothing, EM again; then scale and uncertainty."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from robust_instant_policy.checks import check_name, checked_array, checked_positive
from robust_instant_policy.errors import InvalidValueError, UsageError
from robust_instant_policy.geometry import FloatArray, interpolate
from robust_instant_policy.regression.candidates import Candidates, group_matrix
from robust_instant_policy.regression.em import DEFAULT_DOF, MAX_ITERATIONS
from robust_instant_policy.regression.likelihood import Fit, Problem, improve, maximise, pose_problem
from robust_instant_policy.regression.modes import share_at_ties
from robust_instant_policy.regression.smoothing import choose_stiffness
from robust_instant_policy.regression.stretches import reject_stretches
from robust_instant_policy.regression.uncertainty import error_freedom, squared_error, squared_scatter

UNITS = ("step", "trajectory", "number")
DRAFT_ITERATIONS = 6  # of the fit from which outlying stretches are rejected,
REDRAFT_ITERATIONS = 3  # and more without those, from which the smoothing is chosen


@dataclass(frozen=True, eq=False)
class Solution:
    """The dimensions that were fitted together; ``trace`` is the log-likelihood of every iteration."""

    problem: Problem
    fit: Fit
    trace: list[float]


def solve(data: Candidates, dof: float, unit: str, groups: FloatArray, curvature: FloatArray | None) -> Solution:
    """The robust pipeline: EM → reject stretches → EM → choose the stiffness → EM to convergence.

    It is the same for every ``dof``. At inf all weights are 1, so no stretch is rejected; smoothing and prior stay.
    """
    problem, fit = pose_problem(data, dof, unit, groups, curvature)
    for _ in range(DRAFT_ITERATIONS):
        fit = improve(problem, fit)
    if unit != "trajectory":
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
    ``unit`` is what is right or wrong together: the numbers of a "step" (whose outlying stretches are then rejected
    whole), those of a whole "trajectory", or every "number" by itself, as in the paper's Eq. 1, with ``groups`` unused.
    ``groups (D,)`` are labels of the dimensions that share one scale, such as the coordinates of points, which makes
    the fit independent of the choice of axes; without it each dimension has its own.
    ``curvature (B,)``, evenly spread over time, is the expected standard deviation of a coordinate's second difference
    between steps 1 / (B - 1) apart. Where candidates disagree the curve then goes straight on; where they agree it
    hardly matters. All dimensions must share one scale for that. ``bends`` is its deprecated name.

    After `fit`: ``knots (K,)``; ``weights``, Q arrays ``(T_q,)`` in [0, 1], at most 1/2 where candidates tie;
    ``log_likelihood``, a value an iteration, never falling; ``converged`` and ``num_iterations``; ``stiffness``, the
    price on squared second differences that was chosen.
    """

    def __init__(
        self,
        dof: float = DEFAULT_DOF,
        unit: str = "step",
        groups: ArrayLike | None = None,
        curvature: ArrayLike | None = None,
        *,
        bends: ArrayLike | None = None,
    ):
        check_name("unit", unit, UNITS)
        self.dof = checked_positive("dof", dof, infinite=True)
        self.unit = unit
        self.groups = groups
        self.curvature = checked_curvature(curvature, bends)

    def fit(self, candidates: Sequence[ArrayLike], times: Sequence[ArrayLike] | None = None) -> StudentTRegression:
        """Fit to ``candidates``, each ``(T_q, D)``, at ``times``, each ``(T_q,)`` in [0, 1] (evenly spread if None)."""
        data = Candidates.from_arrays(candidates, times)
        groups = group_matrix(self.groups, data.num_dimensions)
        if self.unit == "number":
            parts = [replace(data, values=column[:, None]) for column in data.values.T]
            solutions = [solve(part, self.dof, self.unit, np.eye(1), self.curvature) for part in parts]
        elif self.curvature is not None and not groups.all():
            raise InvalidValueError(f"curvature needs groups ({data.num_dimensions},) of one label: it is in one unit")
        else:
            solutions = [solve(data, self.dof, self.unit, groups, self.curvature)]
        self._solutions = solutions
        self.knots = data.grid()
        self.stiffness = float(np.mean([one.problem.stiffness for one in solutions]))
        self.num_iterations = max(len(one.trace) for one in solutions)
        self.converged = self.num_iterations < MAX_ITERATIONS
        traces = [np.pad(one.trace, (0, self.num_iterations - len(one.trace)), "edge") for one in solutions]
        self.log_likelihood = np.sum(traces, axis=0)
        weights = np.mean([np.minimum(one.fit.weights, 1.0) for one in solutions], axis=0)
        weights = np.minimum(weights, np.interp(data.times, self.knots, share_at_ties(data, groups, self.knots)))
        self.weights = data.split(weights)
        return self

    def mean(self, times: ArrayLike | None = None) -> FloatArray:
        """The robust trajectory μ ``(T, D)`` at ``times (T,)``, by default at the knots (Oh et al. 2025, Eq. 4)."""
        return self._evaluate(np.hstack([one.fit.curve for one in self._solved()]), times)

    def scale(self, times: ArrayLike | None = None) -> FloatArray:
        """The scale σ ``(T, D)`` of trustworthy candidates about the truth at ``times (T,)``."""
        squared = np.hstack([squared_scatter(one.problem, one.fit) for one in self._solved()])
        return self._evaluate(np.sqrt(squared), times)

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

    def _solved(self) -> list[Solution]:
        if not hasattr(self, "_solutions"):
            raise UsageError("nothing is fitted yet; call fit(candidates) first")
        return self._solutions

    def _error(self) -> tuple[FloatArray, FloatArray]:
        errors, deciding = zip(*[squared_error(one.problem, one.fit) for one in self._solved()], strict=True)
        if len(self.weights) == 1:
            return np.full_like(self.mean(), np.inf), np.ones(len(self.knots))
        return np.hstack(errors), np.mean(deciding, axis=0)

    def _evaluate(self, values: FloatArray, times: ArrayLike | None) -> FloatArray:
        if times is None:
            return values.copy()
        return interpolate(checked_array("times", times, "(T,)"), self.knots, values)


def checked_curvature(curvature: ArrayLike | None, bends: ArrayLike | None = None) -> FloatArray | None:
    """``curvature (B,)`` or its deprecated name ``bends``, positive and finite."""
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
