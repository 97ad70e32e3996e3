"""Frames as a grammar: an origin, and axes.

"4 cm above the cup" is the same numbers in every demonstration in the cup's frame; "10 cm to the left of the middle
between cup and saucer" is so in a frame whose origin is at a share of the way from one to the other, with axes along
the line between them. The words are

    frame  = origin, axes [, growth]
    origin = point of a thing  |  share of the way between points of two things, as a whole or along each axis
             |  shares of the ways from a point of one thing to points of two others
    axes   = a thing's  |  along the line between points of two things, seen from above or in space
    growth = an offset that grows with the size of a thing

where a thing is the world, a keypoint, or keypoints that move together (`things`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from robust_instant_policy.context.things import WORLD, Scene, Thing, locate
from robust_instant_policy.geometry import FloatArray, make_pose, rotations_about_vertical


@dataclass(frozen=True, eq=False)
class Anchor:
    """A point fixed in a thing: its ``offset (3,)``, metres, in the thing's frame."""

    thing: Thing
    offset: FloatArray

    def __str__(self) -> str:
        return str(self.thing)

    def position(self, scene: Scene) -> FloatArray:
        """``(I, 3)``."""
        return scene[self.thing].point(self.offset)


@dataclass(frozen=True, eq=False)
class Axes:
    """One end: the axes of its thing. Two: x along the line from the first to the second, z as near to up as can be,
    which is up itself unless the line is taken ``in_space``."""

    ends: tuple[Anchor, ...]
    in_space: bool = False

    def __str__(self) -> str:
        if len(self.ends) == 1:
            return f"axes of {self.ends[0]}"
        return f"axes along the line from {self.ends[0]} to {self.ends[1]}" + (" in space" if self.in_space else "")

    def rotation(self, scene: Scene) -> FloatArray:
        """``(I, 3, 3)``."""
        if len(self.ends) == 1:
            return scene[self.ends[0].thing].rotation
        line = self.ends[1].position(scene) - self.ends[0].position(scene)
        flat = rotations_about_vertical(np.arctan2(line[:, 1], line[:, 0]))
        if not self.in_space:
            return flat
        rise = np.arctan2(line[:, 2], np.hypot(line[:, 0], line[:, 1]))
        tilt = np.zeros_like(flat)
        tilt[:, 0, 0] = tilt[:, 2, 2] = np.cos(rise)
        tilt[:, 2, 0], tilt[:, 0, 2] = np.sin(rise), -np.sin(rise)
        tilt[:, 1, 1] = 1.0
        return flat @ tilt


@dataclass(frozen=True, eq=False)
class Frame:
    """A coordinate system that can be found in any scene.

    Its origin is the first of ``ends``, moved by ``shares (3,)`` of the way to each further end along the frame's axes,
    and by ``shifts (3,)``, metres, in the axes of each end, which count by ``weights (3,)`` (default: ones) along the
    frame's axes; the world, as an end, is at ``home (3,)``. ``growth`` are things with the offset ``(3,)``, metres in
    the frame, by which the origin moves when the thing's size doubles.
    ``error``, metres, is how far off the demonstrations are when each is predicted from the others (`choose_frames`).
    """

    axes: Axes
    ends: tuple[Thing, ...]
    shifts: tuple[FloatArray, ...]
    shares: tuple[FloatArray, ...] = ()
    weights: tuple[FloatArray, ...] = ()
    growth: tuple[tuple[Thing, FloatArray], ...] = ()
    home: FloatArray = field(default_factory=lambda: np.zeros(3))
    error: float = float("nan")

    def __str__(self) -> str:
        return self.words_from(self)

    def words_from(self, first: Frame) -> str:
        """In words, with shares from those of ``first``, which it continues, to its own."""
        if self.things == (WORLD,):
            return "world"
        start, *further = self.ends
        ways = [
            f"{_percent(low, high)} of the way{after} to {end}"
            for low, high, end, after in zip(first.shares, self.shares, further, (f" from {start}", ""), strict=False)
        ]
        grows = "".join(f", further with the size of {thing}" for thing, _ in self.growth)
        return f"{' and '.join(ways) or start}, {self.axes}{grows}"

    @property
    def things(self) -> tuple[Thing, ...]:
        """What the frame depends on, each once."""
        grown = (thing for thing, _ in self.growth)
        return tuple(dict.fromkeys([*self.ends, *(end.thing for end in self.axes.ends), *grown]))

    def pose_in(self, scene: Scene) -> FloatArray:
        """The frame's poses ``(I, 4, 4)``."""
        rotation = self.axes.rotation(scene)
        points = [scene[end].position + (self.home if end is WORLD else 0.0) for end in self.ends]
        origin = points[0]
        for point, share in zip(points[1:], self.shares, strict=True):
            along = (point - points[0])[:, None] @ rotation * share
            origin = origin + (along @ np.swapaxes(rotation, 1, 2))[:, 0]
        weights = self.weights or [np.ones(3)] * len(self.ends)
        for end, shift, weight in zip(self.ends, self.shifts, weights, strict=True):
            along = (scene[end].rotation @ shift)[:, None] @ rotation * weight
            origin = origin + (along @ np.swapaxes(rotation, 1, 2))[:, 0]
        for thing, offset in self.growth:
            origin = origin + (scene[thing].size - 1)[:, None] * (rotation @ offset)
        return make_pose(rotation, origin)

    def pose(self, keypoints: FloatArray) -> FloatArray:
        """The frame's pose ``(4, 4)`` in the scene of ``keypoints (K, 3)``."""
        return self.pose_in(locate(self.things, keypoints[None]))[0]

    def continues(self, other: Frame) -> bool:
        """Whether both are made of the same things, with the same axes."""
        return self.axes is other.axes and self.ends == other.ends


WORLD_FRAME = Frame(Axes((Anchor(WORLD, np.zeros(3)),)), (WORLD,), (np.zeros(3),))


@dataclass(frozen=True, eq=False)
class FrameUse:
    """A frame in which the steps ``first`` to ``last`` of an arm were planned, in ``words``, and the last step's pose
    ``(4, 4)``."""

    words: str
    arm: int
    first: int
    last: int
    pose: FloatArray


def runs(frames: Sequence[Frame]) -> list[tuple[int, int]]:
    """Runs of steps whose ``frames`` continue each other: the first step, and the one after the last."""
    changes = [step for step in range(1, len(frames)) if not frames[step].continues(frames[step - 1])]
    return list(pairwise([0, *changes, len(frames)]))


def _percent(low: FloatArray, high: FloatArray) -> str:
    """Shares ``(3,)`` in words, once where all axes have the same."""
    spans = [" to ".join(dict.fromkeys(f"{end:z.0%}" for end in ends)) for ends in zip(low, high, strict=True)]
    if len(set(spans)) == 1:
        return spans[0]
    return ", ".join(f"{axis} {span}" for axis, span in zip("xyz", spans, strict=True))
