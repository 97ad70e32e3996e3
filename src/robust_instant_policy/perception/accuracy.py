"""Errors of located keypoints in scenes whose truth a simulator knows.

A keypoint belongs to the moving part on which it lies in most demonstrations. Its true place in a new scene is the
median, over the demonstrations, of its coordinates in the part's frame. Where the part differs in size between scenes
(chests, say) these are relative to the part's visible extent along each axis.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, invert_pose, lift, rotations_about_vertical, transform_points
from robust_instant_policy.perception.keypoints import KeypointExtractor, Located

MIN_MOTION_M = 0.002  # of a part between scenes; less is background
SAME_SIZE_M = 0.008  # greatest difference of extents that different views of one object have
EXTENT_PERCENTILES = (1.0, 99.0)
MARGIN_PX = 1  # around a keypoint, for the part on which it lies


class KnownScene(Protocol):
    """``parts (H, W)``: number of the part at each pixel, -1 for none; their ``names`` and ``poses (P, 4, 4)``."""

    @property
    def parts(self) -> NDArray[np.int64]: ...
    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def poses(self) -> FloatArray: ...


@dataclass(frozen=True, eq=False)
class Accuracy:
    """``errors (S, K)`` in metres in S new scenes; ``part_of (K,)``: names of the keypoints' moving parts, empty for
    none; the new scenes' ``located`` keypoints and their ``truth (S, K, 3)``, metres, world. NaN without a part.
    """

    errors: FloatArray
    part_of: tuple[str, ...]
    located: tuple[Located, ...]
    truth: FloatArray

    @property
    def on_object(self) -> int:
        """Number of keypoints on moving parts."""
        return sum(bool(part) for part in self.part_of)

    @property
    def median(self) -> float:
        """Median error of the keypoints on moving parts, metres."""
        return float(np.nanmedian(self.errors)) if self.on_object else float("nan")

    @property
    def worst_tenth(self) -> float:
        """90th percentile of the error, metres."""
        return float(np.nanpercentile(self.errors, 90)) if self.on_object else float("nan")

    def summary(self) -> str:
        """One line."""
        return (
            f"{self.on_object} of {len(self.part_of)} keypoints on moving objects; error in {len(self.errors)} new "
            f"scenes: median {self.median * 1e3:.1f} mm, 90th percentile {self.worst_tenth * 1e3:.1f} mm"
        )


def measure(
    extractor: KeypointExtractor,
    demonstrations: Sequence[Observation],
    known: Sequence[KnownScene],
    scenes: Sequence[Observation],
    scenes_known: Sequence[KnownScene],
    camera: Callable[[Observation, int], Observation] | None = None,
    symmetries: Mapping[str, int] | None = None,
) -> Accuracy:
    """Locate the keypoints of a fitted ``extractor`` in new ``scenes`` and compare them with the truth.

    ``demonstrations`` are the images it was fitted to, ``known`` their truth, all as rendered; those that it left out
    do not count. ``camera`` makes the extractor's image from a scene and its number. ``symmetries`` are, by name, the
    parts that look the same after each n-th of a turn about the vertical through their frame's origin.
    """
    kept = np.flatnonzero(~extractor.left_out_).tolist()
    shown, known = [demonstrations[i] for i in kept], [known[i] for i in kept]
    located = tuple(
        extractor.locate(scene if camera is None else camera(scene, number)) for number, scene in enumerate(scenes)
    )
    moving = _moving_parts([*known, *scenes_known])
    part_of = tuple(_part_of(pixels, known, moving) for pixels in np.swapaxes(extractor.pixels_[kept], 0, 1))
    found = np.array([image.keypoints for image in located])
    truth = np.full(found.shape, np.nan)
    for part in sorted({*part_of} - {""}):
        own = [k for k, name in enumerate(part_of) if name == part]
        symmetry = (symmetries or {}).get(part, 1)
        places = _places(extractor.keypoints_[kept][:, own], [_looks(_pose(scene, part), symmetry) for scene in known])
        boxes = np.array([_extent(o, s, part) for o, s in zip(shown, known, strict=True)])[:, :, None]
        new_boxes = np.array([_extent(o, s, part) for o, s in zip(scenes, scenes_known, strict=True)])[:, :, None]
        sizes = np.diff(np.concatenate([boxes, new_boxes]), axis=1)
        if np.nanmax(np.nanmax(sizes, axis=0) - np.nanmin(sizes, axis=0)) < SAME_SIZE_M:
            wanted = np.tile(np.median(places, axis=0), (len(scenes), 1, 1))
        else:
            size = np.maximum(boxes[:, 1] - boxes[:, 0], 1e-6)
            share = np.nanmedian((places - boxes[:, 0]) / size, axis=0)
            wanted = new_boxes[:, 0] + share * (new_boxes[:, 1] - new_boxes[:, 0])
        for number, scene in enumerate(scenes_known):
            possible = [transform_points(pose, wanted[number]) for pose in _looks(_pose(scene, part), symmetry)]
            truth[number, own] = _nearest(possible, found[number, own])
    return Accuracy(np.linalg.norm(found - truth, axis=2), part_of, located, truth)


def _looks(pose: FloatArray, symmetry: int) -> FloatArray:
    """The poses ``(symmetry, 4, 4)`` in which a part at ``pose (4, 4)`` looks the same."""
    turned = np.repeat(pose[None], symmetry, axis=0)
    turned[:, :3, :3] = rotations_about_vertical(2 * np.pi * np.arange(symmetry) / symmetry) @ pose[:3, :3]
    return turned


def _places(keypoints: FloatArray, looks: Sequence[FloatArray]) -> FloatArray:
    """``keypoints (I, k, 3)`` of a part in its own frame, at those of its poses ``looks`` in which they agree."""
    first = transform_points(invert_pose(looks[0][0]), keypoints[0])
    return np.array(
        [
            _nearest([transform_points(invert_pose(pose), points) for pose in poses], first)
            for points, poses in zip(keypoints, looks, strict=True)
        ]
    )


def _nearest(possible: Sequence[FloatArray], points: FloatArray) -> FloatArray:
    """The one of ``possible (k, 3)`` with the least sum of distances from ``points (k, 3)``."""
    return min(possible, key=lambda one: float(np.linalg.norm(one - points, axis=1).sum()))


def _pose(scene: KnownScene, part: str) -> FloatArray:
    return scene.poses[scene.names.index(part)]


def _moving_parts(scenes: Sequence[KnownScene]) -> set[str]:
    """Names of the parts that all ``scenes`` have and that are not at the same place in all."""
    places = defaultdict(list)
    for scene in scenes:
        for name in scene.names:
            places[name].append(_pose(scene, name)[:3, 3])
    return {
        name
        for name, positions in places.items()
        if len(positions) == len(scenes) and np.ptp(positions, axis=0).max() > MIN_MOTION_M
    }


def _part_of(pixels: FloatArray, known: Sequence[KnownScene], moving: set[str]) -> str:
    """Name of the moving part at ``pixels (I, 2)`` in most of the I known scenes, or nothing."""
    votes: Counter[str] = Counter()
    for (u, v), scene in zip(np.rint(pixels).astype(int), known, strict=True):
        rows, cols = (slice(max(at - MARGIN_PX, 0), at + MARGIN_PX + 1) for at in (v, u))
        seen = Counter(scene.names[part] for part in scene.parts[rows, cols].flat if part >= 0)
        votes[max(((count, name) for name, count in seen.items() if name in moving), default=(0, ""))[1]] += 1
    return votes.most_common(1)[0][0]


def _extent(observation: Observation, scene: KnownScene, part: str) -> FloatArray:
    """Lower and upper corner ``(2, 3)`` of the visible part in its own frame, metres; NaN where none is visible."""
    seen = (scene.parts == scene.names.index(part)) & (observation.depth > 0)  # 0 and NaN are no reading
    if not seen.any():
        return np.full((2, 3), np.nan)
    pixels = np.argwhere(seen)[:, ::-1]
    points = lift(pixels, observation.depth[seen], observation.intrinsics, observation.camera_pose)
    return np.percentile(transform_points(invert_pose(_pose(scene, part)), points), EXTENT_PERCENTILES, axis=0)
