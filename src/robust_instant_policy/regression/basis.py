"""The curve μ(t): straight pieces between knots, drawn towards straight lines except where the data show a corner.

There is a knot for every step, so that no corner, pause or grasp is too sharp for it; what keeps the curve from
following noise is a price on its accelerations. How many of its coefficients are then free, its effective size, is
chosen from the data.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dpbsv
from scipy.sparse import csr_array

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression.alignment import Candidates

BANDS = 3  # diagonal and two below it: what accelerations couple
FAINT = 1e-6  # stiffness that only ties down knots between which no candidate has a sample


class HatBasis:
    """Curves linear between ``knots (K,)``, seen at the times of Q candidates with N samples in all.

    ``values - basis.at_samples(curve)`` are residuals. When all candidates were sampled at the knots nothing is
    interpolated, fitting is averaging, and sums over candidates replace sparse products.
    """

    def __init__(self, data: Candidates):
        self.knots = data.grid()
        self._shape = (len(data), len(self.knots))
        self._starts = data.starts
        self.on_knots = data.synchronous
        if self.on_knots:
            self._nearest = np.tile(np.arange(len(self.knots)), len(data))
            return
        count, rows = len(self.knots), np.arange(len(data.times))
        left = np.clip(np.searchsorted(self.knots, data.times, side="right") - 1, 0, max(count - 2, 0))
        right = np.minimum(left + 1, count - 1)
        fraction = np.clip(
            (data.times - self.knots[left]) / np.maximum(self.knots[right] - self.knots[left], 1e-300), 0, 1
        )
        self._left, self._fraction = left, fraction
        self._nearest = np.where(fraction > 0.5, right, left)
        self._matrix = csr_array(
            (np.concatenate([1 - fraction, fraction]), (np.tile(rows, 2), np.concatenate([left, right]))),
            shape=(len(rows), count),
        )
        self._transpose = self._matrix.T.tocsr()

    def residuals(self, values: FloatArray, curve: FloatArray) -> FloatArray:
        """``values (N, D)`` less the ``curve (K, D)`` at their times."""
        if self.on_knots:
            return (values.reshape(*self._shape, -1) - curve).reshape(values.shape)
        return values - self._matrix @ curve

    def project(self, weights: FloatArray, rows: FloatArray) -> FloatArray:
        """``Hᵀ diag(weights) rows``: ``(K, D)`` from ``weights (N,)`` and ``rows (N, D)``."""
        if self.on_knots:
            return np.einsum("qk,qkd->kd", weights.reshape(self._shape), rows.reshape(*self._shape, -1))
        return self._transpose @ (weights[:, None] * rows)

    def project_each(self, weights: FloatArray, rows: FloatArray) -> FloatArray:
        """`project` of each candidate by itself ``(K, Q, D)``."""
        weighted = weights[:, None] * rows
        if self.on_knots:
            return weighted.reshape(*self._shape, -1).swapaxes(0, 1)
        pieces = [
            self._transpose[:, start:stop] @ weighted[start:stop]
            for start, stop in zip(self._starts[:-1], self._starts[1:], strict=True)
        ]
        return np.stack(pieces, axis=1)

    def normal_matrix(self, weights: FloatArray) -> FloatArray:
        """``Hᵀ diag(weights) H`` for ``weights (N,)``, as lower bands ``(3, K)``."""
        bands = np.zeros((BANDS, len(self.knots)))
        if self.on_knots:
            bands[0] = weights.reshape(self._shape).sum(axis=0)
            return bands
        left, fraction, count = self._left, self._fraction, len(self.knots)
        rest = 1 - fraction
        bands[0] = np.bincount(left, weights * rest**2, count)
        bands[0, 1:] += np.bincount(left, weights * fraction**2, count)[:-1]
        bands[1] = np.bincount(left, weights * rest * fraction, count)
        return bands

    def spread(self, at_knots: FloatArray) -> FloatArray:
        """What holds at each knot ``(K, ...)`` for the samples nearest to it ``(N, ...)``."""
        return at_knots[self._nearest]

    def gather(self, at_samples: FloatArray) -> FloatArray:
        """Sums ``(K,)`` of ``at_samples (N,)`` over the samples nearest to each knot."""
        if self.on_knots:
            return at_samples.reshape(self._shape).sum(axis=0)
        return np.bincount(self._nearest, at_samples, len(self.knots)).astype(np.float64)


class Roughness:
    """Accelerations of a curve: second divided differences at inner knots, in units of the mean knot spacing."""

    def __init__(self, knots: FloatArray):
        self.count = max(len(knots) - 2, 0)
        step = np.diff(knots)
        before, after = step[:-1], step[1:]
        unit = 2 * step.mean() ** 2 if self.count else 1.0
        first, middle, last = 1 / (before * (before + after)), -1 / (before * after), 1 / (after * (before + after))
        self._stencil = unit * np.stack([first, middle, last])[:, :, None]
        self._products = unit**2 * np.stack([first**2, middle**2, last**2, first * middle, middle * last, first * last])

    def __call__(self, curve: FloatArray) -> FloatArray:
        """Accelerations ``(K-2, D)`` of a curve ``(K, D)``."""
        first, middle, last = self._stencil
        return first * curve[:-2] + middle * curve[1:-1] + last * curve[2:]

    def matrix(self, weights: FloatArray) -> FloatArray:
        """``Gᵀ diag(weights) G`` for ``weights (K-2,)``, as lower bands ``(3, K)``."""
        bands = np.zeros((BANDS, self.count + 2))
        parts = weights * self._products
        bands[0, :-2] = parts[0]
        bands[0, 1:-1] += parts[1]
        bands[0, 2:] += parts[2]
        bands[1, :-2] = parts[3]
        bands[1, 1:-1] += parts[4]
        bands[2, :-2] = parts[5]
        return bands


def solve_banded(bands: FloatArray, right_side: FloatArray) -> FloatArray:
    """Solve the symmetric positive definite system with lower bands ``bands (3, K)`` for ``right_side (K, M)``."""
    if not bands[1:].any():
        return right_side / bands[0][:, None]
    _, solution, info = dpbsv(bands[: len(right_side)], right_side, lower=1)
    if info:
        raise np.linalg.LinAlgError(f"normal equations of {len(right_side)} knots are singular (at {info})")
    return solution


def multiply_banded(bands: FloatArray, vectors: FloatArray) -> FloatArray:
    """Product of the symmetric matrix with lower bands ``bands (3, K)`` and ``vectors (K, M)``."""
    result = bands[0][:, None] * vectors
    for offset in range(1, min(BANDS, len(vectors))):
        band = bands[offset, :-offset, None]
        result[offset:] += band * vectors[:-offset]
        result[:-offset] += band * vectors[offset:]
    return result
