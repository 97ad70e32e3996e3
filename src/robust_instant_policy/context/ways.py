"""Demonstrations that do different things in different scenes: what decides, and which way applies in a new scene.

There are two kinds of decisions. Of several things of the same shape, demonstrations may use one by its *rank*: the
nearest, the second from the left. The keypoints are then renamed in this order, so that all demonstrations do the same.
Else a threshold on one measure of the scene may *split* the demonstrations in two. Either is accepted where the
demonstrations then predict each other better at the key steps.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.context.candidates import NOISE_M, Candidates
from robust_instant_policy.context.choice import UNEXPLAINED_M
from robust_instant_policy.context.discovery import MAX_THINGS, find_things
from robust_instant_policy.context.measures import Measure, cuts
from robust_instant_policy.context.prediction import ShownHands, prediction_errors
from robust_instant_policy.context.things import WORLD, Scene, Thing, locate
from robust_instant_policy.geometry import FloatArray, fit_upright, transform_points

RANK_GAIN, SPLIT_GAIN = 1.0, 1.0  # sums of logarithms of the errors at key steps by which an explanation must be better
LARGEST_MARGIN = 1.0  # standard deviations by which what decides may differ; more counts no more
MAX_SPLITS = 40  # ways to part the demonstrations that are tried, those with the widest gaps; more take too long
LEAST_OF_A_WAY = 2  # demonstrations
FEW_OF_A_WAY = 4  # demonstrations up to which a way may have to share the frames of the other
ALIKE_M = 0.006  # largest difference of the shapes of things that are alike


@dataclass(frozen=True, eq=False)
class Ranking:
    """Things alike, sorted by the coordinate ``axis`` (x, y, z), or else by the distance from the keypoints ``origin``,
    which is the robot where there are none. ``blocks`` are the keypoints of each, in corresponding order."""

    blocks: tuple[tuple[int, ...], ...]
    axis: int | None = None
    origin: tuple[int, ...] = ()

    def __str__(self) -> str:
        by = f"distance from {Thing('point', self.origin) if self.origin else 'the robot'}"
        if self.axis is not None:
            by = "xyz"[self.axis]
        return f"the {len(self.blocks)} things alike are told apart by their {by}"

    def values(self, keypoints: FloatArray) -> FloatArray:
        """What sorts the B things in the scenes of ``keypoints (I, K, 3)``: ``(I, B)``."""
        middle = np.median(keypoints[:, np.array(self.blocks)], axis=2)  # (I, B, 3)
        if self.axis is not None:
            return middle[..., self.axis]
        if self.origin:
            middle = middle - np.median(keypoints[:, list(self.origin)], axis=1)[:, None]
        return np.linalg.norm(middle[..., :2], axis=-1)

    def renamed(self, keypoints: FloatArray) -> FloatArray:
        """``keypoints (I, K, 3)`` with those of the first thing in order first."""
        blocks = np.array(self.blocks)
        order = np.argsort(self.values(keypoints), axis=1)
        renamed = keypoints.copy()
        renamed[:, blocks.ravel()] = keypoints[
            np.arange(len(keypoints))[:, None], blocks[order].reshape(len(order), -1)
        ]
        return renamed

    def margin(self, keypoints: FloatArray) -> float:
        """The least difference of two things in a scene, in standard deviations of what sorts them; or -inf."""
        values = np.sort(self.values(keypoints), axis=1)
        least, deviation = np.diff(values, axis=1).min(), values.std()
        return float(least / deviation) if deviation else -np.inf  # nothing differs


@dataclass(frozen=True, eq=False)
class Split:
    """Two ways to act: the first where the ``measure`` is below ``threshold``. ``gap`` is the distance between the
    nearest demonstrations on both sides, ``second (I,)`` are those that go the second way. Where the ways are ``alike``
    they share their frames, and the second differs by an offset and a turn in them."""

    measure: Measure
    threshold: float
    gap: float
    second: NDArray[np.bool_]
    alike: bool = False

    def __str__(self) -> str:
        return f"two ways, told apart by {self.measure.words} (threshold {self.threshold:.3f})"

    def decide(self, keypoints: FloatArray) -> tuple[int, float]:
        """The way for ``keypoints (K, 3)``, 0 or 1, and the vote in [0, 1]: 1 is as clear as the demonstrations are."""
        beyond = self.measure.value_at(keypoints) - self.threshold
        return int(beyond >= 0), float(min(1.0, abs(beyond) / (self.gap / 2)))


def find_ranking(keypoints: FloatArray, hands: FloatArray) -> Ranking | None:
    """The order by which demonstrations with ``keypoints (I, K, 3)`` choose among things of the same shape, from their
    ``hands (I, T, A, 3, 3)`` at the key steps; None where the names of the things are as good."""
    things = find_things(keypoints, hinges=False)
    blocks = _alike(things)
    if not blocks:
        return None
    ranked = {member for block in blocks for member in block}
    others = [
        thing.members for thing in things if thing.kind in ("upright", "point") and ranked.isdisjoint(thing.members)
    ]
    rankings = [Ranking(blocks), *(Ranking(blocks, axis) for axis in range(3))]
    rankings += [Ranking(blocks, origin=members) for members in others[:MAX_THINGS]]
    best, least = None, _cost(_squared(things, locate([WORLD, *things], keypoints), hands)) - RANK_GAIN
    for ranking in rankings:
        named = ranking.renamed(keypoints)
        cost = _cost(_squared(things, locate([WORLD, *things], named), hands))
        cost -= min(ranking.margin(keypoints), LARGEST_MARGIN)
        cost += RANK_GAIN * bool(ranking.origin)  # what decides is rather one thing's place than a relation of two
        if cost < least:
            best, least = ranking, cost
    return best


def find_split(things: Sequence[Thing], scene: Scene, hands: FloatArray) -> Split | None:
    """What parts demonstrations in ``scene`` with ``hands (I, T, A, 3, 3)`` at the key steps; None where one way
    explains them as well. A way of few demonstrations may be alike the other.

    Of several measures that part them alike, the one with the widest gap decides. Measures of other things than those
    to which the hand moves, at the step that one way explains worst, need a wider one.
    """
    demos = len(hands)
    single = _squared(things, scene, hands)
    if demos < 2 * LEAST_OF_A_WAY or single.max() < UNEXPLAINED_M**2:
        return None
    best_single = np.minimum(single, _least(_errors(things, scene, hands, more_origins=True)[1]))
    if best_single.max() < UNEXPLAINED_M**2:
        return None
    one_way = _cost(best_single)
    arm, step = np.unravel_index(int(single.argmax()), single.shape)
    splits: dict[bytes, list[tuple[Split, float]]] = {}
    for measure, threshold, gap in cuts(things, scene):
        values = measure.value(scene)
        second, deviation = values > threshold, float(values.std())
        enough = LEAST_OF_A_WAY <= second.sum() <= demos - LEAST_OF_A_WAY
        if enough and min(gap, deviation / 4) > NOISE_M:
            key = (second if second[0] else ~second).tobytes()
            splits.setdefault(key, []).append((Split(measure, threshold, gap, second), gap / deviation))
    best, least = None, one_way - SPLIT_GAIN
    by_gap = sorted(splits.values(), key=lambda same: -max(gap for _, gap in same))
    for same in by_gap[:MAX_SPLITS]:
        second = same[0][0].second
        few = min(second.sum(), demos - second.sum()) <= FEW_OF_A_WAY
        for alike in (False, True) if few else (False,):
            used = set[tuple[int, ...]]()  # the things to which the arm moves, where one way explains it worst
            for squared, candidates, errors in _parted(things, scene, hands, second, alike):
                if squared.max() >= single.max() / 4 or _cost(squared) - LARGEST_MARGIN >= least:
                    break
                used.add(candidates.nearest(errors[arm][step]))
            else:
                margins = [gap / np.sqrt(1 + len(split.measure.members ^ used)) for split, gap in same]
                widest = int(np.argmax(margins))
                cost = _cost(squared) - min(margins[widest], LARGEST_MARGIN)
                if cost < least:
                    best, least = replace(same[widest][0], alike=alike), cost
    return None if best is None or _one_differs(things, scene, hands) else best


def _one_differs(things: Sequence[Thing], scene: Scene, hands: FloatArray) -> bool:
    """Whether one way explains all demonstrations but a single one, which is then taken for an error, not for a way."""
    every = np.arange(len(hands))
    rests = (every[every != demo] for demo in every)
    return any(
        _squared(things, {thing: at.of(rest) for thing, at in scene.items()}, hands[rest]).max() < UNEXPLAINED_M**2
        for rest in rests
    )


def _parted(
    things: Sequence[Thing], scene: Scene, hands: FloatArray, second: NDArray[np.bool_], alike: bool
) -> Iterator[tuple[FloatArray, Candidates, list[FloatArray]]]:
    """Mean squared errors ``(A, T)``, square metres, where demonstrations of either way are predicted from those of the
    same alone, in frames of their own or shared ones (``alike``); with the candidates and their errors.

    First of one way alone, then of both: errors only grow, so that the second way is evaluated on demand.
    """
    if alike:
        candidates, errors = _errors(things, scene, hands, second=second)
        yield _least(errors), candidates, errors
        return
    squared = np.zeros((hands.shape[2], hands.shape[1]))
    for part in (~second, second):
        own = {thing: located.of(part) for thing, located in scene.items()}
        candidates, errors = _errors(things, own, hands[part])
        squared = squared + part.mean() * _least(errors)
        yield squared, candidates, errors


def _squared(things: Sequence[Thing], scene: Scene, hands: FloatArray) -> FloatArray:
    """Mean squared error ``(A, T)``, square metres, of a demonstration predicted from the others in the best frames."""
    return _least(_errors(things, scene, hands)[1])


def _errors(
    things: Sequence[Thing],
    scene: Scene,
    hands: FloatArray,
    more_origins: bool = False,
    second: NDArray[np.bool_] | None = None,
) -> tuple[Candidates, list[FloatArray]]:
    """The candidates, and their mean squared errors ``(T, M, N)`` for each arm."""
    candidates = Candidates.of(things, scene)
    if more_origins:
        candidates = candidates.with_more_origins(things)
    arms = (ShownHands(hands[:, :, arm], second) for arm in range(hands.shape[2]))
    return candidates, [prediction_errors(candidates, own).mean_squared for own in arms]


def _least(errors: Sequence[FloatArray]) -> FloatArray:
    return np.stack([own.min(axis=(1, 2)) for own in errors])


def _cost(squared: FloatArray) -> float:
    return 0.5 * float(np.log(squared + NOISE_M**2).sum())


def _alike(things: Sequence[Thing]) -> tuple[tuple[int, ...], ...]:
    """The most things of the same shape, keypoints in corresponding order; none where fewer than two are alike."""
    solid = [thing for thing in things if thing.kind == "upright" and thing.shape is not None]
    best: tuple[tuple[int, ...], ...] = ()
    for first in solid:
        blocks = [first.members]
        for other in solid:
            if other is not first and len(other.members) == len(first.members) <= 6:
                match = _matched(first.shape, other.shape)
                if match is not None:
                    blocks.append(tuple(other.members[index] for index in match))
        if len(blocks) > max(len(best), 1):
            best = tuple(blocks)
    return best


def _matched(shape: FloatArray | None, other: FloatArray | None) -> tuple[int, ...] | None:
    """The order of the ``other (N, 3)`` keypoints in which they have the ``shape (N, 3)``."""
    assert shape is not None
    assert other is not None
    orders = np.array(list(permutations(range(len(shape)))))
    moved = other[orders]  # (orders, N, 3)
    poses = fit_upright(moved, np.broadcast_to(shape, moved.shape), np.ones(moved.shape[:2]))
    difference = np.linalg.norm(transform_points(poses, moved) - shape, axis=-1).max(axis=1)
    best = int(np.argmin(difference))
    return tuple(map(int, orders[best])) if difference[best] < ALIKE_M else None
