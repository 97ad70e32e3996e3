"""The simulator's own knowledge of a photograph, to measure perception against; no policy may see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robust_instant_policy.geometry import FloatArray, invert_pose, transform_points


@dataclass(frozen=True, eq=False)
class SceneTruth:
    """``parts (H, W)`` int: index into ``names`` and ``poses (P, 4, 4)`` of the rigid part seen, -1 for none."""

    parts: NDArray[np.int64]
    names: tuple[str, ...]
    poses: FloatArray

    def material_point(self, point: ArrayLike, part: str) -> FloatArray:
        """World ``point (3,)`` in the frame of ``part``: the same in every scene for the same spot of its surface."""
        return transform_points(invert_pose(self.poses[self.names.index(part)]), point)

    def world_point(self, material_point: ArrayLike, part: str) -> FloatArray:
        """Where the spot ``material_point (3,)`` of ``part`` is in this scene."""
        return transform_points(self.poses[self.names.index(part)], material_point)
