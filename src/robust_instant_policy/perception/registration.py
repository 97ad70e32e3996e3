"""Where an object went: the turn about the vertical and the shift that carry its points onto a new image's points.

Descriptors propose, geometry decides. Every pair of similar descriptors votes for the motions that would explain it
(Hough 1962); the best motions are polished by matching nearest points in space and colour (ICP, Besl and McKay 1992).
Objects stand on a table, so motions turn about the world's vertical only.
"""

from __future__ import annotations

import numpy as np

from robust_instant_policy.geometry import FloatArray

TURN_BINS = 36
SHIFT_BIN_M = 0.015
PEAKS = 4
MATCHES_PER_POINT = 3
VOTE_SHARPNESS = 4  # power of the similarity with which a match votes
COLOUR_SCALE_M = 0.10  # metres that count as much as the difference between black and white in one channel
NEAR_M = 0.010  # residual at which a point counts about a third
ICP_REACH_M = (0.05, 0.04, 0.03, 0.02, 0.015, 0.012, 0.01, 0.01, 0.01, 0.01)  # matches much further apart do not pull


def turns_about_vertical(angles: FloatArray) -> FloatArray:
    """Rotations ``(..., 3, 3)`` by ``angles (...)`` radians about the world's z axis."""
    cos, sin, zero = np.cos(angles), np.sin(angles), np.zeros_like(angles)
    rows = [cos, -sin, zero, sin, cos, zero, zero, zero, zero + 1]
    return np.stack(rows, axis=-1).reshape(*np.shape(angles), 3, 3)


def upright_motions(source: FloatArray, target: FloatArray, weights: FloatArray) -> FloatArray:
    """Motions ``(..., 4, 4)`` that turn about the vertical only and carry ``source (..., N, 3)`` onto
    ``target (..., N, 3)`` with the least squared error under ``weights (..., N)``.
    """
    share = (weights / weights.sum(axis=-1, keepdims=True))[..., None]
    source_mean = (share * source).sum(axis=-2)
    target_mean = (share * target).sum(axis=-2)
    a = (source - source_mean[..., None, :])[..., :2]
    b = (target - target_mean[..., None, :])[..., :2]
    cross = (share[..., 0] * (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])).sum(axis=-1)
    rotation = turns_about_vertical(np.arctan2(cross, (share * a * b).sum(axis=(-2, -1))))
    motion = np.zeros((*rotation.shape[:-2], 4, 4))
    motion[..., :3, :3] = rotation
    motion[..., :3, 3] = target_mean - (rotation @ source_mean[..., None])[..., 0]
    motion[..., 3, 3] = 1
    return motion


def proposals(source: FloatArray, target: FloatArray, similarities: FloatArray) -> FloatArray:
    """At most `PEAKS` motions ``(P, 4, 4)`` on which most matches agree, from ``similarities (N, M)``.

    Each of ``source (N, 3)`` is matched with the `MATCHES_PER_POINT` most similar of ``target (M, 3)``.
    """
    count = min(MATCHES_PER_POINT, len(target))
    best = np.argpartition(-similarities, count - 1, axis=1)[:, :count]
    p = np.repeat(source, count, axis=0)
    q = target[best.reshape(-1)]
    weight = np.maximum(np.take_along_axis(similarities, best, axis=1).reshape(-1), 0) ** VOTE_SHARPNESS
    turns = np.arange(TURN_BINS) * 2 * np.pi / TURN_BINS
    cos, sin = np.cos(turns)[:, None], np.sin(turns)[:, None]
    shift = np.stack([q[:, 0] - (cos * p[:, 0] - sin * p[:, 1]), q[:, 1] - (sin * p[:, 0] + cos * p[:, 1])], axis=-1)
    bins = np.floor((shift - shift.min(axis=(0, 1))) / SHIFT_BIN_M).astype(np.intp) + 1
    width, height = bins.max(axis=(0, 1)) + 2
    flat = (np.arange(TURN_BINS)[:, None] * width + bins[..., 0]) * height + bins[..., 1]
    votes = np.bincount(flat.reshape(-1), np.tile(weight, TURN_BINS), TURN_BINS * width * height)
    votes = votes.reshape(TURN_BINS, width, height)
    for axis in range(3):  # a motion on the border of a bin has its votes in two
        votes = votes + np.roll(votes, 1, axis) + np.roll(votes, -1, axis)
    motions = []
    for _ in range(PEAKS):
        turn, x, y = np.unravel_index(int(votes.argmax()), votes.shape)
        if votes[turn, x, y] <= 0:
            break
        agree = np.zeros(len(p))
        for near in (turn - 1, turn, turn + 1):
            agree += (np.abs(bins[near % TURN_BINS] - (x, y)) <= 1).all(axis=1)
        motions.append(upright_motions(p, q, weight * (agree > 0)))
        votes[np.arange(turn - 3, turn + 4) % TURN_BINS, max(0, x - 3) : x + 4, max(0, y - 3) : y + 4] = 0
    return np.array(motions)


def polish(
    motions: FloatArray, points: FloatArray, colours: FloatArray, target: FloatArray, target_colours: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Refine ``motions (P, 4, 4)`` by closest points in space and colour; also how well each fits, ``(P,)`` in [0, 1].

    ``points (N, 3)`` with ``colours (N, 3)`` are the object; ``target (M, 3)`` with ``target_colours`` the image.
    """
    painted = np.concatenate([target, target_colours * COLOUR_SCALE_M], axis=1).astype(np.float32)
    squared = (painted**2).sum(axis=1)
    own = np.broadcast_to((colours * COLOUR_SCALE_M).astype(np.float32), (len(motions), *colours.shape))
    for reach in (*ICP_REACH_M, 0.0):
        moved = points @ np.swapaxes(motions[:, :3, :3], 1, 2) + motions[:, None, :3, 3]
        query = np.concatenate([moved.astype(np.float32), own], axis=2)
        costs = squared - 2 * (query.reshape(-1, 6) @ painted.T)
        nearest = costs.argmin(axis=1)
        distance = ((query.reshape(-1, 6) - painted[nearest]) ** 2).sum(axis=1).reshape(len(motions), -1)
        if reach:
            weights = np.exp(-distance / reach**2) + 1e-9
            motions = upright_motions(points, target[nearest].reshape(moved.shape), weights)
    return motions, np.exp(-distance / NEAR_M**2).mean(axis=1)
