"""The simulator's ground truth for an image, to measure perception; not for policies."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.geometry import FloatArray


@dataclass(frozen=True, eq=False)
class SceneTruth:
    """``parts (H, W)`` int: index into ``names`` and ``poses (P, 4, 4)`` of the visible rigid part, -1 for none."""

    parts: NDArray[np.int64]
    names: tuple[str, ...]
    poses: FloatArray
