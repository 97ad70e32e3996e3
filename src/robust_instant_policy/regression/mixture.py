"""Student's t-mixture over whole trajectories: several good ways stay apart (Peel and McLachlan 2000).

Demonstrators who "choose multiple optimal behaviors" (Oh et al. 2025, Sec. VI) give candidates in several modes, and
the mean of two ways around an obstacle hits it. A candidate follows one mode from beginning to end, so that its
hundreds of numbers decide together which: the responsibilities of expectation-maximisation are 0 or 1 to every digit,
and the E-step is an assignment.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.checks import checked_positive
from robust_instant_policy.errors import UsageError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression.candidates import Candidates, group_matrix
from robust_instant_policy.regression.em import DEFAULT_DOF, log_density
from robust_instant_policy.regression.modes import partition, step_distances
from robust_instant_policy.regression.student_t import StudentTRegression

MAX_SWEEPS = 10  # of fitting the modes and assigning the candidates to them


class StudentTMixture:
    """Finds how many ways the candidates go and fits each by itself; never an average between two.

    >>> fit = StudentTMixture(dof=1.5).fit([a_1, ..., a_Q])
    >>> fit.num_modes, fit.labels, fit.mean(times)      # the best supported way; the others are fit.modes[1:]

    After `fit`: ``modes``, a `StudentTRegression` each, best supported first; ``labels (Q,)``, the mode of each
    candidate, -1 for one that goes no way that another goes too; ``support (num_modes,)``, the share of candidates; and
    the interface of `StudentTRegression` for the best supported mode, in which candidates of other modes weigh 0.
    """

    def __init__(self, dof: float = DEFAULT_DOF, groups: ArrayLike | None = None):
        self.dof = checked_positive("dof", dof, infinite=True)
        self.groups = groups

    def fit(self, candidates: Sequence[ArrayLike], times: Sequence[ArrayLike] | None = None) -> StudentTMixture:
        """Fit to ``candidates``, each ``(T_q, D)``, at ``times``, each ``(T_q,)`` in [0, 1] (evenly spread if None)."""
        data = Candidates.from_arrays(candidates, times)
        groups = group_matrix(self.groups, data.num_dimensions)
        labels = np.zeros(len(data), dtype=np.intp)
        if len(data) > 2:
            labels = partition(step_distances(data.at(data.grid()), groups))
        modes = self._fit_modes(data, labels)
        for _ in range(MAX_SWEEPS):
            assigned = np.where(labels < 0, -1, self._most_likely_mode(data, modes))
            if np.array_equal(assigned, labels) or len(np.unique(assigned[assigned >= 0])) < len(modes):
                break
            labels, modes = assigned, self._fit_modes(data, assigned)
        self.labels, self.modes, self.num_modes = labels, modes, len(modes)
        self.support = np.array([(labels == mode).mean() for mode in range(self.num_modes)])
        self.knots = modes[0].knots
        self.weights = [np.zeros(length) for length in data.lengths]
        for q, weight in zip(np.flatnonzero(labels == 0), modes[0].weights, strict=True):
            self.weights[q] = weight
        return self

    def mean(self, times: ArrayLike | None = None) -> FloatArray:
        """The best supported way ``(T, D)`` at ``times (T,)``."""
        return self._leading().mean(times)

    def scale(self, times: ArrayLike | None = None) -> FloatArray:
        """The scale of its candidates about the best supported way ``(T, D)`` at ``times (T,)``."""
        return self._leading().scale(times)

    def standard_error(self, times: ArrayLike | None = None) -> FloatArray:
        """How far ``(T, D)`` the best supported way may be off at ``times (T,)``; infinite for a single candidate."""
        return self._leading().standard_error(times)

    def interval(self, level: float = 0.9, times: ArrayLike | None = None) -> tuple[FloatArray, FloatArray]:
        """Lower and upper ends, each ``(T, D)``, between which that way lies with probability ``level``."""
        return self._leading().interval(level, times)

    def _leading(self) -> StudentTRegression:
        if not hasattr(self, "modes"):
            raise UsageError("nothing is fitted yet; call fit(candidates) first")
        return self.modes[0]

    def _fit_modes(self, data: Candidates, labels: np.ndarray) -> list[StudentTRegression]:
        rows, clocks = data.split(data.values), data.split(data.times)
        members = [np.flatnonzero(labels == mode) for mode in range(labels.max() + 1)]
        return [
            StudentTRegression(self.dof, groups=self.groups).fit([rows[q] for q in own], [clocks[q] for q in own])
            for own in members
        ]

    def _most_likely_mode(self, data: Candidates, modes: list[StudentTRegression]) -> np.ndarray:
        """E-step: the mode ``(Q,)`` under which each candidate is the most likely."""
        likelihoods = []
        for mode in modes:
            scale = mode.scale(data.times)
            distance = (((data.values - mode.mean(data.times)) / scale) ** 2).mean(axis=1)
            steps = log_density(distance, np.log(scale).sum(axis=1), self.dof, data.num_dimensions)
            likelihoods.append(np.add.reduceat(steps, data.starts[:-1]))
        return np.argmax(likelihoods, axis=0)
