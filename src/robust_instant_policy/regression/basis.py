"""The curve μ(t): straight pieces between knots, drawn towards straight lines except where the data show a corner."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solveh_banded
from scipy.sparse import csr_array

from robust_instant_policy.geometry import FloatArray


class HatBasis:
    """Continuous curves that are linear between ``knots (K,)``, observed at ``times (N,)``.

    ``basis(coefficients)`` evaluates a curve with values ``(K, D)`` at the knots at the observed times ``(N, D)``.
    When every observation lies on a knot nothing is interpolated, and fitting is averaging.
    """

    def __init__(self, knots: FloatArray, times: FloatArray):
        self.knots = knots
        count = len(knots)
        left = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, max(count - 2, 0))
        right = np.minimum(left + 1, count - 1)
        width = knots[right] - knots[left]
        fraction = np.divide(times - knots[left], width, out=np.zeros(len(times)), where=width > 0).clip(0.0, 1.0)
        self.nearest = np.where(fraction > 0.5, right, left)
        self.on_knots = bool(np.isin(fraction, (0.0, 1.0)).all())
        self._left, self._fraction = left, fraction
        rows = np.arange(len(times))
        if self.on_knots:
            self.matrix = csr_array((np.ones(len(times)), (rows, self.nearest)), shape=(len(times), count))
        else:
            self.matrix = csr_array(
                (np.concatenate([1 - fraction, fraction]), (np.tile(rows, 2), np.concatenate([left, right]))),
                shape=(len(times), count),
            )
        self.transpose = self.matrix.T.tocsr()

    def __call__(self, coefficients: FloatArray) -> FloatArray:
        return coefficients[self.nearest] if self.on_knots else self.matrix @ coefficients

    def project(self, rows: FloatArray) -> FloatArray:
        """``Hᵀ rows``: sums ``(K, ...)`` of ``rows (N, ...)`` over the knots they lie between."""
        return self.transpose @ rows

    def normal_matrix(self, weights: FloatArray) -> FloatArray:
        """``Hᵀ diag(weights) H`` for ``weights (N,)``, as lower bands ``(3, K)``."""
        bands = np.zeros((3, len(self.knots)))
        if self.on_knots:
            bands[0] = np.bincount(self.nearest, weights, len(self.knots))
            return bands
        left, fraction, count = self._left, self._fraction, len(self.knots)
        rest = 1 - fraction
        bands[0] = np.bincount(left, weights * rest**2, count)
        bands[0, 1:] += np.bincount(left, weights * fraction**2, count)[:-1]
        bands[1] = np.bincount(left, weights * rest * fraction, count)
        return bands


class Roughness:
    """Accelerations of a curve: second divided differences at the inner knots, in units of the mean knot spacing."""

    def __init__(self, knots: FloatArray):
        self.count = max(len(knots) - 2, 0)
        step = np.diff(knots)
        before, after = step[:-1], step[1:]
        unit = 2 * step.mean() ** 2 if self.count else 1.0
        self.stencil = unit * np.array(
            [1 / (before * (before + after)), -1 / (before * after), 1 / (after * (before + after))]
        )

    def __call__(self, coefficients: FloatArray) -> FloatArray:
        """Accelerations ``(K-2, D)`` of a curve ``(K, D)``."""
        first, middle, last = self.stencil[:, :, None]
        return first * coefficients[:-2] + middle * coefficients[1:-1] + last * coefficients[2:]

    def matrix(self, weights: FloatArray) -> FloatArray:
        """``Gᵀ diag(weights) G`` for ``weights (K-2,)``, as lower bands ``(3, K)``."""
        bands = np.zeros((3, self.count + 2))
        first, middle, last = self.stencil
        bands[0, :-2] += weights * first**2
        bands[0, 1:-1] += weights * middle**2
        bands[0, 2:] += weights * last**2
        bands[1, :-2] += weights * first * middle
        bands[1, 1:-1] += weights * middle * last
        bands[2, :-2] += weights * first * last
        return bands


def solve_banded(bands: FloatArray, right_side: FloatArray) -> FloatArray:
    """Solve the symmetric positive definite system with lower bands ``bands (3, K)`` for ``right_side (K, ...)``."""
    if not bands[1:].any():
        return right_side / bands[0].reshape(-1, *[1] * (right_side.ndim - 1))
    return solveh_banded(bands[: len(bands[0])], right_side, lower=True, check_finite=False)


def multiply_banded(bands: FloatArray, vectors: FloatArray) -> FloatArray:
    """Product of the symmetric matrix with lower bands ``bands (3, K)`` and ``vectors (K, M)``."""
    result = bands[0][:, None] * vectors
    for offset in (1, 2):
        band = bands[offset, : max(len(vectors) - offset, 0), None]
        result[offset:] += band * vectors[: len(vectors) - offset]
        result[: len(vectors) - offset] += band * vectors[offset:]
    return result
