"""The model of an arm for motion planning, and the commands for one or more arms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robust_instant_policy.geometry import FloatArray, GripperTriangle
from robust_instant_policy.motion.kinematics import Kinematics


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm with a parallel gripper.

    ``name`` as the task calls it; ``home (J,)`` joint angles in rad; ``finger_travel`` of each finger from closed (0)
    to open, in metres, and ``finger_speed``, m/s; ``joint_speed`` rad/s and ``tool_speed`` m/s are limits;
    ``turn_tolerance``, rad, is the largest accepted orientation error of the tool; ``joint_acceleration`` rad/s² is
    a limit of real arms.
    """

    name: str
    kinematics: Kinematics
    home: FloatArray
    triangle: GripperTriangle
    finger_travel: float
    finger_speed: float
    joint_speed: float
    tool_speed: float
    turn_tolerance: float
    joint_acceleration: float = np.inf

    @property
    def home_pose(self) -> FloatArray:
        """Tool pose ``(4, 4)`` at home."""
        return self.kinematics.tool_pose(self.home)


@dataclass(frozen=True, eq=False)
class Motion:
    """Commands for A arms, one per control step: joint angles ``(N, A, J)`` rad, finger travel ``(N, A)`` m.

    ``poses (N, A, 4, 4)`` and ``closed (N, A)`` bool are the tool poses and gripper states that the commands realise.
    """

    joints: FloatArray
    fingers: FloatArray
    poses: FloatArray
    closed: np.ndarray

    @classmethod
    def at_home(cls, arms: Sequence[Arm]) -> Motion:
        """One step at home with open grippers."""
        return cls(
            np.stack([arm.home for arm in arms])[None],
            np.array([[arm.finger_travel for arm in arms]]),
            np.stack([arm.home_pose for arm in arms])[None],
            np.zeros((1, len(arms)), dtype=bool),
        )

    @property
    def commands(self) -> FloatArray:
        """``(N, A·(J + 1))``: for each arm, the joint angles and the finger travel."""
        return np.concatenate([self.joints, self.fingers[..., None]], axis=-1).reshape(len(self.joints), -1)
