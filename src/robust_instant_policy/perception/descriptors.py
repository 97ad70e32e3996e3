"""Dense descriptors of one image, and their cosine similarities without ever writing them out in full."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.geometry import FloatArray

Float32Array = NDArray[np.float32]
IntArray = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class DescriptorMap:
    """Descriptors on a regular grid of patches.

    ``features (rows, cols, D)`` float32; ``saliency (rows, cols)`` in [0, 1]; the patch in row r and column c is
    centred on pixel ``(origin + step · (c, r))`` (u, v) of the original image. Cells are numbered row by row.
    """

    features: Float32Array
    saliency: Float32Array
    origin: FloatArray
    step: FloatArray

    @property
    def grid(self) -> tuple[int, int]:
        return self.features.shape[0], self.features.shape[1]

    @cached_property
    def pixels(self) -> FloatArray:
        """Patch centres ``(rows · cols, 2)``, (u, v) in the original image."""
        rows, cols = np.indices(self.grid).reshape(2, -1)
        return self.origin + self.step * np.stack([cols, rows], axis=1)

    def cells_at(self, pixels: FloatArray) -> IntArray:
        """Numbers of the cells nearest to ``pixels (..., 2)``."""
        rows, cols = self.grid
        index = np.rint((np.asarray(pixels) - self.origin) / self.step).astype(np.intp)
        return np.clip(index[..., 1], 0, rows - 1) * cols + np.clip(index[..., 0], 0, cols - 1)

    def vectors(self, cells: IntArray) -> Float32Array:
        """Descriptors of length one ``(n, D)``."""
        chosen = self.features.reshape(-1, self.features.shape[2])[cells]
        return chosen / np.maximum(np.linalg.norm(chosen, axis=1, keepdims=True), np.finfo(np.float32).tiny)

    def similarities(self, cells: IntArray, other: DescriptorMap, other_cells: IntArray) -> Float32Array:
        """Cosine similarities ``(n, m)`` between chosen cells of two maps."""
        return self.vectors(cells) @ other.vectors(other_cells).T


class DescriptorNetwork(Protocol):
    """What turns images into descriptor maps."""

    name: str

    def describe(self, rgb: NDArray[np.uint8]) -> DescriptorMap:
        """Descriptors and saliency of one image ``(H, W, 3)``."""
        ...
