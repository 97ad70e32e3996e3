"""Candidate frames, each as a linear model of where the hand is.

A candidate is a choice of axes R and of the one to three things on which the origin depends. In a scene, the hand's
centre is

    y = o + X w,   X = [o' - o … | B | B' … | R | (s - 1) R …]

with o, o' the things' positions, B, B' their axes, and s the sizes of things that have one: share of the way, points
fixed in the things, offset in the axes and its growth are all linear. Where the way counts along each axis, o' - o is
its three parts along R, and points in the things count along each axis by the share of the way that a first fit found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.context.frames import Anchor, Axes
from robust_instant_policy.context.things import DEMOS_TO_TELL_THINGS, WORLD, Scene, Thing
from robust_instant_policy.geometry import FloatArray

NOISE_M = 0.003  # of demonstrated points in a frame that suits them
# Standard deviations a priori of what is fitted: share of the way; a point in a thing, an offset, its growth in metres.
SHARE_STD, POINT_STD_M, OFFSET_STD_M, GROWTH_STD_M = 0.7, 0.02, 0.5, 0.1
MAX_LOOSE = 4  # keypoints of their own between which lines are drawn; with more, the choice takes too long
# Where the numbers w stand: shares, three for each further end; points in the ends; offset; its growth with each size.
SHARES, POINTS, OFFSET, GROWTH = slice(0, 6), slice(6, 15), slice(15, 18), slice(18, None)

ZERO = np.zeros(3)


@dataclass(frozen=True, eq=False)
class Origin:
    """Which things an origin depends on.

    It lies at a point of one of the ``ends``, or on the way between two or three of them, and moves with the size of
    the things in ``growing``. With ``by_axis`` its share of the way differs along each of the frame's axes. Where these
    ``shares (3,)`` are known, the points in both ends count by them along each axis. ``points (3,)`` in the ends are
    known where they are those between which a line was fitted.
    """

    ends: tuple[Thing, ...]
    growing: tuple[Thing, ...] = ()
    by_axis: bool = False
    shares: FloatArray | None = None
    points: tuple[FloatArray, ...] = ()

    def on(self, line: Axes) -> Origin:
        """The same between the points of the ``line``."""
        return replace(self, points=tuple(end.offset for end in line.ends if end.thing in self.ends))

    @property
    def weights(self) -> tuple[FloatArray, ...]:
        """How much the point in each of the ends counts along each axis ``(3,)``."""
        return tuple(np.ones((len(self.ends), 3)) if self.shares is None else np.array([1 - self.shares, self.shares]))


@dataclass(frozen=True, eq=False)
class Candidates:
    """All combinations of M ``axes`` and N ``origins`` for I demonstrations in ``scene``."""

    scene: Scene
    axes: tuple[Axes, ...]
    origins: tuple[Origin, ...]
    growing: tuple[Thing, ...]

    @classmethod
    def of(cls, things: Sequence[Thing], scene: Scene) -> Candidates:
        """Axes of things and along lines between two; origins at one thing and between two."""
        ends, points = _ends(things)
        few = len(scene[WORLD].size) < DEMOS_TO_TELL_THINGS
        pairs = [] if few else list(combinations(ends, 2))
        axes = [Axes((Anchor(thing, ZERO),)) for thing in (WORLD, *things) if thing is WORLD or thing.turns]
        for pair in pairs:
            line = Axes(tuple(Anchor(thing, ZERO) for thing in pair))
            axes.append(line)
            rise = np.ptp(scene[pair[1]].position[:, 2] - scene[pair[0]].position[:, 2])
            if rise > 10 * NOISE_M and WORLD not in pair:
                axes.append(replace(line, in_space=True))
        hinged = [thing for thing in things if thing.kind == "hinged"]
        singles = [(thing,) for thing in dict.fromkeys([*ends, *points, *hinged])]
        growing = tuple(thing for thing in things if thing.kind == "scaled")
        origins = [Origin(own, grows) for own in (*singles, *pairs) for grows in dict.fromkeys(((), growing))]
        return cls(scene, tuple(axes), tuple(origins), growing)

    def with_more_origins(self, things: Sequence[Thing]) -> Candidates:
        """With shares along each axis of the way between two things, and shares of the ways between three."""
        ends, _ = _ends(things)
        more = [Origin(pair, by_axis=True) for pair in combinations(ends, 2)]
        more += [Origin(three) for three in combinations(ends, 3)]
        return replace(self, origins=(*self.origins, *more))

    def nearest(self, squared: FloatArray) -> tuple[int, ...]:
        """The keypoints of the thing whose own frames explain a step best, from its errors ``squared (M, N)``."""
        single = [n for n, origin in enumerate(self.origins) if len(origin.ends) == 1]
        return self.origins[single[int(squared[:, single].min(axis=0).argmin())]].ends[0].members

    def rotations(self) -> FloatArray:
        """R ``(M, I, 3, 3)``."""
        return np.stack([axes.rotation(self.scene) for axes in self.axes])

    @property
    def numbers(self) -> NDArray[np.intp]:
        """Which of all numbers w any of the origins has."""
        most = max(len(origin.ends) for origin in self.origins)
        by_axis = any(origin.by_axis for origin in self.origins)
        shares = ([], [0, 1, 2] if by_axis else [0], [0, 1, 2, 3] if by_axis else [0, 3])[most - 1]
        points = range(POINTS.start, POINTS.start + 3 * most)
        return np.array([*shares, *points, *range(OFFSET.start, OFFSET.stop + 3 * len(self.growing))])

    def model(
        self, home: FloatArray, second: NDArray[np.bool_] | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """o ``(N, I, 3)`` of each origin (the world's is ``home (3,)``); X ``(M, N, I, 3, P)`` of all combinations; and
        the P ridge penalties. X has the columns of the `numbers` alone, and last the offset by which demonstrations of
        a ``second (I,)`` way differ."""
        rotation, scene = self.rotations(), self.scene
        places = {thing: at.position + (home if thing is WORLD else 0.0) for thing, at in scene.items()}
        deviations = np.array(
            [SHARE_STD] * 6 + [POINT_STD_M] * 9 + [OFFSET_STD_M] * 3 + [GROWTH_STD_M] * (3 * len(self.growing))
        )
        start = np.zeros((len(self.origins), rotation.shape[1], 3))
        design = np.zeros((len(rotation), *start.shape, len(deviations)))
        sizes = [(scene[thing].size - 1)[:, None, None] * rotation for thing in self.growing]
        design[..., OFFSET.start :] = np.concatenate([rotation, *sizes], axis=-1)[:, None]
        for index, origin in enumerate(self.origins):
            own = design[:, index]  # (M, I, 3, P)
            ends = [places[end] for end in origin.ends]
            if origin.points:
                ends = [scene[end].point(point) for end, point in zip(origin.ends, origin.points, strict=True)]
            start[index] = ends[0]
            if not origin.growing:
                own[..., GROWTH] = 0.0
            for number, (end, weight) in enumerate(zip(origin.ends, origin.weights, strict=True)):
                if end.turns and not origin.points:
                    turned = scene[end].rotation
                    if origin.shares is not None:
                        turned = (rotation * weight) @ np.swapaxes(rotation, -1, -2) @ turned
                    own[..., POINTS.start + 3 * number :][..., :3] = turned
                if number:
                    away = (ends[number] - ends[0])[..., None]
                    if origin.by_axis:
                        away = rotation * (np.swapaxes(rotation, -1, -2) @ away).swapaxes(-1, -2)
                    own[..., 3 * (number - 1) :][..., : away.shape[-1]] = away
        numbers = self.numbers
        design, penalty = design[..., numbers], (NOISE_M / deviations[numbers]) ** 2
        if second is not None:
            offset = np.broadcast_to((second[:, None, None] * rotation)[:, None], (*design.shape[:-1], 3))
            design = np.concatenate([design, offset], axis=-1)
            penalty = np.append(penalty, [(NOISE_M / OFFSET_STD_M) ** 2] * 3)
        return start, design, penalty


def _ends(things: Sequence[Thing]) -> tuple[list[Thing], list[Thing]]:
    """The things between which an origin may lie, and all loose points."""
    still = [WORLD, *(thing for thing in things if thing.kind in ("upright", "scaled"))]
    points = [thing for thing in things if thing.kind == "point"]
    sized = {member for thing in things if thing.kind == "scaled" for member in thing.members}
    loose = [point for point in points if sized.isdisjoint(point.members)]
    return still + (loose if len(loose) <= MAX_LOOSE else []), points
