"""Registration of known objects in a view: each alone, all together, and its rivals."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from robust_instant_policy.geometry import FloatArray, transform_points
from robust_instant_policy.perception.descriptors import IntArray
from robust_instant_policy.perception.models import (
    NO_MOTIONS,
    NOT_FOUND,
    Model,
    Registration,
    Template,
    similarities,
    similarity_in,
)
from robust_instant_policy.perception.registration import (
    COLOUR_CAP_M,
    Candidates,
    Penalty,
    find_rivals,
    fit_shape,
    horizontal_axes,
    no_penalty,
    refine,
    refine_pose,
    rotated,
    settle_turn,
    vote_for_motions,
    within,
)
from robust_instant_policy.perception.view import MIN_OBJECT_M2, TARGET_M, View, spread_out

MIN_TARGET_POINTS = round(MIN_OBJECT_M2 / TARGET_M**2)  # of an image; with fewer nothing is registered in it
CLAIM_M = 0.012  # from a registered object's points: image points that it explains
DECISIONS = 3  # at most, between a motion and its rivals
MIN_ADVANTAGE = 1.0  # of the logarithm of the chance, for a motion that replaces the one that ICP found
MAX_RIVAL_LOSS = 6.0  # in units of RIVAL_SCALE, for a motion that the surroundings may speak for
RIVAL_SCALE = 0.03  # of the score by which a motion is worse, for a weight of 1/e
SAME_PLACE_M = 0.02  # mean distance of an object's points under two motions, for the same place
SHAPE_REACH_M = 0.03  # from an object: greatest distance of points of a larger one of its kind
PART_TURNS = np.deg2rad(np.arange(-60.0, 90.0, 30.0))  # of a part against its object
QUARTER_TURNS = np.deg2rad([0.0, 90.0, 180.0, 270.0])  # of an object at a piece of its size
PIECE_SIZES = 2.5  # factor between the surfaces of an object and of a piece that may be it
MAX_TAKEN = 0.5  # of the points of such a piece, by other objects
REACHED_M = 0.03  # by a voted motion, from which ICP starts
UNUSUAL_STRETCH = 0.3  # logarithm of a change of size, for a confidence of 1/e
MUCH_BETTER = 0.05  # of the score, by which an object's own registration overrules that with its parts
MAX_PART_TRAVEL_M = 0.2  # against its object
MAX_SHARED = 0.3  # of the points that an object explains, with a better registered one,
MAX_SHARED_BY_PART = 0.6  # and for a part, which touches its object
SAME_LOOK = 0.85  # of an object's fitness and score, that a second thing in what is left of the image has
LEFT_OF_TWIN = 0.5  # share of an object's surface that an image shows of a second thing of its look


def register_all(models: Sequence[Model], view: View) -> list[Registration]:
    """Find all objects in ``view``, so that no two explain the same points of it.

    Each is registered on its own, a part near its object. From the best one on, an object that explains points of
    better ones is registered again without those, or the one that has them is, whichever explains the image better.
    """
    found: dict[int, Registration] = {}
    for i in sorted(range(len(models)), key=lambda i: models[i].parent >= 0):  # parts come after their objects
        found[i] = register_model(models, i, view, found)
    points = view.target[:, :3].astype(np.float64)
    claims: dict[int, IntArray] = {}  # of those that are settled
    for i in sorted(found, key=lambda i: -found[i].score):
        most = MAX_SHARED if models[i].parent < 0 else MAX_SHARED_BY_PART
        claimed = _claim(points, models[i], found[i])
        if _shared(claimed, claims.values()) > most:
            contested = found[i]
            again = register_model(models, i, view, found, explained(models, found, list(claims)))
            found[i] = max(
                (_apart(points, models[i], one, claims) for one in (contested, again)), key=lambda r: r.score
            )
            # Or does what has the contested points belong somewhere else?
            holders = [k for k in claims if k != models[i].parent and _shared(claimed, [claims[k]]) > most]
            if len(holders) == 1:
                holder, others = holders[0], {k: claims[k] for k in claims if k != holders[0]}
                keeping = _apart(points, models[i], contested, others)
                without_both = explained(models, found | {i: contested}, [*others, i])
                moved = register_model(models, holder, view, found, without_both)
                if keeping.score + moved.score > found[i].score + found[holder].score:
                    found |= {i: keeping, holder: moved}
                    claims[holder] = _claim(points, models[holder], moved)
        claims[i] = _claim(points, models[i], found[i])
    result = [found[i] for i in range(len(models))]
    if not any(model.varies for model in models):
        return result
    pairs = zip(models, result, shapes_in(models, result, view), strict=True)
    return [replace(one, shape=shape) if model.varies else one for model, one, shape in pairs]


def register_model(
    models: Sequence[Model],
    number: int,
    view: View,
    found: Sequence[Registration] | Mapping[int, Registration],
    taken: FloatArray | None = None,
    starts: FloatArray = NO_MOTIONS,
) -> Registration:
    """Object ``number``: a part near its parent, which was ``found``, and an object with parts where they fit, too."""
    model = models[number]
    if model.parent >= 0:
        parent = found[model.parent]
        # In one image parts hide some of their object, in all of them nothing.
        whole = np.concatenate([template.surface for template in models[model.parent].templates])
        beside = transform_points(parent.motion, whole)
        return register(
            model.templates, view, taken, starts, parent=parent.pose, beside=beside, colour_cap=model.colour_cap
        )
    alone = register(model.templates, view, taken, starts, colour_cap=model.colour_cap, penalty=_height_penalty(model))
    if model.family:
        family = register(model.family, view, taken, colour_cap=model.colour_cap)
        in_family = register(model.templates, view, taken, family.pose[None], vote=False, colour_cap=model.colour_cap)
        if alone.score <= in_family.score + MUCH_BETTER:
            alone = in_family
    return _decided(model, alone, view)


def _height_penalty(model: Model) -> Penalty:
    """What an unusual height takes from the score of an object's motions."""
    around = model.surroundings
    return no_penalty if around is None else lambda motions: RIVAL_SCALE * around.height_penalty(motions)


def register(
    templates: Sequence[Template],
    view: View,
    taken: FloatArray | None = None,
    starts: FloatArray = NO_MOTIONS,
    vote: bool = True,
    parent: FloatArray | None = None,
    beside: FloatArray | None = None,
    colour_cap: float = COLOUR_CAP_M,
    penalty: Penalty = no_penalty,
) -> Registration:
    """Find the object of ``templates`` in ``view``, apart from the points near ``taken (T, 3)``, metres, world.

    From the motions ``starts (S, 4, 4)``, and unless ``vote`` is false from those of matches. A part also starts from
    turns of the pose ``parent (4, 4)`` of its object, and from matches apart from that object's points
    ``beside (B, 3)``, and stays near it. ``penalty``, see `refine`.
    """
    target, free = view.target, np.arange(len(view.cell_points))
    if taken is not None and len(taken):
        target = target[~within(target[:, :3], taken, CLAIM_M)]
        free = np.flatnonzero(~within(view.cell_points, taken, CLAIM_M))
        if len(target) < MIN_TARGET_POINTS or not len(free):
            return NOT_FOUND
    similar = similarities(templates, view)
    with_foreground = [table[:, free] for table in similar]
    matches, goals = np.concatenate(with_foreground), view.cell_points[free]
    points = np.concatenate([template.points for template in templates])
    centre = points.mean(axis=0)
    motions = [starts]
    if parent is not None:
        motions.append(rotated(parent, centre, PART_TURNS))
    if vote:
        motions.append(vote_for_motions(points, goals, matches))
        if parent is None:
            motions.append(_at_pieces(templates[0], view, motions[-1], taken))
    if beside is not None and (apart := ~within(goals, beside, CLAIM_M)).any():
        motions.append(vote_for_motions(points, goals[apart], matches[:, apart]))
    candidates = np.concatenate(motions)
    if parent is not None:
        travel = candidates[:, :3, :3] @ centre + candidates[:, :3, 3] - transform_points(parent, centre)
        candidates = candidates[np.linalg.norm(travel, axis=1) < MAX_PART_TRAVEL_M]
    index = int(np.argmax([table.max(axis=1).mean() for table in with_foreground]))
    source, similarity = templates[index].xyzrgb, similarity_in(templates, view, similar)
    refined = refine(candidates, source, target, similarity, view.hides, colour_cap, penalty)
    pose = settle_turn(refined.motions[0], source, target, similarity, view.hides, colour_cap)
    return Registration(pose, float(refined.fitness[0]), float(refined.similarity[0]), index, refined.motions[1:])


def _at_pieces(template: Template, view: View, voted: FloatArray, taken: FloatArray | None) -> FloatArray:
    """Motions ``(S, 4, 4)`` that put an object of ``template`` at the pieces of ``view`` of about its size that none of
    the ``voted (P, 4, 4)`` motions reaches: the descriptors of a small or an unlike object may all be wrong.
    """
    centre = template.surface.mean(axis=0).astype(np.float64)
    reached = voted[:, :3, :3] @ centre + voted[:, :3, 3]
    motions = [NO_MOTIONS]
    for piece in view.pieces:
        points = view.points[piece]
        place = points.mean(axis=0)
        if (np.linalg.norm(reached - place, axis=1) < REACHED_M).any():
            continue
        if not 1 / PIECE_SIZES < len(spread_out(points)) / len(template.surface) < PIECE_SIZES:
            continue
        if taken is not None and len(taken) and within(points, taken, CLAIM_M).mean() > MAX_TAKEN:
            continue
        motion = np.eye(4)
        motion[:3, 3] = place - centre
        motions.append(rotated(motion, centre, QUARTER_TURNS))
    return np.concatenate(motions)


def find_again(
    models: Sequence[Model], found: Sequence[Registration], view: View, which: Iterable[int]
) -> dict[int, Registration]:
    """Objects ``which`` in what no object explains of ``view``, as far as they fit there about as well as where they
    were ``found``: second things of the same look.

    Parts are not looked for, nor objects with more points than are left. What overlaps with the first thing is a rest
    of that.
    """
    taken = explained(models, found, range(len(models)))
    left = int((~within(view.target[:, :3], taken, CLAIM_M)).sum()) if len(taken) else len(view.target)
    again = {}
    for number in which:
        model = models[number]
        size = len(model.templates[found[number].template].surface)
        if model.parent >= 0 or left < max(MIN_TARGET_POINTS, LEFT_OF_TWIN * size):
            continue
        first = found[number]
        second = register(model.templates, view, taken, colour_cap=model.colour_cap)
        places, occupied = (transform_points(one.motion, model.points) for one in (second, first))
        alike = second.fitness > SAME_LOOK * first.fitness and second.score > SAME_LOOK * first.score
        if alike and within(places, occupied, CLAIM_M).mean() < MAX_TAKEN:
            again[number] = second
    return again


def explained(
    models: Sequence[Model], found: Sequence[Registration] | Mapping[int, Registration], which: Sequence[int]
) -> FloatArray:
    """Points ``(N, 3)`` of the objects ``which``, where they were found."""
    moved = [
        transform_points(found[i].motion, models[i].templates[found[i].template].surface)
        for i in which
        if found[i].fitness
    ]
    return np.concatenate([np.zeros((0, 3)), *moved])


def _claim(points: FloatArray, model: Model, found: Registration) -> IntArray:
    """Numbers of the ``points (N, 3)`` of an image that an object explains."""
    moved = transform_points(found.motion, model.templates[found.template].surface)
    return np.flatnonzero(within(points, moved, CLAIM_M))


def _shared(claimed: IntArray, claims: Iterable[IntArray]) -> float:
    """Share of the points ``claimed (N,)`` by an object that are in ``claims`` of others."""
    return (
        float(np.isin(claimed, np.concatenate([np.zeros(0, dtype=np.intp), *claims])).mean()) if len(claimed) else 0.0
    )


def _apart(points: FloatArray, model: Model, found: Registration, claims: Mapping[int, IntArray]) -> Registration:
    """``found``, whose fitness counts only for points that are in no other object's ``claims``."""
    return replace(found, fitness=found.fitness * (1 - _shared(_claim(points, model, found), claims.values())))


def shapes_in(models: Sequence[Model], found: Sequence[Registration], view: View) -> list[FloatArray]:
    """The change of size ``(4, 4)`` of each object: image points belong to the nearest."""
    if not models:
        return []
    points = view.target[:, :3].astype(np.float64)
    owner = owners(models, [one.pose for one in found], points)
    shapes = []
    for i, (model, one) in enumerate(zip(models, found, strict=True)):
        moved = transform_points(one.pose, model.points)
        # What something hides has not changed.
        goals = np.concatenate([points[owner == i], moved[view.hides(moved)]])
        shapes.append(fit_shape(one.pose, model.points, horizontal_axes(model.points), goals))
    return shapes


def owners(models: Sequence[Model], motions: Sequence[FloatArray], points: FloatArray) -> IntArray:
    """Number ``(N,)`` of the nearest object, at its motion, to each of ``points (N, 3)``; -1 where none is near."""
    moved = [transform_points(motion, model.points) for model, motion in zip(models, motions, strict=True)]
    distances = np.array([cKDTree(one).query(points, distance_upper_bound=SHAPE_REACH_M)[0] for one in moved])
    return np.where(distances.min(axis=0) < SHAPE_REACH_M, distances.argmin(axis=0), -1)


def alternatives(model: Model, found: Registration, view: View, others: FloatArray = NO_MOTIONS) -> Candidates:
    """The pose that was ``found``, its rivals, ``others (S, 4, 4)``, and the first one turned."""
    similarity = similarity_in(model.templates, view)
    motions = np.concatenate([found.pose[None], found.rivals, others])
    return find_rivals(
        motions, model.templates[found.template].xyzrgb, view.target, similarity, view.hides, model.colour_cap
    )


def stretched(model: Model, poses: FloatArray, view: View) -> FloatArray:
    """``poses (C, 4, 4)`` of an object after the change of size for which each fits ``view`` best."""
    target = view.target[:, :3].astype(np.float64)
    axes = horizontal_axes(model.points)
    motions = []
    for pose in poses:
        moved = transform_points(pose, model.points)
        goals = np.concatenate([target[within(target, moved, SHAPE_REACH_M)], moved[view.hides(moved)]])
        motions.append(pose @ fit_shape(pose, model.points, axes, goals))
    return np.array(motions)


def _preferred(model: Model, poses: FloatArray, chance: FloatArray) -> int:
    """Number of the one of ``poses (C, 4, 4)`` with the best ``chance (C,)``, or of the first, which ICP found, where
    that puts the object at the same place.
    """
    places = model.points @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    elsewhere = np.linalg.norm(places - places[0], axis=2).mean(axis=1) > SAME_PLACE_M
    best = int(chance.argmax())
    return best if elsewhere[best] and chance[best] > chance[~elsewhere].max() + MIN_ADVANTAGE else 0


def _decided(model: Model, found: Registration, view: View, rounds: int = DECISIONS) -> Registration:
    """``found`` or the rival of it that what ``view`` shows around the object speaks for, with the chances of all.

    A rival has rivals of its own: so many ``rounds``.
    """
    if model.surroundings is None or not found.fitness:
        return found
    rivals = alternatives(model, found, view)
    chance = (rivals.score - rivals.score.max()) / RIVAL_SCALE
    kept = np.union1d(0, np.flatnonzero(chance > -MAX_RIVAL_LOSS))
    motions = stretched(model, rivals.motions[kept], view) if model.surroundings.stretch else rivals.motions[kept]
    chance = chance[kept] + model.surroundings.log_chance(view, motions)
    best = _preferred(model, rivals.motions[kept], chance)
    order = np.array([best, *(k for k in range(len(kept)) if k != best)])
    shares = np.exp(np.minimum(chance[order] - chance[best], 0))
    pose, fitness, similarity = rivals.motions[kept[best]], found.fitness, found.similarity
    if best:
        source = model.templates[found.template].xyzrgb
        measured = similarity_in(model.templates, view)
        pose, fitness, similarity = refine_pose(pose, source, view.target, measured, view.hides, model.colour_cap)
    decided = replace(
        found,
        pose=pose,
        fitness=fitness,
        similarity=similarity,
        rivals=rivals.motions[kept[order[1:]]],
        shares=shares / shares.sum(),
    )
    return _decided(model, decided, view, rounds - 1) if best and rounds > 1 else decided


def plausibility(model: Model, found: Registration, view: View) -> float:
    """In [0, 1]: less where an object would have another size than in the reference image, or other surroundings than
    in the demonstrations. A wrong turn often needs both.
    """
    stretch = np.abs(np.log(np.linalg.eigvalsh(found.shape[:3, :3]))).max()
    likeness = 1.0 if model.surroundings is None else model.surroundings.likeness(view, found.motion)
    return float(np.exp(-((stretch / UNUSUAL_STRETCH) ** 2)) * likeness)


def certainty(model: Model, found: Registration, view: View, points: FloatArray) -> FloatArray:
    """Share ``(N,)``, in [0, 1], of the motions, weighted by how well they explain ``view``, that put ``points (N, 3)``
    of the reference image where ``found`` does.
    """
    if len(found.shares) > 1:
        motions, weights = np.concatenate([found.pose[None], found.rivals]), found.shares
    else:
        rivals = alternatives(model, found, view)
        motions = rivals.motions
        weights = np.exp(np.minimum(rivals.score - rivals.score[0], 0) / RIVAL_SCALE)
    places = points @ np.swapaxes(motions[:, :3, :3], 1, 2) + motions[:, None, :3, 3]
    same = np.linalg.norm(places - places[0], axis=2) < SAME_PLACE_M
    return (weights[:, None] * same).sum(axis=0) / weights.sum()
