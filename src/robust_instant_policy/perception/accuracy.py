"""How far located keypoints are from where they should be, in scenes whose truth a simulator knows.

A keypoint belongs to the part of the scene that it lies on in most demonstrations. What it should be in a new scene is
the same place on that part: the median, over the demonstrations, of its coordinates in the part's frame. Where the
parts differ in size between scenes (chests of a kind, say), there is no such material point; the same place is then
the same share of the part's visible extent along each axis of its frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, invert_pose, lift, transform_points
from robust_instant_policy.perception.descriptors import IntArray
from robust_instant_policy.perception.keypoints import KeypointExtractor, Located

MOVED_M = 0.002  # a part that never moves further between scenes is background
SAME_SIZE_M = 0.008  # parts whose extents differ less are one object, seen from other sides
EXTENT_PERCENTILES = (1.0, 99.0)
WINDOW = 1  # pixels around a keypoint that say which part it lies on


class KnownScene(Protocol):
    """``parts (H, W)``: index of the part each pixel shows, -1 for none; its ``names`` and ``poses (P, 4, 4)``."""

    @property
    def parts(self) -> NDArray[np.int64]: ...
    @property
    def names(self) -> tuple[str, ...]: ...
    @property
    def poses(self) -> FloatArray: ...


@dataclass(frozen=True, eq=False)
class Accuracy:
    """``errors (S, K)`` in metres over S new scenes, NaN for keypoints on no moving part; ``part_of (K,)`` names
    that part, or is empty; ``located`` are the new scenes' keypoints, ``truth (S, K, 3)`` where they should be.
    """

    errors: FloatArray
    part_of: tuple[str, ...]
    located: tuple[Located, ...]
    truth: FloatArray

    @property
    def on_object(self) -> int:
        return sum(bool(part) for part in self.part_of)

    @property
    def median(self) -> float:
        """Of the keypoints on objects, in metres."""
        return float(np.nanmedian(self.errors)) if self.on_object else float("nan")

    @property
    def worst_tenth(self) -> float:
        """The 90th percentile, in metres."""
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
) -> Accuracy:
    """Locate the keypoints of a fitted ``extractor`` in new ``scenes`` and compare with the truth.

    ``demonstrations`` are the images it was fitted to, ``known`` their truth, all as rendered; ``camera`` makes of a
    scene and its number what the extractor gets to see.
    """
    parts = [_part_of(k, extractor.pixels_, known, scenes_known) for k in range(extractor.pixels_.shape[1])]
    seen = scenes if camera is None else [camera(scene, number) for number, scene in enumerate(scenes)]
    located = tuple(extractor.locate(image) for image in seen)
    truth = np.full((len(scenes), len(parts), 3), np.nan)
    for k, part in enumerate(parts):
        if not part:
            continue
        boxes = np.array([_extent(o, s, part) for o, s in zip(demonstrations, known, strict=True)])
        new_boxes = np.array([_extent(o, s, part) for o, s in zip(scenes, scenes_known, strict=True)])
        pairs = zip(extractor.keypoints_[:, k], known, strict=True)
        places = np.array([transform_points(invert_pose(s.poses[s.names.index(part)]), p) for p, s in pairs])
        sizes = np.diff(np.concatenate([boxes, new_boxes]), axis=1)[:, 0]
        if np.nanmax(np.nanmax(sizes, axis=0) - np.nanmin(sizes, axis=0)) < SAME_SIZE_M:
            wanted = np.tile(np.median(places, axis=0), (len(scenes), 1))
        else:
            size = np.maximum(boxes[:, 1] - boxes[:, 0], 1e-6)
            share = np.nanmedian((places - boxes[:, 0]) / size, axis=0)
            wanted = new_boxes[:, 0] + share * (new_boxes[:, 1] - new_boxes[:, 0])
        for s, scene in enumerate(scenes_known):
            truth[s, k] = transform_points(scene.poses[scene.names.index(part)], wanted[s])
    found = np.array([place.keypoints for place in located])
    return Accuracy(np.linalg.norm(found - truth, axis=2), tuple(parts), located, truth)


def _part_of(k: int, pixels: FloatArray, known: Sequence[KnownScene], others: Sequence[KnownScene]) -> str:
    """Name of the moving part on which keypoint ``k`` lies in most demonstrations, or nothing."""
    votes: dict[str, int] = {}
    for (u, v), scene in zip(np.rint(pixels[:, k]).astype(int), known, strict=True):
        window = scene.parts[max(v - WINDOW, 0) : v + WINDOW + 1, max(u - WINDOW, 0) : u + WINDOW + 1]
        seen, counts = np.unique(window[window >= 0], return_counts=True)
        moving = [
            (c, scene.names[i]) for i, c in zip(seen, counts, strict=True) if _moves(scene.names[i], known, others)
        ]
        name = max(moving)[1] if moving else ""
        votes[name] = votes.get(name, 0) + 1
    return max(votes, key=lambda name: votes[name]) if votes else ""


def _moves(name: str, *scenes: Sequence[KnownScene]) -> bool:
    places = np.array([s.poses[s.names.index(name), :3, 3] for group in scenes for s in group if name in s.names])
    return bool(np.ptp(places, axis=0).max() > MOVED_M)


def _extent(observation: Observation, scene: KnownScene, part: str) -> FloatArray:
    """Lower and upper corner ``(2, 3)`` of what is seen of a part, in its own frame; NaN where nothing is."""
    rows, cols = np.nonzero(scene.parts == scene.names.index(part))
    if len(rows) == 0:
        return np.full((2, 3), np.nan)
    pixels: IntArray = np.stack([cols, rows], axis=1)
    depth = observation.depth[rows, cols]
    points = lift(pixels, depth, observation.intrinsics, observation.camera_pose)
    local = transform_points(invert_pose(scene.poses[scene.names.index(part)]), points)
    return np.percentile(local, EXTENT_PERCENTILES, axis=0)
