"""Finds things: from how the distances of keypoints vary over the demonstrations."""

from collections.abc import Sequence

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage, to_tree
from scipy.optimize import least_squares
from scipy.spatial.distance import squareform
from scipy.spatial.transform import Rotation

from robust_instant_policy.context.things import (
    DEMOS_TO_TELL_THINGS,
    OUTLIER_M,
    WORLD,
    Hinge,
    Kind,
    Located,
    Thing,
    as_complex,
    fit_either_hand,
    locate,
    rms_radius,
    squared_norm,
)
from robust_instant_policy.geometry import FloatArray, robust_std, rotations_about_vertical

RIGID_SPREADS = 3.0  # keypoints whose distance varies by so many times the smallest variation belong to the same thing,
RIGID_SPREAD_M = (0.006, 0.015)  # within these limits
OUTLIER_SCATTERS = 4.0  # median distance of keypoints from their places in a thing; one so far off is an outlier
BIWEIGHT_REACH = 9.0  # median deviations up to which a value counts
DEMOS_FOR_MEDIANS = 5  # with fewer, an outlier cannot be identified
SHAPE_TOLERANCE = 0.15  # of a thing's size: how far its shape may vary beside its size
LEAST_SWING_RAD = 0.2  # a part that turns less than this shows no hinge
LEVEL_RAD = 0.2  # usual tilt of a hinge's axis from the horizontal or the vertical; short arcs show the axis badly
HINGE_SHARES = (1.0, 0.25, 0.5, 0.75)  # of a part's angle at which frames about its hinge stand
FLAT_CIRCLE = 0.01  # singular values below this share of the largest: arcs too short to show their centre
HINGE_PRIOR = 0.01  # weight of the first guess: turning about an axis and moving along it change nothing else
LEAST_SCALED = 4  # keypoints of a thing of varying size: two define it
LEAST_GROWTH = 0.1  # standard deviation of a thing's size, relative; one that varies less shows no size
SIZE_EXPLAINS = 0.7  # relative spread of distances when divided by the size, below which a thing has one
MAX_THINGS = 4  # of several keypoints: those of the most keypoints; with more, the choice takes too long
MIRRORED_DEMOS = 2  # in which a thing has the other hand: a single one may be an error


def find_things(keypoints: FloatArray, hinges: bool = True) -> list[Thing]:
    """What demonstrations with ``keypoints (I, K, 3)`` consist of: things of several keypoints, then loose points.

    Keypoints belong together when their distances are nearly the same in all demonstrations, or keep their ratios. With
    too few demonstrations to tell, every group of neighbours may be a thing. ``hinges`` are looked for on demand.
    """
    num_demos, num_points = keypoints.shape[:2]
    if num_points == 1:
        return [Thing("point", (0,))]
    distances = np.linalg.norm(keypoints[:, :, None] - keypoints[:, None], axis=-1)
    if num_demos < DEMOS_TO_TELL_THINGS:
        tree = linkage(squareform(np.median(distances, axis=0), checks=False), "average")
        nodes = to_tree(tree, rd=True)[1]
        groups = [tuple(sorted(node.pre_order())) for node in nodes if not node.is_leaf()]
        return [*_solid(groups, keypoints, RIGID_SPREAD_M[1]), *(Thing("point", (k,)) for k in range(num_points))]
    varies = _scatter(distances)
    least = np.median(np.where(np.eye(num_points, dtype=bool), np.inf, varies).min(axis=1))
    tolerance = float(np.clip(RIGID_SPREADS * least, *RIGID_SPREAD_M))
    clusters = _clusters(varies, tolerance)
    scaled = [thing for thing in _scaled(keypoints, tolerance) if _outnumbers(thing.members, clusters)]
    taken = {member for thing in scaled for member in thing.members}
    groups = [group for group in clusters if len(group) > 1 and taken.isdisjoint(group)]
    things = _solid(sorted(groups, key=lambda group: -len(group))[:MAX_THINGS], keypoints, tolerance) + scaled
    if hinges:
        things += _hinged(things, keypoints, tolerance)
    known = {member for thing in things if thing.kind != "scaled" for member in thing.members}
    return things + [Thing("point", (k,)) for k in range(num_points) if k not in known]


def _clusters(varies: FloatArray, tolerance: float) -> list[tuple[int, ...]]:
    """Groups of keypoints whose distances vary little, from how much each ``varies (K, K)``, metres.

    Within a group all distances vary by less than ``tolerance``, metres (complete linkage). Then each keypoint moves to
    the group to which its distances vary least: near a hinge it suits either part.
    """
    labels = fcluster(linkage(squareform(varies, checks=False), "complete"), tolerance, "distance")
    for _ in range(2):
        member = labels[:, None] == np.unique(labels)  # (K, groups)
        several = member.sum(axis=0) > 1
        apart = np.where(several, varies**2 @ member / np.maximum(member.sum(axis=0) - member, 1), np.inf)
        labels = np.where((member & several).any(axis=1), np.unique(labels)[apart.argmin(axis=1)], labels)
    return [tuple(map(int, np.flatnonzero(labels == label))) for label in np.unique(labels)]


def _outnumbers(members: tuple[int, ...], clusters: Sequence[tuple[int, ...]]) -> bool:
    """Whether ``members``, which keep their shape, outnumber the ``clusters`` among them, which keep their distances.

    A cluster that overlaps with them must lie within them, or have at most half as many keypoints: neighbours on a
    thing whose size hardly changes their distance.
    """
    touching = [set(cluster) for cluster in clusters if not set(cluster).isdisjoint(members)]
    return all(own < set(members) or 2 * len(own) <= len(members) for own in touching)


def _solid(groups: Sequence[tuple[int, ...]], keypoints: FloatArray, tolerance: float) -> list[Thing]:
    things = []
    kinds: tuple[tuple[Kind, int], ...] = (("upright", 2), ("rigid", 3))
    for kind, size in kinds:
        for group in groups:
            if len(group) >= size:
                shape, mirrors, outlier = _mean_shape(keypoints[:, list(group)], kind == "upright", tolerance)
                things.append(Thing(kind, group, shape, mirrors=mirrors, outlier=outlier))
    return things


def _scaled(keypoints: FloatArray, tolerance: float) -> list[Thing]:
    """Things that keep their shape, seen from above, but not their size.

    Two keypoints define a position, a turn and a size; others belong to them where these predict where they are.
    """
    things: list[Thing] = []
    loose = list(range(keypoints.shape[1]))
    while len(loose) >= LEAST_SCALED:
        z = as_complex(keypoints[:, loose])
        apart = z[:, None, :] - z[:, :, None]  # from j to k
        length = np.abs(apart).mean(axis=0)
        coincide = apart == 0  # k is j, or both were found in one place
        relative = (z[:, None, None, :] - z[:, :, None, None]) / np.where(coincide, 1.0, apart)[..., None]
        scatter = np.hypot(spread(relative.real), spread(relative.imag)) * length[..., None]  # (j, k, member)
        near = np.minimum(length[:, None], length[None])  # of a member to j or k
        fits = scatter < np.maximum(SHAPE_TOLERANCE * near, tolerance)
        fits[coincide.any(axis=0)] = False
        count = fits.sum(axis=-1) - (scatter * fits).sum(axis=-1)
        j, k = np.unravel_index(int(np.argmax(count)), count.shape)
        members = tuple(loose[index] for index in np.flatnonzero(fits[j, k]))
        if len(members) < LEAST_SCALED:
            break
        loose = [k for k in loose if k not in members]
        points = keypoints[:, list(members)]
        size = rms_radius(points)
        distances = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
        relative = distances * (size.mean() / size)[:, None, None]
        explained = spread(relative).sum() < SIZE_EXPLAINS * spread(distances).sum()
        if explained and size.std() > LEAST_GROWTH * size.mean():
            unit = points * (size.mean() / size)[:, None, None]
            things.append(Thing("scaled", members, _mean_shape(unit, True, np.inf)[0]))
    return things


def _hinged(things: Sequence[Thing], keypoints: FloatArray, tolerance: float) -> list[Thing]:
    """Rigid things that turn about an axis fixed in another one or in the world, at shares of their angle."""
    rigid = [thing.members for thing in things if thing.kind == "rigid"]
    bases = [WORLD, *(thing for thing in things if thing.kind in ("upright", "rigid"))]
    found = locate(bases, keypoints)
    hinged: list[Thing] = []
    for members in rigid:
        points = keypoints[:, list(members)]
        found_axes = [_hinge(base, found[base], points) for base in bases if base.members != members]
        fits = [fit for fit in found_axes if fit is not None and fit[0] < tolerance]
        if fits:
            _, hinge, shape = min(fits, key=lambda fit: fit[0])
            for share in HINGE_SHARES:
                hinged.append(Thing("hinged", members, shape, Hinge(hinge.base, hinge.point, hinge.rotation, share)))
    return hinged


def _hinge(base: Thing, base_at: Located, points: FloatArray) -> tuple[float, Hinge, FloatArray] | None:
    """The error (metres) of a part with ``points (I, N, 3)`` as one that turns about an axis of ``base``, the hinge,
    and the part's shape about it; None where the part turns too little or no axis fits.

    Seen from the base, each point moves on a circle in a plane across the axis: a first guess, which is then fitted.
    """
    local = (points - base_at.position[:, None]) @ base_at.rotation
    swings = local - local.mean(axis=0)
    frame = np.linalg.svd(swings.reshape(-1, 3), full_matrices=False)[2].T
    frame[:, 1] *= np.linalg.det(frame)  # right-handed, z along the axis
    circles = local @ frame[:, :2]  # |p|² = 2 p·c + a constant for each point: linear in the centre c
    flat = circles - circles.mean(axis=0)
    square = (circles**2).sum(axis=-1)
    centre = np.linalg.lstsq(2 * flat.reshape(-1, 2), (square - square.mean(axis=0)).ravel(), rcond=FLAT_CIRCLE)[0]
    guess = frame @ np.append(centre, (local @ frame[:, 2]).mean())
    if _off_axis(local, guess, frame)[0] > RIGID_SPREADS * RIGID_SPREAD_M[1]:
        return None

    def residuals(x: FloatArray) -> FloatArray:
        rotation = frame @ Rotation.from_rotvec(x[:3]).as_matrix()
        seen, turned, _ = _about_axis(local, guess + x[3:], rotation)
        rise = float(np.arcsin(min(abs(rotation[2, 2]), 1.0)))
        tilt = min(rise, np.pi / 2 - rise) / LEVEL_RAD if base.kind != "rigid" else 0.0
        return np.concatenate([((seen - turned) / OUTLIER_M).ravel(), [tilt], HINGE_PRIOR * x])

    x = least_squares(residuals, np.zeros(6), loss="soft_l1", max_nfev=20).x
    hinge = Hinge(base, guess + x[3:], frame @ Rotation.from_rotvec(x[:3]).as_matrix())
    error, turned, angle = _off_axis(local, hinge.point, hinge.rotation)
    return (error, hinge, turned[0]) if np.ptp(angle) > LEAST_SWING_RAD else None


def _off_axis(local: FloatArray, point: FloatArray, rotation: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """The error (metres) of a part that turns about an axis, its points and angles (`_about_axis`)."""
    seen, turned, angle = _about_axis(local, point, rotation)
    return float(np.sqrt(np.median(squared_norm(seen - turned)))), turned, angle


def _about_axis(
    local: FloatArray, point: FloatArray, rotation: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``local (I, N, 3)`` in the axes of a hinge, the same for a rigid part that turns about its z, and the part's
    angles ``(I,)``, continuous, from the first scene's."""
    seen = (local - point) @ rotation
    shape = seen[0]
    for _ in range(2):
        angle = np.angle((np.conj(as_complex(shape)) * as_complex(seen)).sum(axis=1))
        shape = (seen @ rotations_about_vertical(angle)).mean(axis=0)
    turned = shape @ np.swapaxes(rotations_about_vertical(angle), -1, -2)
    return seen, turned, angle


def spread(values: FloatArray) -> FloatArray:
    """Standard deviation over the first axis; from `DEMOS_FOR_MEDIANS` values on from the median absolute deviation."""
    if len(values) < DEMOS_FOR_MEDIANS:
        return values.std(axis=0)
    return robust_std(values)


def _scatter(distances: FloatArray) -> FloatArray:
    """Standard deviation over the demonstrations of ``distances (I, ...)``, metres: the square root of the biweight
    midvariance (Mosteller and Tukey 1977), which varies less than `spread` where there is noise without outliers."""
    if len(distances) < DEMOS_FOR_MEDIANS:
        return distances.std(axis=0)
    off = distances - np.median(distances, axis=0)
    u = off / np.maximum(BIWEIGHT_REACH * np.median(np.abs(off), axis=0), 1e-9)
    near = np.maximum(1 - u**2, 0)
    slope = (near * (1 - 5 * u**2)).sum(axis=0)
    return np.asarray(np.sqrt(len(distances) * (near**4 * off**2).sum(axis=0)) / np.abs(slope))


def _mean_shape(points: FloatArray, upright: bool, tolerance: float) -> tuple[FloatArray, bool, float]:
    """The centred shape ``(N, 3)`` of which ``points (I, N, 3)`` are noisy, moved copies, whether it ``mirrors``, and
    how far off, metres, an outlier is.

    A reflection keeps all distances, but no motion leads to it: the fit is then off by more than ``tolerance``, metres.
    """
    distances = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
    typical = int(np.argmin(np.abs(distances - np.median(distances, axis=0)).sum(axis=(1, 2))))
    shape = points[typical] - points[typical].mean(axis=0)
    _, _, off = fit_either_hand(shape, points, upright, mirrors=True)
    mirrored = (off[0] > tolerance) & (off[1] < off[0] / 2)
    mirrors = bool(mirrored.sum() >= MIRRORED_DEMOS)
    outlier = OUTLIER_M
    for _ in range(2):
        poses, hand, _ = fit_either_hand(shape, points, upright, mirrors, outlier)
        back = (points - poses[:, None, :3, 3]) @ poses[:, :3, :3]
        back[..., 1] *= hand[:, None]
        shape = np.median(back, axis=0)
        off = np.linalg.norm(back - shape, axis=-1)
        outlier = max(OUTLIER_M, OUTLIER_SCATTERS * float(np.median(off)))
        shape = shape - shape.mean(axis=0)
    return shape, mirrors, outlier
