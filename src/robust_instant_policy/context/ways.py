"""Demonstrations that do different things in different scenes: what decides, and which way a new scene goes.

Two kinds of decisions are told apart. Where things are alike, one of them may be meant by its *rank*: the nearest, the
second from the left. Keypoints are then renamed, so that the first thing is the first in order, and all demonstrations
do the same again. Else the demonstrations may be *split* in two by a threshold on one measure of the scene. Either is
believed where the demonstrations then predict each other better at the key steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np

from robust_instant_policy.context.choice import Candidates, prediction_errors
from robust_instant_policy.context.things import WORLD, Located, Scene, Thing, find_things, locate
from robust_instant_policy.geometry import FloatArray

RANK_GAIN, SPLIT_GAIN = 1.0, 2.0  # sums of logarithms of the errors at key steps by which an explanation must be better
LEAST_OF_A_WAY = 2  # demonstrations
ALIKE_M = 0.008  # difference of the distances between keypoints of things that are alike
SINGLE_ERROR_M = 0.010  # where every key step is predicted better than this, all do the same
CLOSE_VOTE = 0.5  # of the distance from the threshold to the nearest demonstration

Ranks = {"distance from the robot": lambda p: np.hypot(p[..., 0], p[..., 1])}


@dataclass(frozen=True, eq=False)
class Measure:
    """One number of a scene, in ``words``; ``value`` maps a `Scene` to ``(I,)``. ``parts`` is how many things it takes."""

    words: str
    parts: int
    value: Callable[[Scene], FloatArray]


@dataclass(frozen=True, eq=False)
class Order:
    """Things alike, sorted: ``blocks`` are their keypoints, in the same order in each, ``axis`` what sorts them."""

    blocks: tuple[tuple[int, ...], ...]
    axis: int

    def __str__(self) -> str:
        by = ("x", "y", "z", "distance from the robot")[self.axis]
        return f"the {len(self.blocks)} things alike are told apart by their {by}"

    def renamed(self, keypoints: FloatArray) -> FloatArray:
        """``keypoints (I, K, 3)`` with those of the first thing in order first."""
        blocks = np.array(self.blocks)
        middle = np.median(keypoints[:, blocks], axis=2)  # (I, B, 3)
        values = np.concatenate([middle, np.linalg.norm(middle[..., :2], axis=-1, keepdims=True)], axis=-1)
        order = np.argsort(values[..., self.axis], axis=1)
        sorted_ = keypoints.copy()
        sorted_[:, blocks.ravel()] = keypoints[np.arange(len(keypoints))[:, None], blocks[order].reshape(len(order), -1)]
        return sorted_


@dataclass(frozen=True, eq=False)
class Split:
    """Two ways to act: the first where the measure is below ``threshold``. ``gap`` is the distance between the nearest
    demonstrations on both sides; ``things`` are what it measures."""

    measure: Measure
    things: tuple[Thing, ...]
    threshold: float
    gap: float

    def __str__(self) -> str:
        return f"two ways, told apart by {self.measure.words} (threshold {self.threshold:.3f})"

    def values(self, keypoints: FloatArray) -> FloatArray:
        """``(I,)``."""
        return self.measure.value(locate(self.things, keypoints))

    def decide(self, keypoints: FloatArray) -> tuple[int, float]:
        """The way for ``keypoints (K, 3)``, 0 or 1, and the vote in [0, 1]: 1 is as clear as the demonstrations are."""
        beyond = float(self.values(keypoints[None])[0]) - self.threshold
        return int(beyond >= 0), float(min(1.0, abs(beyond) / (self.gap / 2)))


def find_order(keypoints: FloatArray, hands: FloatArray) -> Order | None:
    """The order by which things alike are meant in demonstrations with ``keypoints (I, K, 3)`` and ``hands (I, T, A, 3,
    3)`` at the key steps; None where their names are as good."""
    blocks = _alike(find_things(keypoints), keypoints)
    if not blocks:
        return None
    orders = [None, *(Order(blocks, axis) for axis in (3, 1, 0, 2))]
    costs = []
    for order in orders:
        named = order.renamed(keypoints) if order else keypoints
        things = find_things(named)
        costs.append(_cost(things, locate([WORLD, *things], named), hands) + RANK_GAIN * (order is not None))
    return orders[int(np.argmin(costs))]


def find_split(things: Sequence[Thing], scene: Scene, hands: FloatArray) -> tuple[Split, np.ndarray] | None:
    """What parts demonstrations in ``scene`` with ``hands (I, T, A, 3, 3)`` at the key steps, and which side ``(I,)`` each
    is on (True: the second); None where one way explains them as well."""
    demos = len(hands)
    if demos < 2 * LEAST_OF_A_WAY:
        return None
    simple = _candidates(things, scene)
    worst = max(_errors(simple, hands[:, :, arm])[1].max() for arm in range(hands.shape[2]))
    if worst < SINGLE_ERROR_M:
        return None
    single = _cost(things, scene, hands)
    splits: dict[bytes, list[tuple[float, Split, np.ndarray]]] = {}
    for measure, own in _measures(things):
        values = measure.value(scene)
        ordered = np.sort(values)
        for low, high in zip(ordered[LEAST_OF_A_WAY - 1 :], ordered[LEAST_OF_A_WAY : demos - LEAST_OF_A_WAY + 1]):
            gap, deviation = float(high - low), float(values.std())
            if gap > 0.02 * deviation:
                side = values > (low + high) / 2
                key = (side if side[0] else ~side).tobytes()
                split = Split(measure, own, float(low + high) / 2, gap)
                splits.setdefault(key, []).append((gap / deviation / np.sqrt(measure.parts), split, side))
    best: tuple[float, Split, np.ndarray] | None = None
    for same in splits.values():
        margin, split, side = max(same, key=lambda one: one[0])
        cost = 0.0
        for part in (~side, side):
            own_scene = {thing: located.of(part) for thing, located in scene.items()}
            cost += part.mean() * _cost(things, own_scene, hands[part])
        cost += SPLIT_GAIN - min(margin, 1.0)
        if best is None or cost < best[0]:
            best = cost, split, side
    return (best[1], best[2]) if best is not None and best[0] < single else None


def _candidates(things: Sequence[Thing], scene: Scene) -> Candidates:
    return Candidates.of([thing for thing in things if thing.kind != "hinged"], scene)


def _errors(candidates: Candidates, hands: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least cost of each step ``(T,)``, and the error, metres, of that candidate."""
    errors = prediction_errors(candidates, hands)
    cost = errors.cost.reshape(len(errors.cost), -1)
    squared = errors.squared.reshape(*cost.shape, -1)
    best = cost.argmin(axis=1)
    steps = np.arange(len(cost))
    return cost[steps, best], np.sqrt(squared[steps, best].mean(axis=-1))


def _cost(things: Sequence[Thing], scene: Scene, hands: FloatArray) -> float:
    """Sum over the key steps and arms of the logarithm of the least error."""
    candidates = _candidates(things, scene)
    return float(sum(_errors(candidates, hands[:, :, arm])[0].sum() for arm in range(hands.shape[2])))


def _alike(things: Sequence[Thing], keypoints: FloatArray) -> tuple[tuple[int, ...], ...]:
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
    """The order of the ``other (N, 3)`` keypoints in which their distances are those of ``shape (N, 3)``."""
    assert shape is not None and other is not None
    distances, others = (np.linalg.norm(s[:, None] - s[None], axis=-1) for s in (shape, other))
    orders = np.array(list(permutations(range(len(shape)))))
    difference = np.abs(others[orders[:, :, None], orders[:, None, :]] - distances).max(axis=(1, 2))
    best = int(np.argmin(difference))
    return tuple(map(int, orders[best])) if difference[best] < ALIKE_M else None


def _measures(things: Sequence[Thing]) -> list[tuple[Measure, tuple[Thing, ...]]]:
    """What may decide: where things are, how they are turned, their size, and how two of them lie to each other."""
    own = [thing for thing in things if thing.kind in ("upright", "scaled")]
    points = [thing for thing in things if thing.kind == "point"]
    own += points if len(own) + len(points) <= 4 else []
    found: list[tuple[Measure, tuple[Thing, ...]]] = []

    def add(words: str, parts: tuple[Thing, ...], value: Callable[[Scene], FloatArray]) -> None:
        found.append((Measure(words, len(parts), value), parts))

    for a in own:
        for axis, name in enumerate("xyz"):
            add(f"{name} of {a}", (a,), lambda s, a=a, axis=axis: s[a].position[:, axis])
        add(f"the distance of {a} from the robot", (a,), lambda s, a=a: _far(s[a]))
        if a.turns:
            add(f"the turn of {a}", (a,), lambda s, a=a: _yaw(s[a]))
        if a.kind == "scaled":
            add(f"the size of {a}", (a,), lambda s, a=a: s[a].size)
    for a, b in combinations(own, 2):
        for axis, name in enumerate("xyz"):
            add(f"{name} of {a} minus that of {b}", (a, b),
                lambda s, a=a, b=b, axis=axis: s[a].position[:, axis] - s[b].position[:, axis])  # fmt: skip
        add(f"how much further than {b} {a} is", (a, b), lambda s, a=a, b=b: _far(s[a]) - _far(s[b]))
    for a, b in permutations(own, 2):
        if a.turns:
            for axis, name in enumerate("xy"):
                add(f"{name} of {b} in the axes of {a}", (a, b),
                    lambda s, a=a, b=b, axis=axis: _seen_from(s[a], s[b])[:, axis])  # fmt: skip
    for a, b, c in combinations(own, 3):
        add(f"the side of {c} on which {a} and {b} are", (a, b, c), lambda s, a=a, b=b, c=c: _side(s[a], s[b], s[c]))
    return found


def _far(at: Located) -> FloatArray:
    return np.linalg.norm(at.position[:, :2], axis=1)


def _yaw(at: Located) -> FloatArray:
    """Angle about the vertical, radians, of the thing's x axis."""
    return np.arctan2(at.rotation[:, 1, 0], at.rotation[:, 0, 0])


def _seen_from(at: Located, other: Located) -> FloatArray:
    return ((other.position - at.position)[:, None] @ at.rotation)[:, 0]


def _side(a: Located, b: Located, c: Located) -> FloatArray:
    """Distance of c from the line from a to b, positive on its left."""
    line, off = (b.position - a.position)[:, :2], (c.position - a.position)[:, :2]
    return (line[:, 0] * off[:, 1] - line[:, 1] * off[:, 0]) / np.linalg.norm(line, axis=1)
