"""Registration of XYZRGB points by a rotation about the vertical and a translation, in three steps.

1. `vote_for_motions`: matches of descriptors vote for motions (Hough 1962), and those with the most votes go on.
2. `refine`: ICP in space and colour (Besl and McKay 1992) refines each, coarsely, then the best ones with all points.
3. `rivals`: which other motions explain the image nearly as well.

Objects stand on a table, so rotations are about the world's z axis only.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from robust_instant_policy.geometry import (
    FloatArray,
    fit_upright,
    invert_pose,
    rotations_about_vertical,
    transform_points,
)
from robust_instant_policy.perception.descriptors import Float32Array, IntArray

# Votes.
ANGLE_BINS = 24  # of a full turn
SHIFT_BIN_M = 0.015  # edge of a bin of translations
MAX_PEAKS = 4  # motions that go on to ICP
SUPPRESSED_BINS = 3  # around a peak, on each side, in which no other peak is taken
MATCHES_PER_POINT = 3
MAX_MATCHES = 400  # the most similar; more do not change the peaks
VOTE_EXPONENT = 4  # of the similarity, for a match's vote
# ICP.
COLOUR_CAP_M = 0.010  # greatest colour distance: objects of one kind have many colours,
KEPT_COLOUR_CAP_M = 0.020  # but not an object that keeps its own
RESIDUAL_M = 0.010  # at which a point counts 1/e in the fitness
OWN_REACH_M = 0.04  # image points further from the object belong to others
RESTART_ANGLES = np.deg2rad([0.0, -25.0, 25.0])  # turns of each voted motion from which ICP starts
COARSE_POINTS = 60  # of the object in coarse ICP; three times as many of the image
FINALISTS = 3  # motions that are refined with all points
MAX_BEHIND = 0.06  # by which a finalist's score is below the best one, at most
SAME_SHIFT_M, SAME_TURN_RAD = 0.005, np.deg2rad(5.0)  # between motions that ICP brings to one
# Kernel width in each iteration: with few points, with all, and of `register_translation`.
COARSE_REACH_M = (0.06, 0.04, 0.03, 0.02)
FINE_REACH_M = (0.02, 0.015, 0.015, 0.01, 0.01)
LOCAL_REACH_M = (0.03, 0.025, 0.02, 0.015, 0.015)
HIDDEN_WEIGHT = 0.5  # of a point that something hides, which counts as one without a match, beside one that is seen
MIN_WEIGHT = np.float32(1e-9)  # keeps the weights' sum above zero
# Symmetry and rivals.
SMALL_TURNS = np.deg2rad(np.arange(-20.0, 25.0, 5.0))  # that test symmetry; the middle one is 0
MAX_SYMMETRY_LOSS = 0.04  # of the fitness, by small turns, for a rotationally symmetric object
SIMILARITY_SCALE = 0.01  # of the softmax over small turns
LARGE_TURNS = np.deg2rad(np.arange(30.0, 360.0, 30.0))  # from the best motion to its rivals
SLIDES_M = 0.025 * np.array(
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]
)
RIVAL_REACH_M = (0.02, 0.015)
# Size.
BOX_TURNS = np.deg2rad(np.arange(0.0, 90.0, 3.0))  # of upright boxes, of which the smallest gives an object's axes
MIN_SHAPE_POINTS = 25  # of an object in the image; with fewer its size is not fitted
EXTENT_PERCENTILES = (2.0, 98.0)  # of the points along an axis: where an object begins and ends
MIN_EXTENT_M = 0.01  # an object that is flatter along an axis is not stretched along it
MAX_STRETCH = 1.4  # factor, and its inverse

Similarity = Callable[[FloatArray], FloatArray]
Hidden = Callable[[FloatArray], NDArray[np.bool_]]
Penalty = Callable[[FloatArray], FloatArray]


def no_penalty(motions: FloatArray) -> FloatArray:
    """Of the score of ``motions (C, 4, 4)``: none ``(C,)``."""
    return np.zeros(len(motions))


def vote_for_motions(source: FloatArray, target: FloatArray, similarities: Float32Array) -> FloatArray:
    """The motions ``(P, 4, 4)``, P at most `MAX_PEAKS`, with the most votes of descriptor matches.

    Each of ``source (N, 3)`` is matched with the `MATCHES_PER_POINT` of ``target (M, 3)``, metres, world, that have
    the largest ``similarities (N, M)``.
    """
    count = min(MATCHES_PER_POINT, len(target))
    best = np.argpartition(similarities, -count, axis=1)[:, -count:]
    # Rotations about the object's centre need the smallest range of shifts.
    centre = source.mean(axis=0)
    similarity = np.take_along_axis(similarities, best, axis=1).reshape(-1)
    voters = np.argsort(-similarity, kind="stable")[:MAX_MATCHES]
    p, q = (source - centre)[voters // count], target[best.reshape(-1)[voters]]
    weights = np.maximum(similarity[voters], 0).astype(np.float64) ** VOTE_EXPONENT
    rotations = rotations_about_vertical(np.arange(ANGLE_BINS) * 2 * np.pi / ANGLE_BINS)
    shifts = (q - p @ np.swapaxes(rotations, 1, 2))[..., :2]
    bins = np.floor((shifts - shifts.min(axis=(0, 1))) / SHIFT_BIN_M).astype(np.intp) + 1
    shape = (ANGLE_BINS, *(bins.max(axis=(0, 1)) + 2))
    at = np.ravel_multi_index((np.arange(ANGLE_BINS)[:, None], bins[..., 0], bins[..., 1]), shape)
    total = np.bincount(at.reshape(-1), np.tile(weights, ANGLE_BINS), int(np.prod(shape)))
    votes = total.astype(np.float32).reshape(shape)
    for axis in range(3):  # a motion near the border of a bin has its votes in two
        votes = votes + np.roll(votes, 1, axis) + np.roll(votes, -1, axis)
    motions: list[FloatArray] = []
    while len(motions) < MAX_PEAKS and votes.max() > 0:
        angle, x, y = np.unravel_index(int(votes.argmax()), shape)
        close = (np.abs(bins[np.arange(angle - 1, angle + 2) % ANGLE_BINS] - (x, y)) <= 1).all(axis=2).any(axis=0)
        motions.append(fit_upright(p + centre, q, weights * close))
        near_angles = np.arange(angle - SUPPRESSED_BINS, angle + SUPPRESSED_BINS + 1) % ANGLE_BINS
        near_x, near_y = (slice(max(0, at - SUPPRESSED_BINS), at + SUPPRESSED_BINS + 1) for at in (x, y))
        votes[near_angles, near_x, near_y] = 0
    return np.array(motions)


@dataclass(frozen=True, eq=False)
class Candidates:
    """``motions (C, 4, 4)``, the best first, with the ``fitness (C,)`` of their points and the ``similarity (C,)`` of
    their descriptors, both in [0, 1].
    """

    motions: FloatArray
    fitness: FloatArray
    similarity: FloatArray

    @property
    def score(self) -> FloatArray:
        """``(C,)`` in [0, 1]."""
        return (self.fitness + self.similarity) / 2


def refine(
    motions: FloatArray,
    source: Float32Array,
    target: Float32Array,
    similarity: Similarity,
    hidden: Hidden,
    cap: float,
    penalty: Penalty = no_penalty,
) -> Candidates:
    """The best candidates after ICP from ``motions (P, 4, 4)``.

    ``source (N, 6)`` and ``target (M, 6)`` are XYZRGB points; ``similarity`` is that of the descriptors under each of
    several motions, ``hidden`` tells which places ``(..., 3)`` of points something hides, ``penalty`` what else speaks
    against motions, of their score. A subset of the points selects `FINALISTS`, all points order them.
    """
    centre = source[:, :3].mean(axis=0)
    starts = np.concatenate([rotated(motion, centre, RESTART_ANGLES) for motion in motions])
    starts, fitness = icp(starts, *_coarse(source, _around(starts, source, target)), COARSE_REACH_M, hidden, cap)
    score = (fitness + similarity(starts)) / 2 - penalty(starts)
    order = np.argsort(-score, kind="stable")
    leading = _distinct(starts, centre, order[score[order] > score.max() - MAX_BEHIND])[:FINALISTS]
    refined = [
        icp(start[None], source, _near(start, source, target), FINE_REACH_M, hidden, cap) for start in starts[leading]
    ]
    finalists, fitness = (np.concatenate(parts) for parts in zip(*refined, strict=True))
    similarities = similarity(finalists)
    order = np.argsort(penalty(finalists) - (fitness + similarities) / 2, kind="stable")
    return Candidates(finalists[order], fitness[order], similarities[order])


def settle_turn(
    motion: FloatArray, source: Float32Array, target: Float32Array, similarity: Similarity, hidden: Hidden, cap: float
) -> FloatArray:
    """``motion (4, 4)``, turned to the descriptors' mean rotation if points do not determine it, as for a disc."""
    centre = source[:, :3].mean(axis=0)
    alternatives = rotated(motion, centre, SMALL_TURNS)
    target = _around(motion[None], source, target)
    fitness = icp(alternatives, *_coarse(source, target), (), hidden, cap)[1]
    if fitness.min() <= fitness[len(alternatives) // 2] - MAX_SYMMETRY_LOSS:
        return motion
    likelihood = similarity(alternatives)
    share = np.exp((likelihood - likelihood.max()) / SIMILARITY_SCALE)
    return rotated(motion, centre, np.atleast_1d(share @ SMALL_TURNS / share.sum()))[0]


def find_rivals(
    motions: FloatArray, source: Float32Array, target: Float32Array, similarity: Similarity, hidden: Hidden, cap: float
) -> Candidates:
    """``motions (C, 4, 4)``, the best first, and that one turned by `LARGE_TURNS` or slid by `SLIDES_M`, all measured
    with a subset of the points.
    """
    turned = rotated(motions[0], source[:, :3].mean(axis=0), LARGE_TURNS)
    slid = np.repeat(motions[:1], len(SLIDES_M), axis=0)
    slid[:, :3, 3] += SLIDES_M
    coarse = _coarse(source, _around(motions, source, target))
    turned = icp(turned, *coarse, RIVAL_REACH_M, hidden, cap)[0]
    every = np.concatenate([motions, turned, slid])
    return Candidates(every, icp(every, *coarse, (), hidden, cap)[1], similarity(every))


def refine_pose(
    motion: FloatArray, source: Float32Array, target: Float32Array, similarity: Similarity, hidden: Hidden, cap: float
) -> tuple[FloatArray, float, float]:
    """``motion (4, 4)`` after ICP with all points, with its fitness and similarity."""
    refined, fitness = icp(motion[None], source, _near(motion, source, target), FINE_REACH_M, hidden, cap)
    return refined[0], float(fitness[0]), float(similarity(refined)[0])


def fit_shape(motion: FloatArray, source: FloatArray, axes: FloatArray, goals: FloatArray) -> FloatArray:
    """How an object of the same kind differs in size: an affine map ``(4, 4)`` of its own frame, before ``motion``.

    It stretches ``source (N, 3)`` along its ``axes (3, 3)`` (`horizontal_axes`), and lifts it, to the extent of the
    image's points of it, ``goals (M, 3)``.
    """
    goals = transform_points(invert_pose(motion), goals)
    shape = np.eye(4)
    if len(goals) < MIN_SHAPE_POINTS:
        return shape
    lower, upper = np.percentile(source @ axes.T, EXTENT_PERCENTILES, axis=0)
    new_lower, new_upper = np.percentile(goals @ axes.T, EXTENT_PERCENTILES, axis=0)
    scale = (new_upper - new_lower) / np.maximum(upper - lower, MIN_EXTENT_M)
    scale = np.where(upper - lower < MIN_EXTENT_M, 1, scale.clip(1 / MAX_STRETCH, MAX_STRETCH))
    # How far down its sides are seen depends on the view: upward, only the top moves.
    scale[2], lower[2], new_lower[2] = 1, upper[2], new_upper[2]
    shape[:3, :3] = axes.T @ np.diag(scale) @ axes
    shape[:3, 3] = axes.T @ ((new_lower + new_upper) / 2 - scale * (lower + upper) / 2)
    return shape


def horizontal_axes(points: FloatArray) -> FloatArray:
    """Rows ``(3, 3)``: the sides of the smallest upright box around ``points (N, 3)``."""
    turns = rotations_about_vertical(BOX_TURNS)
    extent = np.diff(np.percentile(points @ np.swapaxes(turns, 1, 2), EXTENT_PERCENTILES, axis=1), axis=0)[0]
    return turns[(extent[:, 0] * extent[:, 1]).argmin()]


def _around(motions: FloatArray, source: Float32Array, target: Float32Array) -> Float32Array:
    """Those of ``target (M, 6)`` that ``source (N, 6)`` may reach from ``motions (C, 4, 4)``; at least one."""
    centre = source[:, :3].mean(axis=0)
    reach = np.linalg.norm(source[:, :3] - centre, axis=1).max() + max(COARSE_REACH_M)
    places = motions[:, :3, :3] @ centre + motions[:, :3, 3]
    near = (cdist(target[:, :3], places, "sqeuclidean") < reach**2).any(axis=1)
    return target[near] if near.any() else target[:1]


def _distinct(motions: FloatArray, centre: FloatArray, order: IntArray) -> list[int]:
    """Those numbers in ``order`` of ``motions (C, 4, 4)`` of a thing at ``centre (3,)`` that differ from all before."""
    kept: list[int] = []
    places = motions[:, :3, :3] @ centre + motions[:, :3, 3]
    for i in order:
        shifts = np.linalg.norm(places[kept] - places[i], axis=1)
        turns = np.linalg.norm(motions[kept, :3, :3] - motions[i, :3, :3], axis=(1, 2)) / np.sqrt(2)
        if not ((shifts < SAME_SHIFT_M) & (turns < SAME_TURN_RAD)).any():
            kept.append(int(i))
    return kept


def _near(motion: FloatArray, source: Float32Array, target: Float32Array) -> Float32Array:
    """Those of ``target (M, 6)`` in the box that ``source (N, 6)`` may reach at ``motion (4, 4)``; at least one."""
    places, reach = transform_points(motion, source[:, :3]), max(COARSE_REACH_M)
    near = ((target[:, :3] > places.min(axis=0) - reach) & (target[:, :3] < places.max(axis=0) + reach)).all(axis=1)
    return target[near] if near.any() else target[:1]


def within(points: ArrayLike, others: FloatArray, distance: float) -> NDArray[np.bool_]:
    """Which of ``points (N, 3)`` are nearer than ``distance`` to one of ``others (M, 3)``."""
    points = np.asarray(points, dtype=np.float64)
    near = ((points > others.min(axis=0) - distance) & (points < others.max(axis=0) + distance)).all(axis=1)
    tree = cKDTree(others, balanced_tree=False, compact_nodes=False)  # quicker to build, and used once
    near[near] = tree.query(points[near], distance_upper_bound=distance)[0] < distance
    return near


def _coarse(source: Float32Array, target: Float32Array) -> tuple[Float32Array, Float32Array]:
    """A subset of both."""
    return source[:: max(1, len(source) // COARSE_POINTS)], target[:: max(1, len(target) // (3 * COARSE_POINTS))]


def rotated(motion: FloatArray, centre: FloatArray, angles: FloatArray) -> FloatArray:
    """``motion (4, 4)`` with additional rotations by ``angles (A,)`` radians about ``centre (3,)``: ``(A, 4, 4)``."""
    result = np.repeat(motion[None], len(angles), axis=0)
    result[:, :3, :3] = rotations_about_vertical(angles) @ motion[:3, :3]
    result[:, :3, 3] += (motion[:3, :3] - result[:, :3, :3]) @ centre
    return result


def icp(
    motions: FloatArray,
    source: Float32Array,
    target: Float32Array,
    reaches: tuple[float, ...],
    hidden: Hidden,
    cap: float,
) -> tuple[FloatArray, FloatArray]:
    """``motions (C, 4, 4)`` after one ICP iteration for each of ``reaches`` (kernel widths, metres), and their fitness.

    Matches go both ways: an object shifted along itself still covers most of its image points, and only those left
    uncovered show the error. The fitness in [0, 1] is the geometric mean of both ways. Points that are ``hidden`` count
    less. ``cap``: greatest distance in colour, metres as in `View.xyzrgb`.
    """
    source_xyz, target_xyz = (points[:, :3].astype(np.float64) for points in (source, target))
    colours = colour_costs(source, target, cap)
    origin = target_xyz.mean(axis=0)  # near the points, for the precision of the squares
    goals = target_xyz - origin
    quadratic = np.stack([*(-2 * goals.T), (goals**2).sum(axis=1), np.ones(len(goals))]).astype(np.float32)
    costs = np.empty((len(motions), len(source), len(target)), dtype=np.float32)  # reused: allocation is slow
    numbered = np.empty(costs.shape, dtype=np.int32)
    last_bits = (1 << (len(source) - 1).bit_length()) - 1
    cost_bits = 0x7FFFFFFF & ~last_bits  # without the sign: by rounding, a cost may be below zero
    numbers = np.arange(len(source), dtype=np.int32)[:, None]

    def match(motions: FloatArray) -> tuple[IntArray, IntArray, Float32Array, Float32Array, NDArray[np.bool_]]:
        """Nearest targets of the sources, nearest sources of the targets, both squared distances, and which targets
        are near enough to belong to the object.
        """
        moved = source_xyz @ np.swapaxes(motions[:, :3, :3], 1, 2) + (motions[:, None, :3, 3] - origin)
        squares = np.einsum("cnx,cnx->cn", moved, moved)[..., None]
        terms = np.concatenate([moved, np.ones_like(squares), squares], axis=2).astype(np.float32)
        np.matmul(terms, quadratic, out=costs)
        np.add(costs, colours, out=costs)
        targets = costs.argmin(axis=2)
        to_target = np.take_along_axis(costs, targets[..., None], axis=2)[..., 0]
        # Along this axis min is several times faster than argmin, so the last bits of a cost are the source's number.
        np.bitwise_and(costs.view(np.int32), cost_bits, out=numbered)
        np.bitwise_or(numbered, numbers, out=numbered)
        least = numbered.min(axis=1)
        to_source = (least & cost_bits).view(np.float32)
        return targets, least & last_bits, to_target, to_source, to_source < OWN_REACH_M**2

    every_source, every_target = (
        np.broadcast_to(points, (len(motions), *points.shape)) for points in (source_xyz, target_xyz)
    )
    for reach in reaches:
        targets, sources, to_target, to_source, own = match(motions)
        weights = np.concatenate([np.exp(-to_target / reach**2), own * np.exp(-to_source / reach**2)], axis=1)
        motions = fit_upright(
            np.concatenate([every_source, source_xyz[sources]], axis=1),
            np.concatenate([target_xyz[targets], every_target], axis=1),
            weights + MIN_WEIGHT,
        )
    _, _, to_target, to_source, own = match(motions)
    covered = (own * np.exp(-to_source / RESIDUAL_M**2)).sum(axis=1) / np.maximum(own.sum(axis=1), 1)
    seen = ~hidden(source_xyz @ np.swapaxes(motions[:, :3, :3], 1, 2) + motions[:, None, :3, 3])
    matched = (seen * np.exp(-to_target / RESIDUAL_M**2)).sum(axis=1) / np.where(seen, 1, HIDDEN_WEIGHT).sum(axis=1)
    return motions, np.sqrt(matched * covered)


def colour_costs(source: Float32Array, target: Float32Array, cap: float) -> Float32Array:
    """Squared colour distances ``(N, M)`` of ``source (N, 6)`` and ``target (M, 6)``, at most ``cap``, in metres."""
    a, b = source[:, 3:], target[:, 3:]
    squares = a @ (-2 * b.T) + (b**2).sum(axis=1) + (a**2).sum(axis=1)[:, None]
    return np.minimum(squares, np.float32(cap**2))


def register_translation(pose: FloatArray, source: Float32Array, target: Float32Array) -> FloatArray:
    """Translation ``(3,)`` by ICP of ``source (N, 6)``, at ``pose``, onto the image's ``target (M, 6)``.

    One way and without rotation: along an even surface it is not determined and stays zero, while edges, handles and
    tips of an object of another size are followed.
    """
    start = transform_points(pose, source[:, :3])
    goals = target[:, :3].astype(np.float64)
    constant = colour_costs(source, target, COLOUR_CAP_M) + (goals**2).sum(axis=1)
    shift = np.zeros(3)
    for reach in LOCAL_REACH_M:
        moved = start + shift
        costs = constant - 2 * moved @ goals.T + (moved**2).sum(axis=1)[:, None]
        nearest = costs.argmin(axis=1)
        weights = np.exp(-costs.min(axis=1) / reach**2) + 1e-9
        shift = shift + weights @ (goals[nearest] - moved) / weights.sum()
    return shift
