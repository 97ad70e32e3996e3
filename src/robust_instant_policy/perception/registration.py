"""Where an object went: the turn about the vertical and the shift that carry its points onto a new image's points.

Descriptors propose, geometry decides. Every pair of similar descriptors votes for the motions that would explain it
(Hough 1962); the best motions are polished by matching nearest points in space and colour (ICP, Besl and McKay 1992).
Objects stand on a table, so motions turn about the world's vertical only.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from robust_instant_policy.geometry import FloatArray, fit_upright, rotations_about_vertical, transform_points
from robust_instant_policy.perception.descriptors import Float32Array

TURN_BINS = 24
SHIFT_BIN_M = 0.015
PEAKS = 4
MATCHES_PER_POINT = 3
MAX_VOTERS = 400  # the most similar matches; the others say nothing new
VOTE_SHARPNESS = 4  # power of the similarity with which a match votes
COLOUR_SCALE_M = 0.06  # metres that count as much as the difference between black and white in one channel
COLOUR_CAP_M = 0.010  # and no difference counts more: objects of one kind come in many colours
NEAR_M = 0.010  # residual at which a point counts about a third
OWN_M = 0.04  # image points further from the object are not its own
VARIANT_TURNS = np.deg2rad([0.0, -25.0, 25.0])
SYMMETRY_TURNS = np.deg2rad([-20.0, -15.0, -10.0, -5.0, 0.0, 5.0, 10.0, 15.0, 20.0])  # the middle one is none
SYMMETRY_LOSS = 0.04  # of the fit; an object that loses less by these turns looks the same from all sides
OPINION_SCALE = 0.01  # of the agreement; how much a worse turn counts
COARSE_POINTS = 60
FINALISTS = 3
COARSE_REACH_M = (0.06, 0.04, 0.03, 0.02)
PATCH_REACH_M = (0.03, 0.025, 0.02, 0.015, 0.015)
FINE_REACH_M = (0.02, 0.015, 0.015, 0.01, 0.01)


def proposals(source: FloatArray, target: FloatArray, similarities: Float32Array) -> FloatArray:
    """At most `PEAKS` motions ``(P, 4, 4)`` on which most matches agree, from ``similarities (N, M)``.

    Each of ``source (N, 3)`` is matched with the `MATCHES_PER_POINT` most similar of ``target (M, 3)``.
    """
    count = min(MATCHES_PER_POINT, len(target))
    best = np.argpartition(-similarities, count - 1, axis=1)[:, :count]
    # Turned about the object's middle, a shift is where the object goes, and few bins hold them all.
    middle = source.mean(axis=0)
    likeness = np.take_along_axis(similarities, best, axis=1).reshape(-1)
    voters = np.argsort(-likeness, kind="stable")[:MAX_VOTERS]
    p = (source - middle)[voters // count]
    q = target[best.reshape(-1)[voters]]
    weight = np.maximum(likeness[voters], 0).astype(np.float64) ** VOTE_SHARPNESS
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
        motions.append(fit_upright(p + middle, q, weight * (agree > 0)))
        votes[np.arange(turn - 3, turn + 4) % TURN_BINS, max(0, x - 3) : x + 4, max(0, y - 3) : y + 4] = 0
    return np.array(motions)


def polish(
    motions: FloatArray, source: Float32Array, target: Float32Array, agreement: Callable[[FloatArray], FloatArray]
) -> tuple[FloatArray, float, float]:
    """The best of ``motions (P, 4, 4)`` after refinement, and its fit and agreement, both in [0, 1].

    ``source (N, 6)`` and ``target (M, 6)`` are points with their colours (see `painted`); ``agreement`` says how well
    the descriptors agree with each of several motions. First all motions, and the same turned by `VARIANT_TURNS`,
    on a few points; then the best `FINALISTS` on all points.
    """
    middle = source[:, :3].mean(axis=0)
    tries = np.concatenate([turned(motion, middle, VARIANT_TURNS) for motion in motions])
    coarse = source[:: max(1, len(source) // COARSE_POINTS)], target[:: max(1, len(target) // (3 * COARSE_POINTS))]
    tries, fits = closest_points(tries, *coarse, COARSE_REACH_M)
    leading = np.argsort(-fits - agreement(tries))[:FINALISTS]
    finalists, fits = closest_points(tries[leading], source, target, FINE_REACH_M)
    agreements = agreement(finalists)
    best = int((fits + agreements).argmax())
    motion = finalists[best]
    near = turned(motion, middle, SYMMETRY_TURNS)
    turned_fits = closest_points(near, *coarse, ())[1]
    if turned_fits.min() > turned_fits[len(near) // 2] - SYMMETRY_LOSS:
        # Points alone cannot tell how a disc is turned; the descriptors' opinion is averaged.
        opinion = agreement(near)
        share = np.exp((opinion - opinion.max()) / OPINION_SCALE)
        motion = turned(motion, middle, np.atleast_1d(share @ SYMMETRY_TURNS / share.sum()))[0]
    return motion, float(fits[best]), float(agreements[best])


def turned(motion: FloatArray, middle: FloatArray, angles: FloatArray) -> FloatArray:
    """``motion (4, 4)`` followed by upright turns by ``angles (A,)`` about ``middle (3,)``: ``(A, 4, 4)``."""
    result = np.repeat(motion[None], len(angles), axis=0)
    result[:, :3, :3] = rotations_about_vertical(angles) @ motion[:3, :3]
    result[:, :3, 3] += (motion[:3, :3] - result[:, :3, :3]) @ middle
    return result


def closest_points(
    motions: FloatArray, source: Float32Array, target: Float32Array, reaches: tuple[float, ...]
) -> tuple[FloatArray, FloatArray]:
    """ICP in both directions, one round for each of ``reaches`` (metres), matches much further apart not pulling.

    Both directions, because an object slid along itself covers its old place well: only the points left bare tell.
    """
    count, size = len(motions), len(source)
    places, goals = np.ascontiguousarray(source[:, :3]), np.ascontiguousarray(target[:, :3])
    fixed = _paint(source, target) + (goals**2).sum(axis=1)
    towards = np.ascontiguousarray(-2 * goals.T)
    costs = np.empty((count, size, len(target)), dtype=np.float32)  # one for all rounds: making it anew is slow
    fits = np.zeros(count)
    for reach in (*reaches, 0.0):
        moved = (places @ np.swapaxes(motions[:, :3, :3], 1, 2) + motions[:, None, :3, 3]).astype(np.float32)
        np.matmul(moved, towards, out=costs)
        costs += fixed
        costs += np.einsum("cnx,cnx->cn", moved, moved)[..., None]
        forth, back = costs.argmin(axis=2), costs.argmin(axis=1)
        forth_cost = np.take_along_axis(costs, forth[..., None], axis=2)[..., 0]
        back_cost = np.take_along_axis(costs, back[:, None], axis=1)[:, 0]
        own = back_cost < OWN_M**2  # the rest of the image belongs to something else
        if reach:
            weights = np.concatenate([np.exp(-forth_cost / reach**2), own * np.exp(-back_cost / reach**2)], axis=1)
            source_points = np.concatenate([np.broadcast_to(places, (count, size, 3)), places[back]], axis=1)
            target_points = np.concatenate([goals[forth], np.broadcast_to(goals, (count, len(goals), 3))], axis=1)
            motions = fit_upright(source_points, target_points, weights + np.float32(1e-9))
        else:
            explained = (own * np.exp(-back_cost / NEAR_M**2)).sum(axis=1) / np.maximum(own.sum(axis=1), 1)
            fits = np.sqrt(np.exp(-forth_cost / NEAR_M**2).mean(axis=1) * explained)
    return motions, fits


def _paint(source: Float32Array, target: Float32Array) -> Float32Array:
    """How much the colours of ``source (N, 6)`` and ``target (M, 6)`` differ: ``(N, M)`` square metres, capped."""
    a, b = source[:, 3:], target[:, 3:]
    squares = a @ (-2 * b.T)
    squares += (b**2).sum(axis=1)
    squares += (a**2).sum(axis=1)[:, None]
    return np.minimum(squares, np.float32(COLOUR_CAP_M**2), out=squares)


def painted(points: FloatArray, colours: Float32Array) -> Float32Array:
    """Points with their colours ``(N, 6)``, all in metres."""
    return np.concatenate([points, colours * COLOUR_SCALE_M], axis=1).astype(np.float32)


def local_shift(pose: FloatArray, patch: Float32Array, target: Float32Array) -> FloatArray:
    """Shift ``(3,)`` that brings a ``patch (N, 6)`` of an object, at ``pose``, onto the image's nearest points.

    One way only and without turning: what an even surface does not tell (how far along it) stays as it was, while
    edges, handles and tips of an object of another size are followed.
    """
    moved = transform_points(pose, patch[:, :3].astype(np.float64))
    goals = target[:, :3].astype(np.float64)
    fixed = _paint(patch, target) + (goals**2).sum(axis=1)
    shift = np.zeros(3)
    for reach in PATCH_REACH_M:
        there = moved + shift
        costs = fixed - 2 * there @ goals.T + (there**2).sum(axis=1)[:, None]
        nearest = costs.argmin(axis=1)
        weights = np.exp(-costs[np.arange(len(moved)), nearest] / reach**2) + 1e-9
        shift = shift + weights @ (goals[nearest] - there) / weights.sum()
    return shift
