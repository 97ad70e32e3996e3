"""Choice of keypoints on an object: seen and recognised in all images, with depth, and spread out."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from robust_instant_policy.geometry import FloatArray, project, transform_points
from robust_instant_policy.perception.depth import lift_to_surface
from robust_instant_policy.perception.descriptors import IntArray
from robust_instant_policy.perception.models import RigidObject
from robust_instant_policy.perception.view import View

SEEN_M = 0.008  # from the surface: greatest distance of a point that is seen in an image
MATCH_REACH_PATCHES = 2.0  # greatest distance of a mutual nearest neighbour from its place
CENTRE_WEIGHT = 0.5  # of the distance to the cluster's centre, against a point's score
KMEANS_ROUNDS = 20
Buddies = tuple[IntArray, NDArray[np.bool_]]


def select_points(
    thing: RigidObject, views: Sequence[View], buddies: Sequence[Buddies], count: int, seed: int
) -> tuple[FloatArray, list[str]]:
    """``count`` points ``(count, 3)`` of an object, metres, in the first view, and a note for each replaced one.

    The object's points are clustered. Each cluster gives the point with the best sum of three shares (images in which
    it is seen, images in which it is a mutual nearest neighbour, saliency), less its distance from the centre. A
    point without depth in some image is replaced by the next best.
    """
    points = thing.points
    home = views[0]
    pixels = project(points, home.observation.intrinsics, home.observation.camera_pose)
    seen = np.zeros(len(points))
    has_depth = np.ones(len(points), dtype=bool)
    for view, registration, shown in zip(views, thing.registrations, thing.shown, strict=True):
        if not shown:
            continue
        expected = transform_points(registration.motion, points)
        seen += cKDTree(view.points).query(expected)[0] < SEEN_M
        has_depth &= lift_to_surface(view.observation, view.depth, expected)[2]
    score = seen / len(views) + _mutual_matches(thing, views, buddies, points)
    score += home.descriptors.saliency.flat[home.descriptors.cells_at(pixels)]

    clusters = min(count, len(points))
    centres, label = kmeans2(points, clusters, iter=KMEANS_ROUNDS, minit="++", rng=np.random.default_rng(seed))
    chosen: list[int] = []
    notes = []
    for cluster in np.unique(label):
        members = np.flatnonzero(label == cluster)
        distance = np.linalg.norm(points[members] - centres[cluster], axis=1)
        ranked = members[np.argsort(CENTRE_WEIGHT * distance / max(distance.max(), 1e-9) - score[members])]
        usable = ranked[has_depth[ranked]]
        if len(usable) and usable[0] != ranked[0]:
            u, v = pixels[ranked[0]]
            notes.append(
                f"a keypoint at pixel ({u:.0f}, {v:.0f}) has no depth in every image; the next best replaces it"
            )
        chosen.append(int((usable if len(usable) else ranked)[0]))
    order = np.argsort(-score, kind="stable")
    spare = [int(i) for i in order if i not in chosen and has_depth[i]] + chosen
    missing = count - len(chosen)  # after an empty cluster, or with fewer points than keypoints
    chosen += (spare + [chosen[0]] * missing)[:missing]
    return points[chosen], notes


def best_buddies(views: Sequence[View]) -> list[Buddies]:
    """For each but the first of ``views``: which of its foreground cells is the most similar to each one of the first
    view, ``(C,)``, and whether that is mutual, up to the distance of `MATCH_REACH_PATCHES` ("best buddies", Amir et al.
    2022), ``(C,)``.
    """
    home = views[0]
    cells, places = home.cells[: len(home.cell_points)], home.cell_points
    found = []
    for view in views[1:]:
        similar = home.descriptors.similarities(cells, view.descriptors, view.cells[: len(view.cell_points)])
        match = similar.argmax(axis=1)
        back = similar.argmax(axis=0)[match]
        found.append((match, np.linalg.norm(places[back] - places, axis=1) < _reach(home)))
    return found


def _reach(home: View) -> float:
    """Metres."""
    patch_m = home.descriptors.step.mean() * np.nanmedian(home.depth) / home.observation.intrinsics[0, 0]
    return float(MATCH_REACH_PATCHES * patch_m)


def _mutual_matches(
    thing: RigidObject, views: Sequence[View], buddies: Sequence[Buddies], points: FloatArray
) -> FloatArray:
    """Share ``(N,)`` of the other views in which the descriptors at ``points (N, 3)`` have a best buddy near their
    place.
    """
    if len(views) == 1:
        return np.ones(len(points))
    home = views[0]
    votes = np.zeros(len(home.cell_points))
    for view, registration, (match, mutual) in zip(views[1:], thing.registrations[1:], buddies, strict=True):
        expected = transform_points(registration.motion, home.cell_points)
        votes += mutual & (np.linalg.norm(view.cell_points[match] - expected, axis=1) < _reach(home))
    return votes[cKDTree(home.cell_points).query(points)[1]] / (len(views) - 1)
