"""Which K points become keypoints: shared by all images, recognisable, on a surface, and spread out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.cluster.vq import kmeans2

from robust_instant_policy.geometry import FloatArray, lift, project, transform_points
from robust_instant_policy.perception.depth import surface_depth
from robust_instant_policy.perception.descriptors import IntArray
from robust_instant_policy.perception.objects import MovingObject, View

SEEN_M = 0.008  # distance to the surface within which a point is seen in an image
LIFT_REACH_M = 0.02  # a surface further from where a keypoint should be is not its own
SPREAD_WEIGHT = 0.5  # of lying in the middle of a cluster, against being seen and recognised everywhere
CLUSTER_ROUNDS = 20


def lifted(view: View, points: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
    """``points (N, 3)`` moved along their rays onto the surface that the depth image shows there.

    Also their pixels ``(N, 2)`` and the numbers of those that have no surface near them (a hole, something in
    front), which stay where they are.
    """
    observation = view.observation
    pixels = project(points, observation.intrinsics, observation.camera_pose)
    depth = surface_depth(view.cloud.depth, pixels)
    measured = lift(pixels, np.nan_to_num(depth), observation.intrinsics, observation.camera_pose)
    good = np.isfinite(depth) & (np.linalg.norm(measured - points, axis=1) < LIFT_REACH_M)
    return np.where(good[:, None], measured, points), pixels, np.flatnonzero(~good)


def select(thing: MovingObject, views: Sequence[View], count: int, seed: int) -> tuple[FloatArray, list[str]]:
    """``count`` points ``(count, 3)`` of an object in the first view, and a line for each that had to be replaced.

    The object's points are clustered for diversity; each cluster gives the one that is seen in most images, has best
    buddies in most, is salient, and lies in the middle. A point that cannot be lifted in every image is replaced by
    the next best.
    """
    points = thing.templates[0].painted[:, :3].astype(np.float64)
    saliency = views[0].descriptors.saliency.reshape(-1)
    pixels = project(points, views[0].observation.intrinsics, views[0].observation.camera_pose)
    worth = (thing.residuals(views, points) < SEEN_M).mean(axis=0) + thing.buddies(views, points)
    worth += saliency[views[0].descriptors.cells_at(pixels)]
    unliftable = np.zeros(len(points), dtype=bool)
    for view, registration in zip(views, thing.registrations, strict=True):
        unliftable[lifted(view, transform_points(registration.pose, points))[2]] = True

    count_distinct = min(count, len(points))
    centres, label = kmeans2(points, count_distinct, iter=CLUSTER_ROUNDS, minit="++", rng=np.random.default_rng(seed))
    chosen: list[int] = []
    notes = []
    for cluster in range(count_distinct):
        members = np.flatnonzero(label == cluster)
        if len(members) == 0:
            continue
        distance = np.linalg.norm(points[members] - centres[cluster], axis=1)
        ranked = members[np.argsort(SPREAD_WEIGHT * distance / max(distance.max(), 1e-9) - worth[members])]
        usable = ranked[~unliftable[ranked]]
        if len(usable) and usable[0] != ranked[0]:
            u, v = pixels[ranked[0]]
            notes.append(
                f"a keypoint at pixel ({u:.0f}, {v:.0f}) has no depth in every image; the next best replaces it"
            )
        chosen.append(int((usable if len(usable) else ranked)[0]))
    order = np.argsort(-worth, kind="stable")
    spare = [int(i) for i in order if i not in chosen and not unliftable[i]] + chosen
    while len(chosen) < count:  # an empty cluster, or fewer points than keypoints
        chosen.append(spare.pop(0) if spare else chosen[0])
    return points[chosen], notes
