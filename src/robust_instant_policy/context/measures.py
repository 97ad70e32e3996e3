"""Measures of a scene that may decide between two ways to act, and where they part the demonstrations."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations, pairwise, permutations
from operator import attrgetter

import numpy as np

from robust_instant_policy.context.things import Located, Scene, Thing, locate
from robust_instant_policy.geometry import FloatArray


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


def cuts(things: Sequence[Thing], scene: Scene) -> list[tuple[Measure, float, float]]:
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
