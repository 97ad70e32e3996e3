"""Candidates of different lengths on one normalised time axis, without resampling them.

"The time step t is normalized to the maximum length of each trajectory" (Oh et al. 2025, Sec. IV): every candidate
starts at 0 and ends at 1. Candidates keep their own samples; the curve fitted to them is evaluated at their times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.geometry import FloatArray


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
        try:
            arrays = [np.asarray(candidate, dtype=np.float64) for candidate in candidates]
        except (TypeError, ValueError) as error:
            raise InvalidValueError(f"candidates must be a list of arrays (T_q, D) of numbers: {error}") from None
        if not arrays:
            raise InvalidValueError("candidates must hold at least one array (T_q, D), got an empty list")
        shapes = [array.shape for array in arrays]
        for index, array in enumerate(arrays):
            if array.ndim != 2 or array.shape[0] == 0 or array.shape[1] == 0:
                raise InvalidValueError(
                    f"candidates[{index}] must be (T_q, D) with T_q >= 1 and D >= 1, got shape {array.shape}"
                )
            if not np.isfinite(array).all():
                raise InvalidValueError(
                    f"candidates[{index}] of shape {array.shape} holds values that are not finite "
                    f"(first at step {int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])})"
                )
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

    @property
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

    @property
    def synchronous(self) -> bool:
        """Whether all candidates were sampled at the same times."""
        lengths = self.lengths
        if (lengths != lengths[0]).any():
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
        """Rows ``(N, ...)`` given back candidate by candidate."""
        return np.split(rows, self.starts[1:-1])

    def at(self, times: FloatArray) -> FloatArray:
        """All candidates ``(Q, M, D)`` interpolated linearly at ``times (M,)``; for starting points only."""
        if self.synchronous and np.array_equal(times, self.grid()):
            return self.values.reshape(len(self), -1, self.num_dimensions)
        return np.stack(
            [
                np.stack([np.interp(times, clock, column) for column in block.T], axis=1)
                for clock, block in zip(self.split(self.times), self.split(self.values), strict=True)
            ]
        )


def _checked_times(times: Sequence[ArrayLike], shapes: list[tuple[int, ...]]) -> list[FloatArray]:
    clocks = [np.asarray(clock, dtype=np.float64) for clock in times]
    if len(clocks) != len(shapes):
        raise InvalidValueError(f"times must hold one array per candidate, got {len(clocks)} for {len(shapes)}")
    for index, (clock, shape) in enumerate(zip(clocks, shapes, strict=True)):
        if clock.shape != shape[:1]:
            raise InvalidValueError(f"times[{index}] must be ({shape[0]},) like its candidate, got {clock.shape}")
        if not np.isfinite(clock).all() or clock.min() < 0 or clock.max() > 1 or (np.diff(clock) <= 0).any():
            raise InvalidValueError(f"times[{index}] of shape {clock.shape} must increase strictly within [0, 1]")
    return clocks


def checked_dof(dof: float) -> float:
    """The degree of freedom ν as a float; raises `InvalidValueError` unless it is positive (infinity is Gaussian)."""
    try:
        value = float(dof)
    except (TypeError, ValueError):
        raise InvalidValueError(f"dof must be a positive number or inf, got {dof!r}") from None
    if not value > 0:
        raise InvalidValueError(f"dof must be positive (inf is Gaussian), got {value} (a scalar, shape ())")
    return value


def group_matrix(groups: ArrayLike | None, dimension: int) -> FloatArray:
    """Averages ``(D, D)`` over the dimensions that share a label of ``groups (D,)``; each by itself if None."""
    if groups is None:
        return np.eye(dimension)
    labels = np.asarray(groups)
    if labels.shape != (dimension,):
        raise InvalidValueError(f"groups must be ({dimension},), one label a dimension, got {labels.shape}")
    same = labels[:, None] == labels
    return same / same.sum(axis=1)
