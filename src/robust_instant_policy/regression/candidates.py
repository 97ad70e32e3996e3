"""Candidates of different lengths on one normalised time axis, without resampling them.

"The time step t is normalized to the maximum length of each trajectory" (Oh et al. 2025, Sec. IV): every candidate
starts at 0 and ends at 1. Candidates keep their own samples; the curve fitted to them is evaluated at their times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.checks import checked_array
from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.geometry import FloatArray, interpolate


@dataclass(frozen=True, eq=False)
class Candidates:
    """Q candidates stacked: ``values (N, D)`` at ``times (N,)``, candidate ``q`` in rows ``starts[q]:starts[q+1]``."""

    values: FloatArray
    times: FloatArray
    starts: np.ndarray

    @classmethod
    def from_arrays(cls, candidates: Sequence[ArrayLike], times: Sequence[ArrayLike] | None = None) -> Candidates:
        """Check and stack ``candidates``, each ``(T_q, D)``, at ``times``, each ``(T_q,)`` increasing within [0, 1].

        Without ``times`` every candidate is spread evenly over [0, 1]. Raises `InvalidValueError` that names the
        argument and its shape.
        """
        arrays = [
            checked_array(f"candidates[{index}]", array, "(T_q, D)")
            for index, array in enumerate(_checked_list("candidates", candidates, "(T_q, D)"))
        ]
        shapes = [array.shape for array in arrays]
        if not arrays:
            raise InvalidValueError("candidates must hold at least one array (T_q, D), got an empty list")
        for index, shape in enumerate(shapes):
            if 0 in shape:
                raise InvalidValueError(f"candidates[{index}] must be (T_q, D), T_q >= 1 and D >= 1, got shape {shape}")
        if len({shape[1] for shape in shapes}) > 1:
            raise InvalidValueError(f"candidates must share one number of dimensions D, got shapes {shapes}")
        if times is None:
            clocks = [np.linspace(0.0, 1.0, len(array)) for array in arrays]
        else:
            clocks = _checked_times(times, shapes)
        starts = np.concatenate([[0], np.cumsum([len(array) for array in arrays])])
        return cls(np.concatenate(arrays), np.concatenate(clocks), starts)

    def __len__(self) -> int:
        return len(self.starts) - 1

    @cached_property
    def lengths(self) -> np.ndarray:
        """Number of steps ``(Q,)`` of each candidate."""
        return np.diff(self.starts)

    @property
    def num_dimensions(self) -> int:
        return self.values.shape[1]

    @property
    def owners(self) -> np.ndarray:
        """Index of the candidate ``(N,)`` that each row belongs to."""
        return np.repeat(np.arange(len(self)), self.lengths)

    @cached_property
    def synchronous(self) -> bool:
        """Whether all candidates were sampled at the same times."""
        if (self.lengths != self.lengths[0]).any():
            return False
        clocks = self.times.reshape(len(self), -1)
        return bool((clocks == clocks[0]).all())

    def grid(self) -> FloatArray:
        """Knots for a curve through these candidates: their common times, else as many as the median length."""
        if self.synchronous:
            return self.times[: self.starts[1]]
        low, high = self.times.min(), self.times.max()
        if low == high:
            return np.array([low])
        return np.linspace(low, high, max(2, int(np.median(self.lengths))))

    def split(self, rows: np.ndarray) -> list[np.ndarray]:
        """``rows (N, ...)`` of each candidate."""
        return np.split(rows, self.starts[1:-1])

    def at(self, times: FloatArray) -> FloatArray:
        """All candidates ``(Q, M, D)`` interpolated linearly at ``times (M,)``."""
        if self.synchronous and np.array_equal(times, self.grid()):
            return self.values.reshape(len(self), -1, self.num_dimensions)
        each = zip(self.split(self.times), self.split(self.values), strict=True)
        return np.stack([interpolate(times, clock, block) for clock, block in each])


def _checked_list(name: str, arrays: Sequence[ArrayLike], shape: str) -> list[ArrayLike]:
    try:
        return [] if isinstance(arrays, str | bytes) else list(arrays)
    except TypeError:
        raise InvalidValueError(f"{name} must be a list of arrays {shape}, got {type(arrays).__name__}") from None


def _checked_times(times: Sequence[ArrayLike], shapes: list[tuple[int, ...]]) -> list[FloatArray]:
    clocks = [
        checked_array(f"times[{index}]", clock, "(T_q,)")
        for index, clock in enumerate(_checked_list("times", times, "(T_q,)"))
    ]
    if len(clocks) != len(shapes):
        raise InvalidValueError(f"times must hold one array per candidate, got {len(clocks)} for {len(shapes)}")
    for index, (clock, shape) in enumerate(zip(clocks, shapes, strict=True)):
        if clock.shape != shape[:1]:
            raise InvalidValueError(f"times[{index}] must be ({shape[0]},) like its candidate, got {clock.shape}")
        if clock.min() < 0 or clock.max() > 1 or (np.diff(clock) <= 0).any():
            raise InvalidValueError(f"times[{index}] of shape {clock.shape} must increase strictly within [0, 1]")
    return clocks


def group_matrix(groups: ArrayLike | None, dimension: int) -> FloatArray:
    """Averages ``(D, D)`` over the dimensions that share a label of ``groups (D,)``; each by itself if None."""
    if groups is None:
        return np.eye(dimension)
    try:
        labels = np.asarray(groups)
    except ValueError:
        raise InvalidValueError(f"groups must be ({dimension},), one label a dimension, got a ragged list") from None
    if labels.shape != (dimension,):
        raise InvalidValueError(f"groups must be ({dimension},), one label a dimension, got {labels.shape}")
    same = labels[:, None] == labels
    if not same.diagonal().all():
        raise InvalidValueError("groups must be labels that equal themselves, got NaN")
    return same / same.sum(axis=1)
