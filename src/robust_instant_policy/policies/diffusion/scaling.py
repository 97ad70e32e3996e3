"""Numbers brought to [-1, 1], which is where diffusion works."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robust_instant_policy.geometry import FloatArray

MARGIN = 1.1  # of the range seen: a new scene may lie a little outside it
LEAST_HALF_RANGE = 0.02  # metres (or of the gripper's state): noise in what never changes must not be blown up


@dataclass(frozen=True, eq=False)
class Scaling:
    """Each of D numbers by its own ``middle (D,)`` and ``half_range (D,)``."""

    middle: FloatArray
    half_range: FloatArray

    @classmethod
    def of(cls, values: FloatArray) -> Scaling:
        """That brings ``values (..., D)`` well into [-1, 1]."""
        rows = values.reshape(-1, values.shape[-1])
        low, high = rows.min(axis=0), rows.max(axis=0)
        return cls((low + high) / 2, np.maximum(MARGIN * (high - low) / 2, LEAST_HALF_RANGE))

    def scaled(self, values: FloatArray) -> FloatArray:
        return (values - self.middle) / self.half_range

    def restored(self, values: FloatArray) -> FloatArray:
        return values * self.half_range + self.middle
