"""Keypoints as published: best buddies of the demonstrations, and their nearest neighbours in a new image.

The paper extracts the K descriptors of each image that are most similar to those of other images, by the nearest
neighbour search of Amir et al. (2022), and finds their nearest neighbours in a new image (Oh et al. 2025, Sec. III-A).
That search is about two images; here, as in Di Palo and Johns (2024), it is about all of them:

1. Best buddies: patches of the first image that are mutual nearest neighbours with a patch of another image, both
   salient. Those kept have a best buddy in the most other images.
2. Their descriptors, joined over the images, are clustered by k-means into K clusters; each gives its most salient
   patch.
3. A keypoint's descriptor is the mean, over the demonstrations, of its patches' descriptors of length one. In a new
   image it is at the most similar patch.
4. Pixels are lifted by the depth image.

No objects, poses or workspaces: what turns, looks alike or is hidden is found wrongly, as in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import KeypointError
from robust_instant_policy.geometry import FloatArray, lift
from robust_instant_policy.perception.depth import surface_depth
from robust_instant_policy.perception.descriptors import DescriptorMap, DescriptorNetwork, Float32Array, IntArray
from robust_instant_policy.pointcloud import in_metres

KMEANS_ROUNDS = 20
MAX_BUDDIES = 500  # patches that are clustered: of more, the most salient


@dataclass(frozen=True, eq=False)
class Image:
    """An observation, its descriptors, which patches are salient ``(N,)``, and their depth ``(N,)``, metres or NaN."""

    observation: Observation
    descriptors: DescriptorMap
    salient: NDArray[np.bool_]
    depth: FloatArray

    @classmethod
    def of(cls, observation: Observation, network: DescriptorNetwork) -> Image:
        """Raises `KeypointError` for an image without depth."""
        descriptors = network.describe(observation.rgb)
        threshold = getattr(network, "buddy_saliency", network.salient)  # 0.15 of DINO's, as published
        metres, _ = in_metres(observation.depth)
        depth = surface_depth(metres, _pixels(descriptors, np.arange(descriptors.saliency.size)))
        if not np.isfinite(depth).any():
            raise KeypointError("the depth image has no reading at all; check the camera's depth stream")
        return cls(observation, descriptors, descriptors.saliency.ravel() > threshold, depth)

    def pixels(self, cells: IntArray) -> FloatArray:
        """Centres ``(K, 2)`` (u, v) of patches, inside of the image."""
        height, width = self.observation.depth.shape
        return np.clip(_pixels(self.descriptors, cells), 0, (width - 1, height - 1))

    def points(self, cells: IntArray) -> FloatArray:
        """``(K, 3)``, metres, world, of patches that have depth."""
        return lift(self.pixels(cells), self.depth[cells], self.observation.intrinsics, self.observation.camera_pose)


@dataclass(frozen=True, eq=False)
class SharedDescriptors:
    """K keypoints: their patches ``cells (I, K)`` in each of I ``images``."""

    images: tuple[Image, ...]
    cells: IntArray

    def similarities(self, image: Image) -> Float32Array:
        """Mean cosine similarity ``(K, N)`` of each keypoint's I descriptors and all patches of ``image``: the product
        with their mean."""
        every = np.arange(image.salient.size)
        return np.mean(
            [
                one.descriptors.similarities(cells, image.descriptors, every)
                for one, cells in zip(self.images, self.cells, strict=True)
            ],
            axis=0,
        )

    def agreement(self) -> FloatArray:
        """Mean cosine similarity ``(I, K)``, in [0, 1], of each descriptor and the keypoint's in the other images."""
        count, keypoints = self.cells.shape
        own = [
            self.similarities(image)[np.arange(keypoints), cells]
            for image, cells in zip(self.images, self.cells, strict=True)
        ]
        return np.clip((count * np.array(own, dtype=np.float64) - 1) / max(count - 1, 1), 0, 1)

    def find(self, image: Image) -> tuple[IntArray, FloatArray]:
        """The nearest neighbours ``(K,)`` among the patches of ``image`` with depth, and their similarity in [0, 1]."""
        similar = self.similarities(image)
        similar[:, ~np.isfinite(image.depth)] = -1
        return similar.argmax(axis=1), np.clip(similar.max(axis=1), 0, 1).astype(np.float64)


def share_descriptors(images: Sequence[Image], count: int, seed: int) -> tuple[SharedDescriptors, tuple[str, ...]]:
    """The ``count`` keypoints that ``images`` share, and notes for the user.

    Raises `KeypointError` where no patch has a best buddy.
    """
    first = images[0]
    matches, buddies = [np.arange(first.salient.size)], np.zeros(first.salient.size, dtype=np.intp)
    usable = first.salient & np.isfinite(first.depth)
    for other in images[1:]:
        match, mutual = best_buddies(first, other)
        matches.append(match)
        buddies += mutual
        usable &= np.isfinite(other.depth)[match]
    buddies = np.where(usable, buddies, -1)
    needed = len(images) - 1  # best buddies in all other images, or in as many as it takes for `count` patches
    while needed > 1 and (buddies >= needed).sum() < count:
        needed -= 1
    chosen = np.flatnonzero(buddies >= needed)
    if not len(chosen):
        raise KeypointError(
            "the images have nothing in common: no salient patch of the first is a mutual nearest neighbour of one in "
            "another; do all demonstrations show the same object?"
        )
    cells = np.stack(matches)[:, chosen]  # (I, n)
    saliency = np.mean([image.descriptors.saliency.flat[own] for image, own in zip(images, cells, strict=True)], axis=0)
    ranked = np.argsort(-saliency, kind="stable")[:MAX_BUDDIES]
    cells, saliency = cells[:, ranked], saliency[ranked]
    joined = np.concatenate([_of_length_one(image, own) for image, own in zip(images, cells, strict=True)], axis=1)
    clusters = min(count, cells.shape[1])
    label = kmeans2(joined, clusters, iter=KMEANS_ROUNDS, minit="++", rng=np.random.default_rng(seed))[1]
    picked = [int(np.flatnonzero(label == cluster)[0]) for cluster in np.unique(label)]  # the most salient comes first
    spare = [place for place in range(cells.shape[1]) if place not in picked] + picked * count
    picked += spare[: count - len(picked)]  # after an empty cluster, or with fewer patches than keypoints
    notes: tuple[str, ...] = ()
    if needed < len(images) - 1:
        notes = (f"keypoints are best buddies in {needed} of {len(images) - 1} other images, not in all",)
    return SharedDescriptors(tuple(images), cells[:, picked]), notes


def best_buddies(one: Image, other: Image) -> tuple[IntArray, NDArray[np.bool_]]:
    """The nearest neighbour ``(N,)`` of each patch of ``one`` in ``other``, and which of these pairs are mutual nearest
    neighbours and both salient (Amir et al. 2022).
    """
    mine, its = np.arange(one.salient.size), np.arange(other.salient.size)
    similar = one.descriptors.similarities(mine, other.descriptors, its)
    match = similar.argmax(axis=1)
    mutual = similar.argmax(axis=0)[match] == mine
    return match, mutual & one.salient & other.salient[match]


def _pixels(descriptors: DescriptorMap, cells: IntArray) -> FloatArray:
    columns = descriptors.grid[1]
    return descriptors.origin + descriptors.step * np.stack([cells % columns, cells // columns], axis=-1)


def _of_length_one(image: Image, cells: IntArray) -> Float32Array:
    return image.descriptors.vectors(cells) / image.descriptors.lengths[cells][:, None]
