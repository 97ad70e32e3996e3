"""The paper's estimator, fitted exactly: Eq. 2 for every number of every step by itself (Oh et al. 2025, Eq. 1-4).

"The one-dimensional action is used": every number a_t has a μ(t) and a σ(t) of its own. Networks of time could take any
value at each of the T steps, so `em.fit_numbers` at each step is what their training approaches.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.checks import checked_array, checked_positive
from robust_instant_policy.errors import UsageError
from robust_instant_policy.geometry import FloatArray, interpolate
from robust_instant_policy.regression.candidates import Candidates
from robust_instant_policy.regression.em import DEFAULT_DOF, fit_numbers


class StudentTNumbers:
    """Student's t-regression of every number by itself, by expectation-maximisation.

    Candidates of different lengths are interpolated at common times. ``dof`` = inf is the Gaussian, whose mean is the
    mean of the candidates. After `fit`: ``knots (K,)``; ``weights``, Q arrays ``(T_q,)`` in [0, 1], the mean over a
    step's numbers.
    """

    def __init__(self, dof: float = DEFAULT_DOF):
        self.dof = checked_positive("dof", dof, infinite=True)

    def fit(self, candidates: Sequence[ArrayLike], times: Sequence[ArrayLike] | None = None) -> StudentTNumbers:
        """Fit to ``candidates``, each ``(T_q, D)``, at ``times``, each ``(T_q,)`` in [0, 1] (evenly spread if None)."""
        data = Candidates.from_arrays(candidates, times)
        self.knots = data.grid()
        estimates = [fit_numbers(column, self.dof) for column in np.moveaxis(data.at(self.knots), -1, 0)]
        self._mean = np.stack([estimate.mean for estimate in estimates], axis=1)
        self._scale = np.stack([estimate.scale for estimate in estimates], axis=1)
        weights = np.mean([np.minimum(estimate.weights, 1.0) for estimate in estimates], axis=0)
        clocks = data.split(data.times)
        self.weights = [np.interp(clock, self.knots, own) for clock, own in zip(clocks, weights, strict=True)]
        return self

    def mean(self, times: ArrayLike | None = None) -> FloatArray:
        """The robust trajectory μ ``(T, D)`` at ``times (T,)``, by default at the knots (Oh et al. 2025, Eq. 4)."""
        return self._at("_mean", times)

    def scale(self, times: ArrayLike | None = None) -> FloatArray:
        """The scale σ ``(T, D)`` at ``times (T,)``."""
        return self._at("_scale", times)

    def _at(self, name: str, times: ArrayLike | None) -> FloatArray:
        if not hasattr(self, name):
            raise UsageError("nothing is fitted yet; call fit(candidates) first")
        at = self.knots if times is None else checked_array("times", times, "(T,)")
        return interpolate(at, self.knots, getattr(self, name))
