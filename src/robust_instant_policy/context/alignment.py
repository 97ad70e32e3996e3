"""Align demonstrations at their gripper changes.

Each demonstration is split into segments of constant gripper state. Demonstrations with the same order of states are
aligned segment by segment, so that "the last step before the grasp" is the same step in all.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX, Trajectory

CURVATURE_MARGIN = 2.0  # a new scene may need this many times the curvature that was shown
MIN_CURVATURE_M = 0.003


@dataclass(frozen=True, eq=False)
class AlignedDemonstrations:
    """Actions ``(I, T, 10·A)`` of the demonstrations ``kept`` (indices), step t meaning the same in each.

    ``key_steps`` are the first and last step and both sides of every gripper change.
    """

    actions: FloatArray
    kept: tuple[int, ...]
    key_steps: tuple[int, ...]

    @property
    def num_arms(self) -> int:
        return self.actions.shape[2] // ACTION_DIM

    def curvature(self) -> FloatArray:
        """How sharply the gripper is expected to turn at each step: the standard deviation ``(T,)``, metres, of a
        coordinate's second difference.

        `CURVATURE_MARGIN` times what was shown at that step and its neighbours, because a new scene may need sharper
        turns, a step earlier or later. Two values where there are fewer than three steps.
        """
        demos, steps = self.actions.shape[:2]
        if steps < 3:
            return np.full(2, MIN_CURVATURE_M)
        arms = self.actions.reshape(demos, steps, -1, ACTION_DIM)
        points = arms[..., :STATE_INDEX].reshape(demos, steps, -1, 3)
        differences = np.diff(points, n=2, axis=1)
        shown = np.sqrt((differences**2).mean(axis=-1).max(axis=-1).mean(axis=0))  # of the point that turns most
        near = np.pad(shown, 2, mode="edge")
        return np.maximum(CURVATURE_MARGIN * np.max([near[:-2], near[1:-1], near[2:]], axis=0), MIN_CURVATURE_M)


def align(trajectories: Sequence[Trajectory]) -> AlignedDemonstrations:
    """Resample ``trajectories`` to a common number of steps: in each segment the median of theirs.

    Demonstrations whose order of gripper states is not that of the majority are left out. Without a majority all are
    resampled evenly over their whole length.
    """
    segments = [_segments(trajectory) for trajectory in trajectories]
    orders = [tuple(state for state, _, _ in parts) for parts in segments]
    order, votes = Counter(orders).most_common(1)[0]
    if 2 * votes <= len(trajectories) and votes < len(trajectories):
        length = round(float(np.median([len(trajectory) for trajectory in trajectories])))
        at = np.linspace(0, 1, length)
        even = [Trajectory.from_actions(trajectory.actions).resampled(at).actions for trajectory in trajectories]
        return AlignedDemonstrations(np.stack(even), tuple(range(len(trajectories))), (0, length - 1))

    kept = tuple(index for index, own in enumerate(orders) if own == order)
    lengths = [
        max(1, round(float(np.median([segments[index][part][2] - segments[index][part][1] for index in kept]))))
        for part in range(len(order))
    ]
    actions = np.stack(
        [
            np.concatenate(
                [
                    _resampled(trajectories[index].actions[start:stop], length)
                    for (_, start, stop), length in zip(segments[index], lengths, strict=True)
                ]
            )
            for index in kept
        ]
    )
    starts = np.cumsum([0, *lengths])
    edges = {0, int(starts[-1]) - 1, *map(int, starts[1:-1]), *(int(start) - 1 for start in starts[1:-1])}
    return AlignedDemonstrations(actions, kept, tuple(sorted(edges)))


def _segments(trajectory: Trajectory) -> list[tuple[tuple[int, ...], int, int]]:
    """Segments of constant gripper state: (state of each arm, first step, step after the last)."""
    states = [tuple(int(value > 0.5) for value in row) for row in trajectory.gripper_state]
    edges = [0, *(step for step in range(1, len(states)) if states[step] != states[step - 1]), len(states)]
    return [(states[start], start, stop) for start, stop in pairwise(edges)]


def _resampled(actions: FloatArray, length: int) -> FloatArray:
    at = np.linspace(0, len(actions) - 1, length) if length > 1 else np.array([len(actions) - 1.0])
    steps = np.arange(len(actions))
    return np.stack([np.interp(at, steps, column) for column in actions.T], axis=1)
