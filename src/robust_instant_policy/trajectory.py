"""Trajectories of gripper triplets, and the two ways to downsample them (Oh et al. 2025, Sec. V-A.3).

The triplet of the paper is "the gripper and both fingertips when the gripper is open". Its first point, the gripper
point here, lies behind the fingertips on the approach axis. The paper does not say where; in this package it is
wherever `GripperTriangle.length` puts it, which in the simulated tasks is the arm's flange.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.geometry import FloatArray, GripperTriangle, as_numbers, interpolate

ACTION_DIM = 10  # gripper point xyz, two fingertips xyz, gripper state
STATE_INDEX = 9
STATE_ROUNDING = 1e-6  # by which a gripper state may lie outside [0, 1]
TARGET_STEPS = 30  # "a length of approximately 30" (Oh et al. 2025, Sec. V-A.3)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A sequence of gripper triplets with gripper state, over normalised time.

    ``actions (T, 10·A)`` float64, for A arms (nearly always one), each: gripper point xyz, two open-fingertip
    points xyz (metres, world frame), gripper state g (0 open, 1 closed; between them where several plans are averaged,
    not in demonstrations).
    ``times (T,)`` float64, strictly increasing within [0, 1].

    Raises `InvalidValueError` for other shapes, values that are not finite, gripper states outside [0, 1], or times
    out of order.
    """

    actions: FloatArray
    times: FloatArray

    def __post_init__(self) -> None:
        actions = as_numbers("actions", self.actions)
        times = as_numbers("times", self.times)
        if actions.ndim != 2 or actions.shape[0] == 0 or actions.shape[1] == 0 or actions.shape[1] % ACTION_DIM:
            raise InvalidValueError(f"actions must be (T, {ACTION_DIM}) with T >= 1, got {actions.shape}")
        if times.shape != actions.shape[:1]:
            raise InvalidValueError(f"times must be ({len(actions)},) like the actions, got {times.shape}")
        if not np.isfinite(actions).all():
            raise InvalidValueError(f"actions {actions.shape} hold values that are not finite")
        state = actions[:, STATE_INDEX::ACTION_DIM]
        if state.min() < -STATE_ROUNDING or state.max() > 1 + STATE_ROUNDING:
            raise InvalidValueError(
                f"actions {actions.shape} hold gripper states from {state.min():g} to {state.max():g}; "
                "they must be scaled to 0 (open) to 1 (closed)"
            )
        if not (np.isfinite(times).all() and times.min() >= 0 and times.max() <= 1 and (np.diff(times) > 0).all()):
            raise InvalidValueError(f"times {times.shape} must increase strictly within [0, 1]")
        actions.flags.writeable = False
        times.flags.writeable = False
        object.__setattr__(self, "actions", actions)
        object.__setattr__(self, "times", times)

    @classmethod
    def from_actions(cls, actions: ArrayLike) -> Trajectory:
        """Evenly timed trajectory from ``actions (T, 10·A)``."""
        actions = as_numbers("actions", actions)
        return cls(actions, np.linspace(0.0, 1.0, len(actions)) if actions.ndim else np.zeros(0))

    @classmethod
    def from_poses(cls, poses: ArrayLike, gripper_state: ArrayLike, triangle: GripperTriangle) -> Trajectory:
        """Evenly timed trajectory from tool ``poses (T, A, 4, 4)`` and ``gripper_state (T, A)`` of A arms.

        The arms' axis may be left out where there is one arm: ``(T, 4, 4)`` and ``(T,)``.
        """
        triplets = triangle.triplets(poses)
        state = np.asarray(gripper_state, dtype=np.float64)
        actions = np.concatenate([triplets.reshape(*triplets.shape[:-2], STATE_INDEX), state[..., None]], axis=-1)
        return cls.from_actions(actions.reshape(len(actions), ACTION_DIM * int(np.prod(actions.shape[1:-1]))))

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def num_arms(self) -> int:
        return self.actions.shape[1] // ACTION_DIM

    @property
    def triplets(self) -> FloatArray:
        """Gripper point and fingertips ``(T, A, 3, 3)``, metres, world frame."""
        return self.actions.reshape(len(self), self.num_arms, ACTION_DIM)[:, :, :STATE_INDEX].reshape(
            len(self), self.num_arms, 3, 3
        )

    @property
    def tool_points(self) -> FloatArray:
        """Points midway between the fingertips ``(T, A, 3)``, metres, world frame."""
        return self.triplets[:, :, 1:].mean(axis=2)

    @property
    def gripper_state(self) -> FloatArray:
        """Gripper state ``(T, A)``: 0 open, 1 closed."""
        return self.actions[:, STATE_INDEX::ACTION_DIM]

    def resampled(self, times: ArrayLike) -> Trajectory:
        """The trajectory at other ``times (M,)``: points linear in time, gripper state held until it changes."""
        times = np.asarray(times, dtype=np.float64)
        actions = interpolate(times, self.times, self.actions)
        held = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self) - 1)
        actions[:, STATE_INDEX::ACTION_DIM] = self.gripper_state[held]
        return Trajectory(actions, times)

    def subset(self, steps: ArrayLike) -> Trajectory:
        """The chosen ``steps (M,)`` (increasing indices), retimed evenly, as the robot plays them back."""
        return Trajectory.from_actions(self.actions[np.asarray(steps, dtype=np.intp)])


def uniform_steps(trajectory: Trajectory, length: int = TARGET_STEPS) -> np.ndarray:
    """Indices of at most ``length`` evenly spaced steps, ends included (KAT's downsampling)."""
    count = min(length, len(trajectory))
    return np.unique(np.round(np.linspace(0, len(trajectory) - 1, count)).astype(np.intp))


def masked_steps(trajectory: Trajectory, length: int = TARGET_STEPS) -> np.ndarray:
    """Indices of about ``length`` steps that keep start, end and both sides of every gripper change.

    The kept steps are those with ``|g[t+1] - g[t]| = 1`` and their successors; the remaining budget is
    spread over the gaps between them in proportion to their duration (Oh et al. 2025, Sec. V-A.3).
    Trajectories of ``length`` steps or fewer are kept whole.
    """
    total = len(trajectory)
    if total <= length:
        return np.arange(total)
    closed = trajectory.gripper_state > 0.5  # a measured state may pass through what is between
    changes = np.flatnonzero((closed[1:] != closed[:-1]).any(axis=1))
    kept = np.unique(np.concatenate([[0, total - 1], changes, changes + 1]))
    gaps = np.diff(kept) - 1
    budget = max(length - len(kept), 0)
    ideal = budget * gaps / max(gaps.sum(), 1)
    share = np.floor(ideal).astype(np.intp)
    for gap in np.argsort(share - ideal, kind="stable")[: budget - share.sum()]:
        share[gap] += 1
    inner = [
        np.round(np.linspace(start, stop, count + 2)[1:-1]).astype(np.intp)
        for start, stop, count in zip(kept[:-1], kept[1:], share, strict=True)
    ]
    return np.unique(np.concatenate([kept, *inner]))


def downsample(trajectory: Trajectory, method: str = "masked", length: int = TARGET_STEPS) -> Trajectory:
    """Thin ``trajectory`` out to about ``length`` steps; ``method`` is ``"masked"`` or ``"uniform"``."""
    steps = {"masked": masked_steps, "uniform": uniform_steps}
    if method not in steps:
        raise InvalidValueError(f"downsampling must be 'masked' or 'uniform', got {method!r}")
    return trajectory.subset(steps[method](trajectory, length))
