"""The curve μ(t): linear between knots, one knot a step, and its second differences.

No corner, pause or grasp is too sharp for it. What keeps it from following noise is a penalty on second differences.
Symmetric matrices over the knots are stored as lower bands ``(3, K)``, LAPACK's layout.
"""

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg.lapack import dpbsv

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression.candidates import Candidates

BANDS = 3  # diagonal and two below it: what second differences couple


class HatBasis:
    """H: curves linear between ``knots (K,)``, seen at the times of Q candidates with N samples in all.

    When all candidates were sampled at the knots H is a stack of identities, and sums over candidates replace sparse
    products.
    """

    def __init__(self, data: Candidates):
        self.knots = data.grid()
        self._shape = (len(data), len(self.knots))
        self._starts = data.starts
        self.on_knots = data.synchronous
        if self.on_knots:
            self._nearest = np.tile(np.arange(len(self.knots)), len(data))
            return
        knots = np.array([self.knots[0], *self.knots, self.knots[-1]])
        matrix = BSpline.design_matrix(data.times, knots, 1)
        self._matrix, self._transpose = matrix, matrix.T.tocsr()
        self._squares = matrix.multiply(matrix).T.tocsr()
        self._neighbours = matrix[:, :-1].multiply(matrix[:, 1:]).T.tocsr()
        left = np.clip(np.searchsorted(self.knots, data.times, side="right") - 1, 0, len(self.knots) - 2)
        fraction = (data.times - self.knots[left]) / (self.knots[left + 1] - self.knots[left])
        self._nearest = left + (fraction > 0.5)

    def residuals(self, values: FloatArray, curve: FloatArray) -> FloatArray:
        """``values - H curve`` ``(N, D)`` of a ``curve (K, D)``."""
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
        spans = zip(self._starts[:-1], self._starts[1:], strict=True)
        return np.stack([self._transpose[:, start:stop] @ weighted[start:stop] for start, stop in spans], axis=1)

    def normal_matrix(self, weights: FloatArray) -> FloatArray:
        """``Hᵀ diag(weights) H`` for ``weights (N,)``, as lower bands ``(3, K)``."""
        bands = np.zeros((BANDS, len(self.knots)))
        if self.on_knots:
            bands[0] = weights.reshape(self._shape).sum(axis=0)
            return bands
        bands[0], bands[1, :-1] = self._squares @ weights, self._neighbours @ weights
        return bands

    def spread(self, at_knots: FloatArray) -> FloatArray:
        """What holds at each knot ``(K, ...)`` for the samples nearest to it ``(N, ...)``."""
        return at_knots[self._nearest]

    def gather(self, at_samples: FloatArray) -> FloatArray:
        """Sums ``(K,)`` of ``at_samples (N,)`` over the samples nearest to each knot."""
        if self.on_knots:
            return at_samples.reshape(self._shape).sum(axis=0)
        return np.bincount(self._nearest, at_samples, len(self.knots)).astype(np.float64)


class SecondDifferences:
    """G: second divided differences of a curve at inner ``knots``, in units of the mean knot spacing."""

    def __init__(self, knots: FloatArray):
        self.count = max(len(knots) - 2, 0)
        step = np.diff(knots)
        before, after = step[:-1], step[1:]
        unit = 2 * step.mean() ** 2 if self.count else 1.0
        first, middle, last = 1 / (before * (before + after)), -1 / (before * after), 1 / (after * (before + after))
        self._stencil = unit * np.stack([first, middle, last])[:, :, None]
        self._products = unit**2 * np.stack([first**2, middle**2, last**2, first * middle, middle * last, first * last])

    def __call__(self, curve: FloatArray) -> FloatArray:
        """``G curve``: ``(K-2, D)`` from ``curve (K, D)``."""
        first, middle, last = self._stencil
        return first * curve[:-2] + middle * curve[1:-1] + last * curve[2:]

    def transpose(self, rows: FloatArray) -> FloatArray:
        """``Gᵀ rows``: ``(K, D)`` from ``rows (K-2, D)``."""
        result = np.zeros((self.count + 2, rows.shape[1]))
        for offset, coefficients in enumerate(self._stencil):
            result[offset : offset + self.count] += coefficients * rows
        return result

    def penalty_matrix(self, prices: FloatArray) -> FloatArray:
        """``Gᵀ diag(prices) G`` for ``prices (K-2,)``, as lower bands ``(3, K)``."""
        bands = np.zeros((BANDS, self.count + 2))
        first, middle, last, *neighbours, ends = prices * self._products
        bands[0, :-2] = first
        bands[0, 1:-1] += middle
        bands[0, 2:] += last
        bands[1, :-2], bands[2, :-2] = neighbours[0], ends
        bands[1, 1:-1] += neighbours[1]
        return bands


def solve_banded(bands: FloatArray, right_side: FloatArray) -> FloatArray:
    """Solve the symmetric positive definite system with lower bands ``bands (3, K)`` for ``right_side (K, M)``."""
    if not bands[1:].any():
        return right_side / bands[0][:, None]
    # scipy's solveh_banded calls the same routine, in twice the time for matrices this small
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
