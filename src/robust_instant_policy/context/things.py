"""Things: keypoints that move together, and where they are in a scene. `discovery` finds them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from robust_instant_policy.geometry import (
    FloatArray,
    fit_rigid,
    fit_upright,
    rotations_about_vertical,
    transform_points,
)

DEMOS_TO_TELL_THINGS = 3  # with fewer, all distances look constant
OUTLIER_M = 0.006  # least distance from its place in a thing at which a keypoint counts as an outlier
MIRROR = np.array([1.0, -1.0, 1.0])

Kind = Literal["world", "point", "upright", "rigid", "scaled", "hinged"]


@dataclass(frozen=True, eq=False)
class Hinge:
    """The axis about which a part turns: a ``point (3,)`` and ``rotation (3, 3)`` in the frame of ``base``, with the
    axis along the rotation's z. ``share`` of the part's angle is taken: 1 is the part, 0 the base."""

    base: Thing
    point: FloatArray
    rotation: FloatArray
    share: float = 1.0


@dataclass(frozen=True, eq=False)
class Thing:
    """Keypoints that move together; its pose can be found in any scene.

    A ``point`` keeps the world's axes. Others turn with the keypoints ``members`` whose positions in the thing are
    ``shape (N, 3)``: ``upright`` about the vertical, ``rigid`` in all directions, ``scaled`` about the vertical with a
    size that differs from scene to scene, ``hinged`` about the axis of ``hinge``. The ``world`` has no members. A thing
    that ``mirrors`` is seen in either hand, as a left and a right shoe: its shape or that with the opposite y.
    ``outlier``, metres: see `robust_fit`.
    """

    kind: Kind
    members: tuple[int, ...] = ()
    shape: FloatArray | None = None
    hinge: Hinge | None = None
    mirrors: bool = False
    outlier: float = OUTLIER_M

    def __str__(self) -> str:
        if self.kind == "world":
            return "the world"
        names = ("keypoint " if len(self.members) == 1 else "keypoints ") + _ranges(self.members)
        if self.hinge is None:
            hand = " (of either hand)" if self.mirrors else ""
            return names + {"rigid": " (in space)", "scaled": " (of any size)"}.get(self.kind, "") + hand
        share = "" if self.hinge.share == 1 else f"{self.hinge.share:.0%} of the angle of "
        return f"{share}{names}, hinged to {self.hinge.base}"

    @property
    def turns(self) -> bool:
        return self.kind not in ("world", "point")

    @property
    def extent(self) -> float:
        """The largest distance of two of its keypoints, metres, at a size of 1."""
        assert self.shape is not None
        return float(np.linalg.norm(self.shape[:, None] - self.shape, axis=-1).max())


@dataclass(frozen=True, eq=False)
class Located:
    """A thing in I scenes: ``rotation (I, 3, 3)``, ``position (I, 3)``, relative ``size (I,)``, and ``hand (I,)``, -1
    where it is mirrored, else 1."""

    rotation: FloatArray
    position: FloatArray
    size: FloatArray
    hand: FloatArray

    def of(self, scenes: np.ndarray) -> Located:
        """The thing in those of the ``scenes`` alone."""
        return Located(self.rotation[scenes], self.position[scenes], self.size[scenes], self.hand[scenes])

    def point(self, offset: FloatArray) -> FloatArray:
        """``(I, 3)``, the world positions of the point ``offset (3,)`` of the thing."""
        return self.position + self.rotation @ offset


WORLD = Thing("world")
Scene = Mapping[Thing, Located]


def locate(things: Iterable[Thing], keypoints: FloatArray) -> dict[Thing, Located]:
    """Where ``things``, and those that they are hinged to, are in the scenes of ``keypoints (I, K, 3)``."""
    found: dict[Thing, Located] = {}
    for thing in things:
        if thing.hinge is not None and thing.hinge.base not in found:
            found[thing.hinge.base] = _located(thing.hinge.base, keypoints, found)
        if thing not in found:
            found[thing] = _located(thing, keypoints, found)
    return found


def _located(thing: Thing, keypoints: FloatArray, found: Scene) -> Located:
    count = len(keypoints)
    still, unit = np.tile(np.eye(3), (count, 1, 1)), np.ones(count)
    if thing.kind == "world":
        return Located(still, np.zeros((count, 3)), unit, unit)
    points = keypoints[:, list(thing.members)]
    if thing.kind == "point":
        return Located(still, points[:, 0], unit, unit)
    assert thing.shape is not None
    if thing.hinge is not None:
        hinge, base = thing.hinge, found[thing.hinge.base]
        axis = base.rotation @ hinge.rotation
        origin = base.point(hinge.point)
        turned = as_complex((points - origin[:, None]) @ axis)
        angle = np.angle((np.conj(as_complex(thing.shape)) * turned).sum(axis=1))
        return Located(axis @ rotations_about_vertical(hinge.share * angle), origin, unit, unit)
    if thing.kind == "scaled":
        middle = points.mean(axis=1)
        ratio = (np.conj(as_complex(thing.shape)) * as_complex(points - middle[:, None])).sum(axis=1)
        ratio = ratio / (np.abs(as_complex(thing.shape)) ** 2).sum()
        return Located(rotations_about_vertical(np.angle(ratio)), middle, np.abs(ratio), unit)
    poses, hand, _ = fit_either_hand(thing.shape, points, thing.kind == "upright", thing.mirrors, thing.outlier)
    radius = float(rms_radius(thing.shape[None], 3)[0])  # 0 where all its keypoints coincide
    return Located(poses[:, :3, :3], poses[:, :3, 3], rms_radius(points, 3) / radius if radius else unit, hand)


def robust_fit(shape: FloatArray, points: FloatArray, upright: bool, outlier: float = OUTLIER_M) -> FloatArray:
    """Poses ``(I, 4, 4)`` that map ``shape (N, 3)`` onto ``points (I, N, 3)``, robust to a minority of outliers.

    The best of all minimal subsets, refined by iteratively reweighted least squares; a point that is off by
    ``outlier``, metres, has a quarter of the weight.
    """
    size = 2 if upright else 3
    fit = fit_upright if upright else fit_rigid
    if len(shape) <= size:
        return fit(np.broadcast_to(shape, points.shape), points, np.ones(points.shape[:2]))
    subsets = np.array(list(combinations(range(len(shape)), size)))
    starts = fit(shape[subsets], points[:, subsets], np.ones((len(points), *subsets.shape)))  # (I, subsets, 4, 4)
    loss = squared_norm(transform_points(starts, shape) - points[:, None])
    best = np.argmin((loss / (loss + outlier**2)).sum(axis=-1), axis=1)
    pose = starts[np.arange(len(points)), best]
    for _ in range(5):
        residual = squared_norm(transform_points(pose, shape) - points)
        pose = fit(np.broadcast_to(shape, points.shape), points, 1 / (1 + residual / outlier**2) ** 2)
    return pose


def fit_either_hand(
    shape: FloatArray, points: FloatArray, upright: bool, mirrors: bool, outlier: float = OUTLIER_M
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Poses ``(I, 4, 4)`` as of `robust_fit`, the hand ``(I,)``, -1 where the mirrored shape fits better, and the root
    mean square distances ``(H, I)``, metres, of the points from the shape and from the mirrored one if it ``mirrors``.
    """
    shapes = [shape, shape * MIRROR] if mirrors else [shape]
    fits = np.stack([robust_fit(own, points, upright, outlier) for own in shapes])
    fitted = np.stack([transform_points(poses, own) for poses, own in zip(fits, shapes, strict=True)])
    off = np.sqrt(squared_norm(fitted - points).mean(axis=-1))
    best = off.argmin(axis=0)
    return fits[best, np.arange(len(points))], 1.0 - 2.0 * best, off


def rms_radius(points: FloatArray, dimensions: int = 2) -> FloatArray:
    """Of ``points (I, N, 3)``, seen from above or in space: ``(I,)``, metres."""
    seen = points[..., :dimensions] - points[..., :dimensions].mean(axis=1, keepdims=True)
    return np.sqrt((seen**2).sum(axis=-1).mean(axis=-1))


def squared_norm(vectors: FloatArray) -> FloatArray:
    return (vectors**2).sum(axis=-1)


def as_complex(points: FloatArray) -> np.ndarray:
    """x + iy: turns and sizes seen from above are complex factors."""
    return points[..., 0] + 1j * points[..., 1]


def _ranges(members: Sequence[int]) -> str:
    """ "0-4, 7" for 0, 1, 2, 3, 4, 7."""
    runs: list[list[int]] = []
    for member in members:
        if runs and member == runs[-1][-1] + 1:
            runs[-1].append(member)
        else:
            runs.append([member])
    return ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs)
