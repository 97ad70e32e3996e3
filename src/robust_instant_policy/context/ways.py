"""Demonstrations that do different things in different scenes: what decides, and which way a new scene goes.

Two kinds of decisions are told apart. Where things are alike, one of them may be meant by its *rank*: the nearest, the
second from the left. Keypoints are then renamed, so that the first thing is the first in order, and all demonstrations
do the same again. Else the demonstrations may be *split* in two by a threshold on one measure of the scene. Either is
believed where the demonstrations then predict each other better at the key steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations, pairwise, permutations
from operator import attrgetter

import numpy as np

from robust_instant_policy.context.choice import NOISE_M, UNEXPLAINED_M, Candidates, prediction_errors
from robust_instant_policy.context.things import MAX_THINGS, WORLD, Located, Scene, Thing, find_things, locate
from robust_instant_policy.geometry import FloatArray, fit_upright, transform_points

RANK_GAIN, SPLIT_GAIN = 1.0, 1.0  # sums of logarithms of the errors at key steps by which an explanation must be better
MAX_SPLITS = 40  # ways to part the demonstrations that are tried, those with the widest gaps
LEAST_OF_A_WAY = 2  # demonstrations
FEW_OF_A_WAY = 4  # demonstrations up to which a way may have to share the frames of the other
ALIKE_M = 0.006  # largest difference of the shapes of things that are alike


@dataclass(frozen=True, eq=False)
class Measure:
    """One number of a scene, in ``words``: a function of where some ``things`` are, to ``(I,)``."""

    words: str
    things: tuple[Thing, ...]
    function: Callable[..., FloatArray]

    @property
    def members(self) -> set[tuple[int, ...]]:
        """The keypoints of each thing."""
        return {thing.members for thing in self.things}

    def value(self, scene: Scene) -> FloatArray:
        return self.function(*(scene[thing] for thing in self.things))

    def value_at(self, keypoints: FloatArray) -> float:
        """In the scene of ``keypoints (K, 3)``."""
        return float(self.value(locate(self.things, keypoints[None]))[0])


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
        """The least difference of two things in a scene, in standard deviations of what sorts them."""
        values = np.sort(self.values(keypoints), axis=1)
        return float(np.diff(values, axis=1).min() / values.std())


@dataclass(frozen=True, eq=False)
class Split:
    """Two ways to act: the first where the ``measure`` is below ``threshold``. ``gap`` is the distance between the
    nearest demonstrations on both sides."""

    measure: Measure
    threshold: float
    gap: float

    def __str__(self) -> str:
        return f"two ways, told apart by {self.measure.words} (threshold {self.threshold:.3f})"

    def decide(self, keypoints: FloatArray) -> tuple[int, float]:
        """The way for ``keypoints (K, 3)``, 0 or 1, and the vote in [0, 1]: 1 is as clear as the demonstrations are."""
        beyond = self.measure.value_at(keypoints) - self.threshold
        return int(beyond >= 0), float(min(1.0, abs(beyond) / (self.gap / 2)))


def find_ranking(keypoints: FloatArray, hands: FloatArray) -> Ranking | None:
    """The order by which things alike are meant in demonstrations with ``keypoints (I, K, 3)`` and ``hands (I, T, A, 3,
    3)`` at the key steps; None where their names are as good."""
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
        cost = _cost(_squared(things, locate([WORLD, *things], named), hands)) - min(ranking.margin(keypoints), 1.0)
        cost += RANK_GAIN * bool(ranking.origin)  # what decides is rather one thing's place than a relation of two
        if cost < least:
            best, least = ranking, cost
    return best


def find_split(things: Sequence[Thing], scene: Scene, hands: FloatArray) -> tuple[Split, np.ndarray, bool] | None:
    """What parts demonstrations in ``scene`` with ``hands (I, T, A, 3, 3)`` at the key steps, which side ``(I,)`` each
    is on (True: the second), and whether both sides share their frames; None where one way explains them as well.

    A side of few demonstrations may share the frames of the other and differ by an offset and a turn in them.

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
    splits: dict[bytes, list[tuple[Split, np.ndarray, float]]] = {}
    for measure, threshold, gap in _cuts(things, scene):
        values = measure.value(scene)
        side, deviation = values > threshold, float(values.std())
        enough = LEAST_OF_A_WAY <= side.sum() <= demos - LEAST_OF_A_WAY
        if enough and min(gap, deviation / 4) > NOISE_M:
            key = (side if side[0] else ~side).tobytes()
            splits.setdefault(key, []).append((Split(measure, threshold, gap), side, gap / deviation))
    best: tuple[float, Split, np.ndarray, bool] | None = None
    by_gap = sorted(splits.values(), key=lambda same: -max(gap for _, _, gap in same))
    for same in by_gap[:MAX_SPLITS]:
        side = same[0][1]
        few = min(side.sum(), demos - side.sum()) <= FEW_OF_A_WAY
        for shared in (False, True) if few else (False,):
            squared, used = _parted(things, scene, hands, side, shared, int(arm), int(step))
            if squared.max() >= single.max() / 4:
                continue
            margins = [gap / np.sqrt(1 + len(split.measure.members ^ used)) for split, _, gap in same]
            widest = int(np.argmax(margins))
            cost = _cost(squared) - min(margins[widest], 1.0)
            if best is None or cost < best[0]:
                best = cost, *same[widest][:2], shared
    if best is None or best[0] + SPLIT_GAIN >= one_way or _one_differs(things, scene, hands):
        return None
    return best[1:]


def _one_differs(things: Sequence[Thing], scene: Scene, hands: FloatArray) -> bool:
    """Whether one way explains all demonstrations but a single one, which is then taken for an error, not for a way."""
    every = np.arange(len(hands))
    rests = (every[every != demo] for demo in every)
    return any(
        _squared(things, {thing: at.of(rest) for thing, at in scene.items()}, hands[rest]).max() < UNEXPLAINED_M**2
        for rest in rests
    )


def _parted(
    things: Sequence[Thing], scene: Scene, hands: FloatArray, side: np.ndarray, shared: bool, arm: int, step: int
) -> tuple[FloatArray, set[tuple[int, ...]]]:
    """Mean squared errors ``(A, T)``, square metres, where demonstrations on either ``side`` are predicted from those
    of the same alone, in frames of their own or ``shared`` ones; and the things to which an arm moves at a step."""
    if shared:
        candidates, errors = _errors(things, scene, hands, second=side)
        return _least(errors), {candidates.nearest(errors[arm][step])}
    squared, used = np.zeros((hands.shape[2], hands.shape[1])), set[tuple[int, ...]]()
    for part in (~side, side):
        own = {thing: located.of(part) for thing, located in scene.items()}
        candidates, errors = _errors(things, own, hands[part])
        squared += part.mean() * _least(errors)
        used.add(candidates.nearest(errors[arm][step]))
    return squared, used


def _squared(things: Sequence[Thing], scene: Scene, hands: FloatArray) -> FloatArray:
    """Mean squared error ``(A, T)``, square metres, of a demonstration predicted from the others in the best frames."""
    return _least(_errors(things, scene, hands)[1])


def _errors(
    things: Sequence[Thing],
    scene: Scene,
    hands: FloatArray,
    more_origins: bool = False,
    second: np.ndarray | None = None,
) -> tuple[Candidates, list[FloatArray]]:
    """The candidates, and their mean squared errors ``(T, M, N)`` for each arm."""
    candidates = Candidates.of(things, scene)
    if more_origins:
        candidates = candidates.with_more_origins(things)
    arms = [hands[:, :, arm] for arm in range(hands.shape[2])]
    return candidates, [prediction_errors(candidates, own, second).mean_squared for own in arms]


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


def _cuts(things: Sequence[Thing], scene: Scene) -> list[tuple[Measure, float, float]]:
    """All measures, each with a threshold between two neighbouring demonstrations in ``scene`` and their distance.

    An angle has no first and last value: it is cut by a line, on one side of which it lies or on the other.
    """
    numbers, angles = _measures(things)
    found = []
    for measure in numbers:
        ordered = np.sort(measure.value(scene))
        found += [(measure, float(low + high) / 2, float(high - low)) for low, high in pairwise(ordered)]
    for measure in angles:
        ordered = np.sort(measure.value(scene) % np.pi)
        for low, high in pairwise([*ordered, ordered[0] + np.pi]):
            line = float(low + high) / 2
            words = f"the side of {np.degrees(line) % 180:.0f}° on which {measure.words} lies"
            beyond = Measure(words, measure.things, partial(_beyond, measure.function, line))
            found.append((beyond, 0.0, float(high - low)))
    return found


def _measures(things: Sequence[Thing]) -> tuple[list[Measure], list[Measure]]:
    """What may decide, numbers and angles in radians: where things are, how they are turned, their size and hand, and
    how two or three lie to each other."""
    own = [thing for thing in things if thing.kind in ("upright", "scaled")]
    taken = {member for thing in own for member in thing.members}
    points = [thing for thing in things if thing.kind == "point" and taken.isdisjoint(thing.members)]
    own += points if len(own) + len(points) <= 4 else []
    numbers: list[Measure] = []
    for a in own:
        numbers += [Measure(f"{name} of {a}", (a,), place) for name, place in _PLACES.items()]
        if a.kind == "scaled":
            numbers.append(Measure(f"the size of {a}", (a,), attrgetter("size")))
        if a.mirrors:
            numbers.append(Measure(f"which hand {a} is", (a,), attrgetter("hand")))
    for a, b in combinations(own, 2):
        if a.turns and b.turns:
            numbers.append(Measure(f"the size of {a} minus that of {b}", (a, b), partial(_larger, a.extent, b.extent)))
        numbers += [
            Measure(f"{name} of {a} minus that of {b}", (a, b), partial(_difference, place))
            for name, place in _PLACES.items()
        ]
    for parts in combinations(own, 3):
        words = "the side of the line from {} to {} on which {} is".format(*parts)
        numbers.append(Measure(words, parts, _side))
    turning = [thing for thing in own if thing.turns]
    angles = [Measure(f"the turn of {a}", (a,), _yaw) for a in turning]
    angles += [
        Measure(f"the direction from {a} to {b} in its axes", (a, b), _bearing)
        for a, b in permutations(own, 2)
        if a.turns
    ]
    return numbers, angles


def _difference(place: Callable[[Located], FloatArray], at: Located, other: Located) -> FloatArray:
    return place(at) - place(other)


def _larger(extent: float, of_other: float, at: Located, other: Located) -> FloatArray:
    """Metres."""
    return extent * at.size - of_other * other.size


def _far(at: Located) -> FloatArray:
    return np.linalg.norm(at.position[:, :2], axis=1)


def _yaw(at: Located) -> FloatArray:
    """Angle about the vertical, radians, of the thing's x axis."""
    return np.arctan2(at.rotation[:, 1, 0], at.rotation[:, 0, 0])


def _bearing(at: Located, other: Located) -> FloatArray:
    """Angle about the vertical, radians, of the direction to the other in the thing's axes."""
    away = ((other.position - at.position)[:, None] @ at.rotation)[:, 0]
    return np.arctan2(away[:, 1], away[:, 0])


def _beyond(angle: Callable[..., FloatArray], line: float, *at: Located) -> FloatArray:
    """How far, radians, a line through the angle ``line`` is from the angle, positive on its left."""
    return np.arcsin(np.sin(angle(*at) - line))


def _side(a: Located, b: Located, c: Located) -> FloatArray:
    """Distance of c from the line from a to b, positive on its left."""
    line, off = (b.position - a.position)[:, :2], (c.position - a.position)[:, :2]
    return (line[:, 0] * off[:, 1] - line[:, 1] * off[:, 0]) / np.linalg.norm(line, axis=1)


_PLACES: dict[str, Callable[[Located], FloatArray]] = {
    "x": lambda at: at.position[:, 0],
    "y": lambda at: at.position[:, 1],
    "z": lambda at: at.position[:, 2],
    "the distance from the robot": _far,
}
