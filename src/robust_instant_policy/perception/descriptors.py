"""Dense descriptors of one image, and their cosine similarities without the full matrix of log bins."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import uniform_filter1d

from robust_instant_policy.geometry import FloatArray

Float32Array = NDArray[np.float32]
IntArray = NDArray[np.intp]

TINY = np.finfo(np.float32).tiny
NEIGHBOURS = tuple((row, col) for row in (-1, 0, 1) for col in (-1, 0, 1))
# Log bins (Amir et al. 2022): a patch with its eight neighbours, and the eight 3×3 means around those.
LOG_BINS = (
    *((0, row, col) for row, col in NEIGHBOURS),
    *((1, 3 * row, 3 * col) for row, col in NEIGHBOURS if (row, col) != (0, 0)),
)
PLAIN = ((0, 0, 0),)


@dataclass(frozen=True, eq=False)
class DescriptorMap:
    """Descriptors on a regular grid of patches.

    ``features (rows, cols, D)``; ``saliency (rows, cols)`` in [0, 1]; the patch in row r and column c is centred on
    pixel ``origin + step · (c, r)`` (u, v) of the original image. A cell is the number of a patch, row by row.
    With ``log_bins`` a descriptor consists of 17 bins around its patch, 17·D numbers.
    """

    features: Float32Array
    saliency: Float32Array
    origin: FloatArray
    step: FloatArray
    log_bins: bool = False

    @property
    def grid(self) -> tuple[int, int]:
        return self.features.shape[0], self.features.shape[1]

    @property
    def bins(self) -> tuple[tuple[int, int, int], ...]:
        """(level, row offset, column offset) of each part of a descriptor."""
        return LOG_BINS if self.log_bins else PLAIN

    @cached_property
    def levels(self) -> tuple[Float32Array, ...]:
        """The features ``(rows · cols, D)`` and, for log bins, their means over 3×3 patches."""
        flat = self.features.reshape(-1, self.features.shape[2])
        if not self.log_bins:
            return (flat,)
        pooled, weight = self.features, np.ones((*self.grid, 1), dtype=np.float32)
        for axis in (0, 1):  # means of the pixels inside the image only
            pooled = uniform_filter1d(pooled, 3, axis=axis, mode="constant")
            weight = uniform_filter1d(weight, 3, axis=axis, mode="constant")
        return flat, (pooled / weight).reshape(flat.shape)

    @cached_property
    def lengths(self) -> Float32Array:
        """Euclidean length ``(rows · cols,)`` of every full descriptor."""
        squares = [np.einsum("nd,nd->n", level, level) for level in self.levels]
        cells = np.arange(len(squares[0]))
        total = sum(squares[level][self.shifted(cells, row, col)] for level, row, col in self.bins)
        return np.sqrt(np.maximum(total, TINY))

    def cells_at(self, pixels: ArrayLike) -> IntArray:
        """The cells ``(...)`` nearest to ``pixels (..., 2)``."""
        rows, cols = self.grid
        index = np.rint((np.asarray(pixels) - self.origin) / self.step).astype(np.intp)
        return np.clip(index[..., 1], 0, rows - 1) * cols + np.clip(index[..., 0], 0, cols - 1)

    def around(self, pixels: ArrayLike) -> tuple[IntArray, FloatArray]:
        """The four cells around each of ``pixels (n, 2)`` and their bilinear weights, both ``(n, 4)``."""
        rows, cols = self.grid
        place = np.clip((np.asarray(pixels) - self.origin) / self.step, 0, (cols - 1, rows - 1))
        corner = np.minimum(place.astype(np.intp), (cols - 2, rows - 2))
        right, down = (place - corner).T
        cell = corner[:, 1] * cols + corner[:, 0]
        shares = [(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right]
        return np.stack([cell, cell + 1, cell + cols, cell + cols + 1], axis=1), np.stack(shares, axis=1)

    def shifted(self, cells: IntArray, row: int, col: int) -> IntArray:
        """The cells ``row`` below and ``col`` to the right of ``cells``, clamped to the border."""
        rows, cols = self.grid
        return np.clip(cells // cols + row, 0, rows - 1) * cols + np.clip(cells % cols + col, 0, cols - 1)

    def vectors(self, cells: IntArray) -> Float32Array:
        """The full descriptors of ``cells (n,)``: ``(n, D)``, or ``(n, 17·D)`` with log bins."""
        parts = [self.levels[level][self.shifted(cells, row, col)] for level, row, col in self.bins]
        return np.concatenate(parts, axis=1)

    def similarities(self, cells: IntArray, other: DescriptorMap, other_cells: IntArray) -> Float32Array:
        """Cosine similarities ``(n, m)`` of ``cells (n,)`` and ``other_cells (m,)``, two maps of one network.

        A log-binned descriptor consists of 17 shifted plain ones, so its products are sums of shifted plain products,
        each computed once per level.
        """
        if not self.log_bins:
            products = self.levels[0][cells] @ other.levels[0][other_cells].T
            return products / (self.lengths[cells][:, None] * other.lengths[other_cells])
        total = np.zeros((len(cells), len(other_cells)), dtype=np.float32)
        for level in range(len(self.levels)):
            mine = np.stack([self.shifted(cells, row, col) for depth, row, col in self.bins if depth == level])
            its = np.stack([other.shifted(other_cells, row, col) for depth, row, col in self.bins if depth == level])
            needed, place = np.unique(mine, return_inverse=True)
            its_needed, its_place = np.unique(its, return_inverse=True)
            products = self.levels[level][needed] @ other.levels[level][its_needed].T
            for rows, cols in zip(place.reshape(mine.shape), its_place.reshape(its.shape), strict=True):
                total += products[rows][:, cols]
        return total / (self.lengths[cells][:, None] * other.lengths[other_cells])


class DescriptorNetwork(Protocol):
    """A network that describes images; patches whose saliency exceeds ``salient`` may be foreground."""

    name: str
    salient: float

    def describe(self, rgb: NDArray[np.uint8]) -> DescriptorMap:
        """Descriptors and saliency of one image ``(H, W, 3)``."""
        ...
