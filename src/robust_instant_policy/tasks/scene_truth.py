"""The simulator's ground truth for an image, to measure perception; not for policies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robust_instant_policy.geometry import FloatArray, invert_pose, transform_points


@dataclass(frozen=True, eq=False)
class SceneTruth:
    """``parts (H, W)`` int: index into ``names`` and ``poses (P, 4, 4)`` of the visible rigid part, -1 for none."""

    parts: NDArray[np.int64]
    names: tuple[str, ...]
    poses: FloatArray

    def material_point(self, point: ArrayLike, part: str) -> FloatArray:
        """World ``point (3,)`` in the frame of ``part``: constant over scenes for a material point."""
        return transform_points(invert_pose(self.poses[self.names.index(part)]), point)
