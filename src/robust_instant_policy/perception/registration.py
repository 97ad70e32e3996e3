"""Where an object went: the turn about the vertical and the shift that carry its points onto a new image's points.

Descriptors propose, geometry decides. Every pair of similar descriptors votes for the motions that would explain it
(Hough 1962); the best motions are polished by matching nearest points in space and colour (ICP), and the one that
explains the object best wins. Objects stand on a table, so motions turn about the world's vertical only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from robust_instant_policy.geometry import FloatArray, make_pose, transform_points

TURN_BINS = 36
SHIFT_BIN = 0.015  # metres
PEAKS = 4
MATCHES_PER_POINT = 3
COLOUR_SCALE = 0.10  # metres that count as much as the difference between black and white in one channel
NEAR = 0.010  # metres of residual at which a point counts about a third
ICP_REACH = (0.05, 0.04, 0.03, 0.02, 0.015, 0.012, 0.012, 0.012)  # metres; matches further apart are dropped


@dataclass(frozen=True, eq=False)
class Registration:
    """A found motion: ``pose (4, 4)`` carries the model's points into the new image's world; ``fit`` in [0, 1]."""

    pose: FloatArray
    fit: float


def upright_motion(source: FloatArray, target: FloatArray, weights: FloatArray) -> FloatArray:
    """Best motion ``(4, 4)`` that turns about the vertical only, from ``source (N, 3)`` to ``target (N, 3)``."""
    share = weights / weights.sum()
    source_mean, target_mean = share @ source, share @ target
    a = (source - source_mean)[:, :2]
    b = (target - target_mean)[:, :2]
    turn = np.arctan2(share @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), share @ (a * b).sum(axis=1))
    rotation = turn_about_vertical(turn)
    return make_pose(rotation, target_mean - rotation @ source_mean)


def turn_about_vertical(angle: float) -> FloatArray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def vote(source: FloatArray, target: FloatArray, similarities: FloatArray) -> list[FloatArray]:
    """The `PEAKS` motions that most pairs agree on, from ``similarities (N, M)`` of source and target points."""
    count = min(MATCHES_PER_POINT, len(target))
    best = np.argpartition(-similarities, count - 1, axis=1)[:, :count]
    p = np.repeat(source, count, axis=0)
    q = target[best.reshape(-1)]
    value = np.take_along_axis(similarities, best, axis=1).reshape(-1)
    weight = np.maximum(value, 0) ** 4
    turns = np.arange(TURN_BINS) * 2 * np.pi / TURN_BINS
    cos, sin = np.cos(turns)[:, None], np.sin(turns)[:, None]
    shift = np.stack([q[:, 0] - (cos * p[:, 0] - sin * p[:, 1]), q[:, 1] - (sin * p[:, 0] + cos * p[:, 1])], axis=-1)
    low = shift.reshape(-1, 2).min(axis=0)
    index = np.floor((shift - low) / SHIFT_BIN).astype(np.intp)
    size = index.reshape(-1, 2).max(axis=0) + 1
    flat = (np.arange(TURN_BINS)[:, None] * size[0] + index[..., 0]) * size[1] + index[..., 1]
    votes = np.bincount(flat.reshape(-1), np.tile(weight, TURN_BINS), TURN_BINS * size[0] * size[1])
    votes = votes.reshape(TURN_BINS, *size)
    padded = np.pad(votes, ((0, 0), (1, 1), (1, 1)))
    votes = sum(
        padded[:, 1 + dx : 1 + dx + size[0], 1 + dy : 1 + dy + size[1]] for dx in (-1, 0, 1) for dy in (-1, 0, 1)
    )
    votes = votes + np.roll(votes, 1, axis=0) + np.roll(votes, -1, axis=0)
    motions = []
    rise = np.median(target[:, 2]) - np.median(source[:, 2])
    for _ in range(PEAKS):
        turn, x, y = np.unravel_index(int(votes.argmax()), votes.shape)
        if votes[turn, x, y] <= 0:
            break
        motions.append(
            make_pose(turn_about_vertical(turns[turn]), [*(low + (np.array([x, y]) + 0.5) * SHIFT_BIN), rise])
        )
        near = (np.arange(-3, 4) + turn) % TURN_BINS
        votes[near, max(0, x - 3) : x + 4, max(0, y - 3) : y + 4] = 0
    return motions


def polish(pose: FloatArray, points: FloatArray, colours: FloatArray, tree: cKDTree) -> Registration:
    """Iterated closest points in space and colour; ``tree`` holds the image's ``[xyz, colour · COLOUR_SCALE]``."""
    painted = colours * COLOUR_SCALE
    for reach in ICP_REACH:
        moved = transform_points(pose, points)
        distance, nearest = tree.query(np.concatenate([moved, painted], axis=1), distance_upper_bound=reach)
        found = np.isfinite(distance)
        if found.sum() < 3:
            return Registration(pose, 0.0)
        weights = np.exp(-((distance[found] / reach) ** 2))
        pose = upright_motion(points[found], tree.data[nearest[found], :3], weights)
    distance, _ = tree.query(np.concatenate([transform_points(pose, points), painted], axis=1))
    return Registration(pose, float(np.exp(-((distance / NEAR) ** 2)).mean()))
