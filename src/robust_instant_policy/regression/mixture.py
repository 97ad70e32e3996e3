"""Student's t-mixture over whole trajectories: several good ways stay apart (Peel and McLachlan 2000)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression.alignment import Candidates, checked_dof
from robust_instant_policy.regression.student_t import DEFAULT_DOF, StudentTRegression

MODE_GAP = 4.0  # times the distance between neighbours of one mode: candidates further apart are of different modes


class StudentTMixture:
    """Finds how many ways the candidates go and fits each one by itself; never an average between two.

    After `fit`: ``num_modes``, ``modes`` (a `StudentTRegression` each, best supported first), ``labels (Q,)`` the mode
    of each candidate, and the interface of `StudentTRegression` for the best supported mode, the candidates of other
    modes having weight 0.
    """

    def __init__(self, dof: float = DEFAULT_DOF, groups: ArrayLike | None = None):
        self.dof = checked_dof(dof)
        self.groups = groups

    def fit(self, candidates: Sequence[ArrayLike], times: Sequence[ArrayLike] | None = None) -> StudentTMixture:
        """Fit to ``candidates``, each ``(T_q, D)``, at ``times``, each ``(T_q,)`` in [0, 1] (evenly spread if None)."""
        data = Candidates.from_arrays(candidates, times)
        rows, clocks = data.split(data.values), data.split(data.times)
        self.labels = self._partition(data.at(data.grid()))
        self.num_modes = int(self.labels.max()) + 1
        self.modes = [
            StudentTRegression(self.dof, groups=self.groups).fit(
                [rows[q] for q in np.flatnonzero(self.labels == mode)],
                [clocks[q] for q in np.flatnonzero(self.labels == mode)],
            )
            for mode in range(self.num_modes)
        ]
        self.weights = [np.zeros(len(row)) for row in rows]
        for q, weight in zip(np.flatnonzero(self.labels == 0), self.modes[0].weights, strict=True):
            self.weights[q] = weight
        return self

    def mean(self, times: ArrayLike | None = None) -> FloatArray:
        """The best supported mode ``(T, D)`` at ``times (T,)``."""
        return self.modes[0].mean(times)

    def scale(self, times: ArrayLike | None = None) -> FloatArray:
        """The spread of its candidates about the best supported mode ``(T, D)`` at ``times (T,)``."""
        return self.modes[0].scale(times)

    def _partition(self, blocks: FloatArray) -> np.ndarray:
        count = len(blocks)
        if count < 4:
            return np.zeros(count, dtype=np.intp)
        gaps = np.sqrt(((blocks[:, None] - blocks[None]) ** 2).mean(axis=-1)).max(axis=-1)
        np.fill_diagonal(gaps, np.inf)
        nearest = float(np.median(gaps.min(axis=1)))
        np.fill_diagonal(gaps, 0.0)
        clusters = fcluster(linkage(squareform(gaps, checks=False), "single"), MODE_GAP * nearest, "distance")
        sizes = np.bincount(clusters)
        order = [cluster for cluster in np.argsort(-sizes, kind="stable") if sizes[cluster] > 1]
        if len(order) < 2:
            return np.zeros(count, dtype=np.intp)
        labels = np.zeros(count, dtype=np.intp)
        for mode, cluster in enumerate(order):
            labels[clusters == cluster] = mode
        return labels
