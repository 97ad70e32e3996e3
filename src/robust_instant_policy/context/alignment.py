"""Align demonstrations at their gripper changes, and between them by dynamic time warping.

Each demonstration is split into segments of constant gripper state. Demonstrations with the same order of states are
aligned segment by segment, so that "the last step before the grasp" is the same step in all. Within a segment a person
or a scripted expert turns, waits and hurries at other times in each: there, steps that mean the same are matched.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from robust_instant_policy.context.candidates import NOISE_M
from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.geometry import FloatArray, interpolate
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX, Trajectory

CURVATURE_MARGIN = 2.0  # a new scene may need this many times the curvature that was shown
MIN_CURVATURE_M = 0.003
MIN_WARPED_STEPS = 4  # of a segment
WARPING_ROUNDS = 5
WAITING_M = 0.003  # cost of a step in which a demonstration waits for the others, or they for it


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
    resampled evenly over their whole length. Raises `InvalidValueError` without trajectories.
    """
    if not trajectories:
        raise InvalidValueError("no trajectories to align")
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
    parts = [
        _synchronised([trajectories[index].actions[slice(*segments[index][part][1:])] for index in kept], length)
        for part, length in enumerate(lengths)
    ]
    actions = np.concatenate(parts, axis=1)
    starts = np.cumsum([0, *lengths])
    edges = {0, int(starts[-1]) - 1, *map(int, starts[1:-1]), *(int(start) - 1 for start in starts[1:-1])}
    return AlignedDemonstrations(actions, kept, tuple(sorted(edges)))


def _segments(trajectory: Trajectory) -> list[tuple[tuple[int, ...], int, int]]:
    """Segments of constant gripper state: (state of each arm, first step, step after the last)."""
    states = [tuple(int(value > 0.5) for value in row) for row in trajectory.gripper_state]
    edges = [0, *(step for step in range(1, len(states)) if states[step] != states[step - 1]), len(states)]
    return [(states[start], start, stop) for start, stop in pairwise(edges)]


def _synchronised(segments: Sequence[FloatArray], length: int) -> FloatArray:
    """One segment of all demonstrations, ``(n, 10·A)`` each, at ``length`` steps that mean the same: ``(I, length,
    10·A)``.

    First resampled evenly; then in turn each step's place is fitted as a function of the segment's ends (`_typical`),
    and each demonstration resampled where it comes nearest to these places, in order (`_warped_times`).
    """
    ends = [len(own) - 1.0 for own in segments]
    times = [np.linspace(0, end, length) if length > 1 else np.array([end]) for end in ends]
    if length >= MIN_WARPED_STEPS and len(segments) > 1:
        even = [_at(own, at) for own, at in zip(segments, times, strict=True)]
        paths = np.stack([_tips(own) for own in even])
        warped = paths
        for _ in range(WARPING_ROUNDS):
            at = _warped_times(_typical(warped), paths)
            warped = np.stack([_at(own, shares) for own, shares in zip(paths, at, strict=True)])
        return np.stack([_at(own, shares) for own, shares in zip(even, at, strict=True)])
    return np.stack([_at(own, at) for own, at in zip(segments, times, strict=True)])


def _tips(actions: FloatArray) -> FloatArray:
    """Middle between the fingertips of each arm ``(n, 3·A)``, metres."""
    arms = actions.reshape(len(actions), -1, ACTION_DIM)
    return arms[:, :, 3:STATE_INDEX].reshape(*arms.shape[:2], 2, 3).mean(axis=2).reshape(len(actions), -1)


def _typical(paths: FloatArray) -> FloatArray:
    """The path ``(I, n, D)`` that is expected between the two ends of each of ``paths (I, n, D)``, metres.

    At each step a constant distance from the first point and a share of the way to the last one, the same in all.
    """
    first = paths[:, :1]
    way = paths[:, -1:] - first
    away, spread = paths - first, way - way.mean(axis=0)
    share = (spread * away).sum(axis=(0, 2)) / ((spread**2).sum() + NOISE_M**2)
    constant = np.median(away - share[:, None] * way, axis=0)
    return first + constant + share[:, None] * way


def _warped_times(paths: FloatArray, others: FloatArray) -> FloatArray:
    """For each pair, the steps ``(I, n)`` of ``others (I, m, D)`` that correspond to those of ``paths (I, n, D)``,
    metres: dynamic time warping (Sakoe and Chiba 1978), with a cost where one waits for the other."""
    distance = np.linalg.norm(paths[:, :, None] - others[:, None], axis=-1)
    count, n, m = distance.shape
    total = np.full((n + 1, m + 1, count), np.inf)
    total[0, 0] = 0.0
    for i in range(n):
        for j in range(m):
            waits = np.minimum(total[i, j + 1], total[i + 1, j]) + WAITING_M
            total[i + 1, j + 1] = distance[:, i, j] + np.minimum(total[i, j], waits)
    times = np.stack([_matched(total[..., pair]) for pair in range(count)])
    times[:, 0], times[:, -1] = 0.0, m - 1.0
    return times


def _matched(total: FloatArray) -> FloatArray:
    """For each of n steps the mean ``(n,)`` of those that are matched with it, from the costs ``(n + 1, m + 1)``."""
    i, j = total.shape[0] - 1, total.shape[1] - 1
    cost = total.tolist()  # lists are read several times as fast as single elements of an array
    matched: list[list[int]] = [[] for _ in range(i)]
    while i and j:
        matched[i - 1].append(j - 1)
        before = (cost[i - 1][j - 1], cost[i - 1][j] + WAITING_M, cost[i][j - 1] + WAITING_M)
        i, j = ((i - 1, j - 1), (i - 1, j), (i, j - 1))[before.index(min(before))]
    return np.array([sum(own) / len(own) for own in matched])


def _at(actions: FloatArray, times: FloatArray) -> FloatArray:
    """``actions (n, D)`` between their steps, at ``times (m,)``."""
    return interpolate(times, np.arange(len(actions)), actions)
