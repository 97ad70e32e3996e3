"""Student's t-mixture over whole trajectories: several good ways stay apart (Peel and McLachlan 2000).

Demonstrators who "choose multiple optimal behaviors" (Oh et al. 2025, Sec. VI) give candidates in several modes, and
what lies between two ways around an obstacle is the obstacle. A candidate follows one mode from beginning to end, so
that its hundreds of numbers decide together which: the responsibilities of expectation-maximisation are 0 or 1 to
every digit, and the E-step is an assignment. How many modes there are is found by merging the candidates that lie no
further from each other than nearest neighbours do, a distance that noise keeps near 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression.alignment import Candidates, checked_dof, group_matrix
from robust_instant_policy.regression.student_t import DEFAULT_DOF, ROUNDING, SCALE_FLOOR, StudentTRegression

SAME_MODE = 2.3  # mean squared distance, in that of nearest neighbours, up to which candidates go the same way
WORST_STEP = 25.0  # that one step may add to it at most: a wrong digit does not make a way of its own
SAME_WAY_SHARE = 0.2  # of the pairs, at least, that go the same way: their distance is noise
POOLED_SHARE = 0.5  # of all steps' noise in the noise that a step's distances are measured in
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
        self.dof = checked_dof(dof)
        self.groups = groups

    def fit(self, candidates: Sequence[ArrayLike], times: Sequence[ArrayLike] | None = None) -> StudentTMixture:
        """Fit to ``candidates``, each ``(T_q, D)``, at ``times``, each ``(T_q,)`` in [0, 1] (evenly spread if None)."""
        data = Candidates.from_arrays(candidates, times)
        labels = _partition(data.at(data.grid()), group_matrix(self.groups, data.num_dimensions))
        for _ in range(MAX_SWEEPS):
            self.modes = [self._fit_mode(data, labels == mode) for mode in range(labels.max() + 1)]
            assigned = np.where(labels < 0, -1, self._nearest_mode(data))
            if np.array_equal(assigned, labels) or len(np.unique(assigned[assigned >= 0])) < len(self.modes):
                break
            labels = assigned
        self.labels = labels
        self.num_modes = len(self.modes)
        self.support = np.array([(labels == mode).mean() for mode in range(self.num_modes)])
        self.knots = self.modes[0].knots
        weights = iter(self.modes[0].weights)
        self.weights = [
            next(weights) if label == 0 else np.zeros(length)
            for label, length in zip(labels, data.lengths, strict=True)
        ]
        return self

    def mean(self, times: ArrayLike | None = None) -> FloatArray:
        """The best supported way ``(T, D)`` at ``times (T,)``."""
        return self.modes[0].mean(times)

    def scale(self, times: ArrayLike | None = None) -> FloatArray:
        """The scale of its candidates about the best supported way ``(T, D)`` at ``times (T,)``."""
        return self.modes[0].scale(times)

    def standard_error(self, times: ArrayLike | None = None) -> FloatArray:
        """How far ``(T, D)`` the best supported way may be off at ``times (T,)``; infinite for a single candidate."""
        return self.modes[0].standard_error(times)

    def interval(self, level: float = 0.9, times: ArrayLike | None = None) -> tuple[FloatArray, FloatArray]:
        """Lower and upper ends, each ``(T, D)``, between which that way lies with probability ``level``."""
        return self.modes[0].interval(level, times)

    def _fit_mode(self, data: Candidates, members: np.ndarray) -> StudentTRegression:
        rows, clocks = data.split(data.values), data.split(data.times)
        chosen = np.flatnonzero(members)
        return StudentTRegression(self.dof, groups=self.groups).fit(
            [rows[q] for q in chosen], [clocks[q] for q in chosen]
        )

    def _nearest_mode(self, data: Candidates) -> np.ndarray:
        """E-step: the mode ``(Q,)`` under which each candidate is the most likely."""
        unlikely = []
        for mode in self.modes:
            scale = mode.scale(data.times)
            distance = (((data.values - mode.mean(data.times)) / scale) ** 2).mean(axis=1)
            heavy = distance / 2 if np.isinf(self.dof) else 0.5 * (self.dof + 1) * np.log1p(distance / self.dof)
            unlikely.append(np.add.reduceat(heavy + np.log(scale).mean(axis=1), data.starts[:-1]))
        return np.argmin(unlikely, axis=0)


def _partition(blocks: FloatArray, groups: FloatArray) -> np.ndarray:
    """First labels ``(Q,)`` of candidates on common times ``(Q, K, D)``; 0 is the largest group, -1 is alone."""
    count = len(blocks)
    if count < 3:
        return np.zeros(count, dtype=np.intp)
    median = np.median(blocks, axis=0)
    squares = (blocks[:, None] - blocks[None]) ** 2
    pairs = squares[np.triu_indices(count, 1)]
    least = (SCALE_FLOOR * np.ptp(median, axis=0) + ROUNDING * np.abs(median).max(axis=0)) ** 2 + 1e-200
    unit = np.sqrt(groups @ (np.quantile(pairs, SAME_WAY_SHARE, axis=0).mean(axis=0) + least))
    gaps = (squares / unit**2).mean(axis=-1)
    neighbour = (gaps.mean(axis=-1) + np.diag(np.full(count, np.inf))).argmin(axis=1)
    noise = np.median(gaps[np.arange(count), neighbour], axis=0) + np.finfo(float).tiny
    if len(median) > 2:  # candidates sampled at other times cut a corner elsewhere, by up to a quarter of its bend
        noise[1:-1] += ((np.diff(median, 2, axis=0) / unit / 4) ** 2).mean(axis=-1)
    noise = (1 - POOLED_SHARE) * noise + POOLED_SHARE * noise.mean()
    distance = np.minimum(gaps / noise, WORST_STEP).mean(axis=-1)
    np.fill_diagonal(distance, 0.0)
    clusters = fcluster(linkage(squareform(distance, checks=False), "average"), SAME_MODE, "distance")
    members = [clusters == cluster for cluster in np.unique(clusters)]
    # of two groups of one size, the one that agrees better leads, whatever the order of the candidates
    members.sort(key=lambda group: (-group.sum(), distance[np.ix_(group, group)].sum()))
    labels = np.full(count, -1, dtype=np.intp)
    for mode, group in enumerate(members):
        if group.sum() > 1:
            labels[group] = mode
    return labels if labels.max() >= 0 else np.zeros(count, dtype=np.intp)
