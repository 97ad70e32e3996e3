"""What a network says about a gripper, made into one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robust_instant_policy.geometry import FloatArray, GripperTriangle
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX

CLOSED = 0.5  # gripper states above this are closed


@dataclass(frozen=True)
class Grippers:
    """The rigid triangle of each of A arms."""

    triangles: tuple[GripperTriangle, ...]

    @classmethod
    def of(cls, actions: FloatArray) -> Grippers:
        """Those of demonstrated ``actions (..., 10·A)``."""
        arms = actions.reshape(-1, actions.shape[-1] // ACTION_DIM, ACTION_DIM)[..., :STATE_INDEX]
        return cls(tuple(GripperTriangle.from_triplets(arm.reshape(-1, 3, 3)) for arm in np.swapaxes(arms, 0, 1)))

    def nearest(self, actions: FloatArray) -> FloatArray:
        """``actions (T, 10·A)`` with rigid grippers, each open or closed."""
        arms = actions.reshape(len(actions), -1, ACTION_DIM).copy()
        for arm, triangle in enumerate(self.triangles):
            points = arms[:, arm, :STATE_INDEX].reshape(-1, 3, 3)
            arms[:, arm, :STATE_INDEX] = triangle.triplets(triangle.poses(points)).reshape(-1, STATE_INDEX)
        arms[..., STATE_INDEX] = arms[..., STATE_INDEX] > CLOSED
        return arms.reshape(actions.shape)
