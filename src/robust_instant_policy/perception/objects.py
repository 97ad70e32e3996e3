"""Rigid objects: models from the demonstrations, and their registration in a new image."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robust_instant_policy.geometry import FloatArray, fit_upright, invert_pose, project, transform_points
from robust_instant_policy.perception.descriptors import Float32Array, IntArray
from robust_instant_policy.perception.parts import MIN_GAIN, candidate_parts, gain
from robust_instant_policy.perception.registration import (
    COLOUR_CAP_M,
    KEPT_COLOUR_CAP_M,
    Candidates,
    Similarity,
    find_rivals,
    fit_shape,
    horizontal_axes,
    polish,
    refine,
    rotated,
    settle_turn,
    vote_for_motions,
    within,
)
from robust_instant_policy.perception.surroundings import Surroundings, grid_around, shown
from robust_instant_policy.perception.view import MIN_OBJECT_M2, TARGET_M, UNRELATED, View, spread_out, subsample

MAX_TEMPLATE_POINTS = 250
MAX_TEMPLATE_CELLS = 80
SAME_OBJECT_M = 0.025  # from a registered object's points: greatest distance of other points of the object
MIN_TARGET_POINTS = round(MIN_OBJECT_M2 / TARGET_M**2)
BEST_TEMPLATES = 3  # whose mean descriptor similarity rates a motion
CLAIM_M = 0.012  # from a registered object's points: image points that it explains
KEPT_COLOUR_M = 0.008  # median over images of the distance in colour, for an object that keeps its colours
HAND_REACH_M = 0.05  # of an object's points, at which a place of the hand counts 1/e
MIN_NEAR = 0.2  # of that count, from which on the hand handles an object
HAND_SPREAD_M = 0.04  # standard deviation of the hand's places in the frame of an object that it handles
MAX_HAND_LOSS = 12.0  # of the logarithm of a motion's chance, for one place of the hand
ALIGNMENT_ROUNDS = 3  # over all demonstrations
EVIDENCE_SCALE = 8.0  # of the surroundings' evidence: neighbouring cells of the grid are not independent
MIN_ADVANTAGE = 1.0  # of the logarithm of the chance, for a motion that replaces the one that ICP found
MAX_RIVAL_LOSS = 6.0  # in units of RIVAL_SCALE, for a motion that the surroundings may speak for
RIVAL_SCALE = 0.03  # of the score by which a motion is worse, for a weight of 1/e
SAME_PLACE_M = 0.02
MIN_FITNESS = 0.15  # of an object's registration in every demonstration
MIN_PART_FITNESS = 0.5  # median, of a part: things of one kind in other colours have 0.3, in the same 0.7
MAX_OBJECTS = 30
SHAPE_REACH_M = 0.03  # from an object: greatest distance of points of a larger one of its kind
SAME_SIZE = 0.04  # greatest logarithm of the stretch between views of an object of one size
MIN_IMAGES_OF_KIND = 3  # that tell whether objects differ in size
PART_TURNS = np.deg2rad(np.arange(-60.0, 90.0, 30.0))  # of a part against its object
MUCH_BETTER = 0.05  # of the score, by which an object's own registration overrules that with its parts
MAX_PART_TRAVEL_M = 0.2
TOUCH_M = 0.03
MAX_SHARED_BY_PART = 0.6  # which touches its object
MAX_SHARED = 0.3  # of the points that an object explains, with a better registered one


NO_MOTIONS = np.zeros((0, 4, 4))


@dataclass(frozen=True, eq=False)
class Registration:
    """An object in an image: ``pose (4, 4)`` from the reference image's world to the image's, after the change of size
    ``shape (4, 4)`` (`fit_shape`), together ``motion (4, 4)``; ``fitness`` of its
    points and ``similarity`` of its descriptors, in [0, 1]; ``template``: number of the one with the most similar ones;
    ``rivals (R, 4, 4)``: other poses, and the chances ``shares (1 + R,)`` of this one and of these.
    """

    pose: FloatArray
    fitness: float
    similarity: float
    template: int
    rivals: FloatArray = field(default_factory=lambda: NO_MOTIONS)
    shares: FloatArray = field(default_factory=lambda: np.ones(1))
    shape: FloatArray = field(default_factory=lambda: np.eye(4))

    @property
    def motion(self) -> FloatArray:
        return self.pose @ self.shape

    @property
    def score(self) -> float:
        return (self.fitness + self.similarity) / 2


IN_REFERENCE = Registration(np.eye(4), 1.0, 1.0, 0)


@dataclass(frozen=True, eq=False)
class Template:
    """An object in one image, in the reference image's frame: a sample ``xyzrgb (N, 6)`` of its points in metres (see
    `View`), its ``surface (S, 3)`` without gaps, and the ``view``'s ``cells (M,)`` with their ``points (M, 3)``.
    """

    view: View
    xyzrgb: Float32Array
    surface: Float32Array
    cells: IntArray
    points: FloatArray


@dataclass(frozen=True, eq=False)
class Model:
    """What an object looks like: its ``templates``, the reference image's first; ``parent``: for a part that moves
    against the rest of an object, the number of that, otherwise -1; ``family``: templates of an object with all its
    parts, which tell its turn where it alone is symmetric; whether it ``varies`` in size between images; its
    ``surroundings``, where the hand's places are known and it is no part; ``colour_cap``, see `icp`.
    """

    templates: tuple[Template, ...]
    parent: int = -1
    family: tuple[Template, ...] = ()
    varies: bool = False
    surroundings: Surroundings | None = None
    colour_cap: float = COLOUR_CAP_M

    @property
    def points(self) -> FloatArray:
        """``(N, 3)`` in the reference image, metres."""
        return self.templates[0].xyzrgb[:, :3].astype(np.float64)


@dataclass(frozen=True, eq=False)
class RigidObject:
    """An object of the reference image: its ``model``, and its ``registrations`` in all images."""

    model: Model
    registrations: tuple[Registration, ...]

    @property
    def points(self) -> FloatArray:
        """``(N, 3)`` in the reference image, metres."""
        return self.model.points

    @property
    def worst_fitness(self) -> float:
        return min(registration.fitness for registration in self.registrations)


def find_objects(views: Sequence[View], seed: int, hands: FloatArray | None = None) -> list[RigidObject]:
    """The rigid objects of the first view, registered in all ``views``.

    A piece of the first view is one object, or several if parts of it move differently in the other views. ``hands
    (I, E, 3)``: places of the hand at corresponding moments of the demonstrations, metres, in the views' worlds: they
    tell how a thing is turned that is grasped or pushed at the same place in all of them.
    """
    home = views[0]
    pieces = list(home.pieces)
    models = [Model((_template_of(home, piece, seed),)) for piece in pieces]
    found = [[IN_REFERENCE] * len(models), *(register_all(models, view) for view in views[1:])]
    handled: set[int] = set()
    if hands is not None and len(views) > 1:
        for number, model in enumerate(models):
            if _nearness(model, hands[0]).max() > MIN_NEAR:
                handled.add(number)
            aligned, models[number] = _aligned(model, views, [row[number] for row in found], hands)
            for row, registration in zip(found, aligned, strict=True):
                row[number] = registration
    number = 0
    while number < len(models) and len(views) > 1:
        if models[number].parent >= 0:  # parts have no parts
            number += 1
            continue
        split = _split(home, pieces[number], views[1:], [row[number] for row in found[1:]], seed)
        if split is None or len(models) >= MAX_OBJECTS:
            number += 1
            continue
        rest, part, pairs = split
        models[number] = replace(models[number], templates=(_template_of(home, rest, seed),))
        models.append(Model((_template_of(home, part, seed),), number))
        pieces[number] = rest
        pieces.append(part)
        found[0].append(IN_REFERENCE)
        for row, (of_rest, of_part) in zip(found[1:], pairs, strict=True):
            row[number] = of_rest
            row.append(of_part)
    models = _attached(models, [len(piece) for piece in pieces], found)
    for number in {model.parent for model in models} - {-1}:
        members = [i for i, model in enumerate(models) if i == number or model.parent == number]
        family = (_template_of(home, np.concatenate([pieces[i] for i in members]), seed),)
        models[number] = replace(models[number], family=family)
    things = [_complete(models, found, number, views, seed, handled) for number in range(len(models))]
    if all(thing.worst_fitness < MIN_FITNESS for thing in things):  # do they have other colours in some images?
        models = [replace(model, colour_cap=COLOUR_CAP_M) for model in models]
        things = [_complete(models, found, number, views, seed, handled) for number in range(len(models))]
    shapes = [
        _shapes([thing.model for thing in things], [thing.registrations[i] for thing in things], view)
        for i, view in enumerate(views)
    ]
    return [
        _with_surroundings(_with_shapes(thing, [row[number] for row in shapes]) if varies else thing, views)
        for number, (thing, varies) in enumerate(zip(things, _vary(np.array(shapes)), strict=True))
    ]


def _with_surroundings(thing: RigidObject, views: Sequence[View]) -> RigidObject:
    """``thing`` with what the ``views`` show around it."""
    if thing.model.parent >= 0 or thing.model.surroundings is None:
        return replace(thing, model=replace(thing.model, surroundings=None))
    motions = [one.motion for one in thing.registrations]
    seen = Surroundings.of(thing.points, views, motions, thing.model.varies)
    return replace(thing, model=replace(thing.model, surroundings=seen))


def _colour_difference(xyzrgb: Float32Array, view: View, pose: FloatArray) -> float:
    """Median distance in colour, as in `View.xyzrgb`, of points ``(N, 6)`` at ``pose`` from those that they lie on."""
    distance, nearest = cKDTree(view.target[:, :3]).query(transform_points(pose, xyzrgb[:, :3]))
    on = distance < CLAIM_M
    if not on.any():
        return float("inf")
    return float(np.median(np.linalg.norm(xyzrgb[on, 3:] - view.target[nearest[on], 3:], axis=1)))


def _nearness(model: Model, hands: FloatArray) -> FloatArray:
    """Of an object to the places ``hands (E, 3)`` in the reference image: ``(E,)`` in [0, 1]."""
    return np.exp(-((cKDTree(model.points).query(hands)[0] / HAND_REACH_M) ** 2))


def _aligned(
    model: Model, views: Sequence[View], found: Sequence[Registration], hands: FloatArray
) -> tuple[list[Registration], Model]:
    """The registrations of an object in ``views``, of those ``found`` and their rivals, for which the surroundings of
    the object and the ``hands`` (see `find_objects`) in its frame agree best; and the object with its surroundings.
    """
    stretch = len(views) >= MIN_IMAGES_OF_KIND
    points = model.points
    near = _nearness(model, hands[0])
    options, priors = [np.eye(4)[None]], [np.zeros(1)]
    poses = [np.eye(4)[None]]
    for number, (view, one) in enumerate(zip(views[1:], found[1:], strict=True), 1):
        by_hand = NO_MOTIONS
        if near.max() > MIN_NEAR:
            by_hand = fit_upright(hands[0], hands[number], near + 1e-9)[None]
            similarity = _similarity(model.templates, view, _similarities(model.templates, view))
            by_hand = refine(
                by_hand, model.templates[0].xyzrgb, view.target, similarity, view.hides, model.colour_cap
            ).motions
        rivals = _alternatives(model, one, view, by_hand)
        prior = (rivals.score - rivals.score.max()) / RIVAL_SCALE
        back = np.linalg.inv(rivals.motions)
        moved = hands[number] @ np.swapaxes(back[:, :3, :3], 1, 2) + back[:, None, :3, 3]
        squares = ((moved - hands[0]) ** 2).sum(axis=2) / (2 * HAND_SPREAD_M**2)
        prior = prior - np.minimum(squares, MAX_HAND_LOSS) @ near
        kept = np.union1d(0, np.flatnonzero(prior > prior.max() - 2 * MAX_RIVAL_LOSS))
        poses.append(rivals.motions[kept])
        options.append(_stretched(model, poses[-1], view) if stretch else poses[-1])
        priors.append(prior[kept])
    cells, grid = grid_around(points)
    states = [shown(cells, view, motions) for view, motions in zip(views, options, strict=True)]
    chosen = [0] * len(views)
    for turn in range(ALIGNMENT_ROUNDS):
        for i in range(1, len(views)):
            others = np.array([states[k][chosen[k]] for k in range(len(views)) if k < i or (k > i and turn)])
            seen = Surroundings.from_states(cells, grid, others, stretch)
            chosen[i] = int((priors[i] + seen.evidence_in(states[i]) / EVIDENCE_SCALE).argmax())
    known = model.templates[0].xyzrgb
    typical = np.median([_colour_difference(known, views[i], poses[i][chosen[i]]) for i in range(1, len(views))])
    if typical < KEPT_COLOUR_M:
        model = replace(model, colour_cap=KEPT_COLOUR_CAP_M)
    aligned = [found[0]]
    for i in range(1, len(views)):
        one, pose = found[i], poses[i][chosen[i]]
        if (pose != one.pose).any():
            similarity = _similarity(model.templates, views[i], _similarities(model.templates, views[i]))
            source = model.templates[one.template].xyzrgb
            pose, fitness, similar = polish(pose, source, views[i].target, similarity, views[i].hides, model.colour_cap)
            one = Registration(pose, fitness, similar, one.template)
        aligned.append(one)
    agreed = np.array([states[k][chosen[k]] for k in range(len(views))])
    return aligned, replace(model, surroundings=Surroundings.from_states(cells, grid, agreed, stretch))


def _attached(models: Sequence[Model], sizes: Sequence[int], found: Sequence[Sequence[Registration]]) -> list[Model]:
    """``models``, where what touches a larger object and stays near it in most images is a part of that."""
    attached = list(models)
    if len(found) < MIN_IMAGES_OF_KIND:
        return attached
    for i, model in enumerate(models):
        centre = model.points.mean(axis=0)
        for k, other in enumerate(attached):
            if attached[i].parent >= 0 or other.parent >= 0 or sizes[k] <= sizes[i] or k == i:
                continue
            if any(one.parent == i for one in attached) or cKDTree(other.points).query(model.points)[0].min() > TOUCH_M:
                continue
            moved = [transform_points(invert_pose(row[k].pose) @ row[i].pose, centre) - centre for row in found[1:]]
            if np.median(np.linalg.norm(moved, axis=1)) < MAX_PART_TRAVEL_M / 2:
                attached[i] = replace(model, parent=k)
    return attached


def _vary(shapes: FloatArray) -> NDArray[np.bool_]:
    """Which objects ``(O,)`` differ in size between images, from their ``shapes (I, O, 4, 4)``."""
    if len(shapes) < MIN_IMAGES_OF_KIND:
        return np.zeros(shapes.shape[1], dtype=bool)
    stretch = np.abs(np.log(np.linalg.eigvalsh(shapes[1:, :, :3, :3]))).max(axis=2)
    return np.median(stretch, axis=0) > SAME_SIZE


def _with_shapes(thing: RigidObject, shapes: Sequence[FloatArray]) -> RigidObject:
    """``thing``, which differs in size, with its ``shapes`` in all images."""
    pairs = zip(thing.registrations, shapes, strict=True)
    return replace(
        thing, model=replace(thing.model, varies=True), registrations=tuple(replace(r, shape=s) for r, s in pairs)
    )


def _shapes(models: Sequence[Model], found: Sequence[Registration], view: View) -> list[FloatArray]:
    """The change of size ``(4, 4)`` of each object: image points belong to the nearest."""
    if not models:
        return []
    points = view.target[:, :3].astype(np.float64)
    owner = _owners(models, [one.pose for one in found], points)
    shapes = []
    for i, (model, one) in enumerate(zip(models, found, strict=True)):
        moved = transform_points(one.pose, model.points)
        # What something hides has not changed.
        goals = np.concatenate([points[owner == i], moved[view.hides(moved)]])
        shapes.append(fit_shape(one.pose, model.points, horizontal_axes(model.points), goals))
    return shapes


def _owners(models: Sequence[Model], motions: Sequence[FloatArray], points: FloatArray) -> IntArray:
    """Number ``(N,)`` of the nearest object, at its motion, to each of ``points (N, 3)``; -1 where none is near."""
    moved = [transform_points(motion, model.points) for model, motion in zip(models, motions, strict=True)]
    distances = np.array([cKDTree(one).query(points, distance_upper_bound=SHAPE_REACH_M)[0] for one in moved])
    return np.where(distances.min(axis=0) < SHAPE_REACH_M, distances.argmin(axis=0), -1)


def segmentation(models: Sequence[Model], found: Sequence[Registration], view: View) -> NDArray[np.int16]:
    """``(H, W)``: the number of the object at each pixel of ``view``, or the key in `REASONS` of why there is none."""
    labels = view.labels.copy()
    owner = _owners(models, [one.motion for one in found], view.points)
    labels[labels >= 0] = np.where(owner >= 0, owner, UNRELATED)
    height, width = view.depth.shape
    return labels.repeat(view.stride, axis=0).repeat(view.stride, axis=1)[:height, :width]


def without(things: Sequence[RigidObject], dropped: Sequence[bool]) -> list[RigidObject]:
    """``things`` without those ``dropped``; their parts stand alone."""
    new_number = np.where(dropped, -1, np.cumsum(~np.array(dropped)) - 1)
    return [
        replace(
            thing,
            model=replace(thing.model, parent=int(new_number[thing.model.parent]) if thing.model.parent >= 0 else -1),
        )
        for thing, drop in zip(things, dropped, strict=True)
        if not drop
    ]


Pair = tuple[Registration, Registration]


def _split(
    home: View, piece: IntArray, views: Sequence[View], found: Sequence[Registration], seed: int
) -> tuple[IntArray, IntArray, list[Pair]] | None:
    """The rest of a ``piece`` of the first view and a part of it that moves differently, with the registrations of both
    in ``views``; None if it is rigid. ``found``: the registrations of the whole.
    """
    motions = [one.pose for one in found]
    best, split = 0.0, None
    for part in candidate_parts(home, piece, views, motions):
        rest_model, part_model = (Model((_template_of(home, piece[which], seed),)) for which in (~part, part))
        pairs = []
        for view, whole in zip(views, found, strict=True):
            rest = register(rest_model.templates, view, starts=whole.pose[None])
            # What the rest explains, or may explain: what is now where the part hid it.
            was_hidden = home.hides(transform_points(invert_pose(rest.pose), view.target[:, :3]))
            taken = np.concatenate([_explained([rest_model], [rest], [0]), view.target[was_hidden, :3]])
            pairs.append((rest, register(part_model.templates, view, taken, parent=rest.pose)))
            if pairs[-1][1].fitness < MIN_FITNESS:
                break
        fitness = [own.fitness for _, own in pairs]
        if min(fitness) < MIN_FITNESS or np.median(fitness) < MIN_PART_FITNESS:
            continue
        share, metres = gain(home.points[piece[part]], views, motions, [own.pose for _, own in pairs])
        # Not the largest share, which half of the part has as well as all of it.
        if share > MIN_GAIN and metres > best:
            best, split = metres, (piece[~part], piece[part], pairs)
    return split


def _complete(
    models: Sequence[Model],
    found: Sequence[Sequence[Registration]],
    number: int,
    views: Sequence[View],
    seed: int,
    handled: Collection[int],
) -> RigidObject:
    """Object ``number`` with templates from all views, and registered with them; the best views come first. Those that
    are ``handled`` stay where the hand tells, and the others yield to them.
    """
    model, registrations = models[number], [row[number] for row in found]
    templates = list(model.templates)
    for i in sorted(range(1, len(views)), key=lambda i: -registrations[i].score):
        rank = [(k in handled, one.score) for k, one in enumerate(found[i])]
        better = [k for k in range(len(models)) if rank[k] > rank[number]]
        taken = _explained(models, found[i], better)
        start = registrations[i].pose[None]
        if number in handled:
            one = register(templates, views[i], taken, start, vote=False, colour_cap=model.colour_cap)
            registrations[i] = one if one.fitness else registrations[i]
        else:
            grown = [*models[:number], replace(model, templates=tuple(templates)), *models[number + 1 :]]
            registrations[i] = _register_model(grown, number, views[i], found[i], taken, start)
        others = _explained(models, found[i], [k for k in range(len(models)) if k != number])
        templates += _another_template(views[i], registrations[i], templates, others, seed)
    return RigidObject(replace(model, templates=tuple(templates)), tuple(registrations))


def _register_model(
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
    alone = register(model.templates, view, taken, starts, colour_cap=model.colour_cap)
    if model.family:
        family = register(model.family, view, taken, colour_cap=model.colour_cap)
        in_family = register(model.templates, view, taken, family.pose[None], vote=False, colour_cap=model.colour_cap)
        if alone.score <= in_family.score + MUCH_BETTER:
            alone = in_family
    return _decided(model, alone, view)


def register_all(models: Sequence[Model], view: View) -> list[Registration]:
    """Find all objects in ``view``, so that no two explain the same points of it.

    Each is registered on its own, a part near its object. From the best one on, an object that explains points of
    better ones is registered again without those, or the one that has them is, whichever explains the image better.
    """
    found: dict[int, Registration] = {}
    for i in sorted(range(len(models)), key=lambda i: models[i].parent >= 0):  # parts come after their objects
        found[i] = _register_model(models, i, view, found)
    points = view.target[:, :3].astype(np.float64)
    claims: dict[int, IntArray] = {}  # of those that are settled
    for i in sorted(found, key=lambda i: -found[i].score):
        most = MAX_SHARED if models[i].parent < 0 else MAX_SHARED_BY_PART
        claimed = _claim(points, models[i], found[i])
        if _shared(claimed, claims.values()) > most:
            contested = found[i]
            again = _register_model(models, i, view, found, _explained(models, found, list(claims)))
            found[i] = max(
                (_apart(points, models[i], one, claims) for one in (contested, again)), key=lambda r: r.score
            )
            # Or does what has the contested points belong somewhere else?
            holders = [k for k in claims if k != models[i].parent and _shared(claimed, [claims[k]]) > most]
            if len(holders) == 1:
                holder, others = holders[0], {k: claims[k] for k in claims if k != holders[0]}
                keeping = _apart(points, models[i], contested, others)
                without_both = _explained(models, found | {i: contested}, [*others, i])
                moved = _register_model(models, holder, view, found, without_both)
                if keeping.score + moved.score > found[i].score + found[holder].score:
                    found |= {i: keeping, holder: moved}
                    claims[holder] = _claim(points, models[holder], moved)
        claims[i] = _claim(points, models[i], found[i])
    result = [found[i] for i in range(len(models))]
    if not any(model.varies for model in models):
        return result
    pairs = zip(models, result, _shapes(models, result, view), strict=True)
    return [replace(one, shape=shape) if model.varies else one for model, one, shape in pairs]


def _explained(
    models: Sequence[Model], found: Sequence[Registration] | Mapping[int, Registration], which: Sequence[int]
) -> FloatArray:
    """Points ``(N, 3)`` of the objects ``which``, where they were found."""
    moved = [transform_points(found[i].motion, models[i].templates[found[i].template].surface) for i in which]
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


def _another_template(
    view: View, found: Registration, templates: Sequence[Template], others: FloatArray, seed: int
) -> list[Template]:
    """The object as ``view`` shows it, apart from what is nearer to ``others (T, 3)``, or nothing where it does not."""
    to_reference = np.asarray(np.linalg.inv(found.motion), dtype=np.float64)
    known = templates[found.template].xyzrgb
    points = transform_points(to_reference, view.target[:, :3])
    distance = cKDTree(known[:, :3]).query(points, distance_upper_bound=SAME_OBJECT_M)[0]
    same = distance < SAME_OBJECT_M
    if len(others):
        same[same] = distance[same] <= cKDTree(others).query(view.target[same, :3])[0]
    if not same.any():
        return []
    seen = np.concatenate([points, view.target[:, 3:]], axis=1)[same].astype(np.float32)
    return [_template(view, to_reference, seen, known, seed)]


def _template_of(home: View, piece: IntArray, seed: int) -> Template:
    """Of the points ``piece`` of the reference image."""
    points = home.xyzrgb[piece]
    return _template(home, np.eye(4), points, points[subsample(np.arange(len(piece)), MAX_TEMPLATE_POINTS, seed)], seed)


def _template(view: View, to_reference: FloatArray, xyzrgb: Float32Array, known: Float32Array, seed: int) -> Template:
    """Of ``xyzrgb (N, 6)`` and of the cells near ``known (M, 6)``, both in the reference image's frame."""
    points = transform_points(to_reference, view.cell_points)
    distance = cKDTree(known[:, :3]).query(points)[0]
    # Beside a higher thing, the mean point of every cell of a small one may be that of the other.
    near = np.flatnonzero(distance <= max(SAME_OBJECT_M, distance.min()))
    near = subsample(near, MAX_TEMPLATE_CELLS, seed)
    kept = subsample(np.arange(len(xyzrgb)), MAX_TEMPLATE_POINTS, seed)
    surface = xyzrgb[spread_out(xyzrgb[:, :3])][:, :3]
    return Template(view, xyzrgb[kept], surface, view.cells[near], points[near])


def register(
    templates: Sequence[Template],
    view: View,
    taken: FloatArray | None = None,
    starts: FloatArray = NO_MOTIONS,
    vote: bool = True,
    parent: FloatArray | None = None,
    beside: FloatArray | None = None,
    colour_cap: float = COLOUR_CAP_M,
) -> Registration:
    """Find the object of ``templates`` in ``view``, apart from the points near ``taken (T, 3)``, metres, world.

    From the motions ``starts (S, 4, 4)``, and unless ``vote`` is false from those of matches. A part also starts from
    turns of the pose ``parent (4, 4)`` of its object, and from matches apart from that object's points
    ``beside (B, 3)``, and stays near it.
    """
    target, free = view.target, np.arange(len(view.cell_points))
    if taken is not None and len(taken):
        target = target[~within(target[:, :3], taken, CLAIM_M)]
        free = np.flatnonzero(~within(view.cell_points, taken, CLAIM_M))
        if len(target) < MIN_TARGET_POINTS or not len(free):
            return Registration(np.eye(4), 0.0, 0.0, 0)
    similar = _similarities(templates, view)
    with_foreground = [table[:, free] for table in similar]
    matches, goals = np.concatenate(with_foreground), view.cell_points[free]
    points = np.concatenate([template.points for template in templates])
    centre = points.mean(axis=0)
    motions = [starts]
    if parent is not None:
        motions.append(rotated(parent, centre, PART_TURNS))
    if vote:
        motions.append(vote_for_motions(points, goals, matches))
    if beside is not None and (apart := ~within(goals, beside, CLAIM_M)).any():
        motions.append(vote_for_motions(points, goals[apart], matches[:, apart]))
    candidates = np.concatenate(motions)
    if parent is not None:
        travel = candidates[:, :3, :3] @ centre + candidates[:, :3, 3] - transform_points(parent, centre)
        candidates = candidates[np.linalg.norm(travel, axis=1) < MAX_PART_TRAVEL_M]
    index = int(np.argmax([table.max(axis=1).mean() for table in with_foreground]))
    source, similarity = templates[index].xyzrgb, _similarity(templates, view, similar)
    refined = refine(candidates, source, target, similarity, view.hides, colour_cap)
    pose = settle_turn(refined.motions[0], source, target, similarity, view.hides, colour_cap)
    return Registration(pose, float(refined.fitness[0]), float(refined.similarity[0]), index, refined.motions[1:])


def _alternatives(model: Model, found: Registration, view: View, others: FloatArray = NO_MOTIONS) -> Candidates:
    """The pose that was ``found``, its rivals, ``others (S, 4, 4)``, and the first one turned."""
    similarity = _similarity(model.templates, view, _similarities(model.templates, view))
    motions = np.concatenate([found.pose[None], found.rivals, others])
    return find_rivals(
        motions, model.templates[found.template].xyzrgb, view.target, similarity, view.hides, model.colour_cap
    )


def _stretched(model: Model, poses: FloatArray, view: View) -> FloatArray:
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


def _decided(model: Model, found: Registration, view: View) -> Registration:
    """``found`` or the rival of it that what ``view`` shows around the object speaks for, with the chances of all."""
    if model.surroundings is None or not found.fitness:
        return found
    rivals = _alternatives(model, found, view)
    chance = (rivals.score - rivals.score.max()) / RIVAL_SCALE
    kept = np.union1d(0, np.flatnonzero(chance > -MAX_RIVAL_LOSS))
    motions = _stretched(model, rivals.motions[kept], view) if model.surroundings.stretch else rivals.motions[kept]
    chance = chance[kept] + model.surroundings.evidence(view, motions) / EVIDENCE_SCALE
    best = _preferred(model, rivals.motions[kept], chance)
    order = np.array([best, *(k for k in range(len(kept)) if k != best)])
    shares = np.exp(np.minimum(chance[order] - chance[best], 0))
    pose, fitness, similarity = rivals.motions[kept[best]], found.fitness, found.similarity
    if best:
        source = model.templates[found.template].xyzrgb
        measured = _similarity(model.templates, view, _similarities(model.templates, view))
        pose, fitness, similarity = polish(pose, source, view.target, measured, view.hides, model.colour_cap)
    return replace(
        found,
        pose=pose,
        fitness=fitness,
        similarity=similarity,
        rivals=rivals.motions[kept[order[1:]]],
        shares=shares / shares.sum(),
    )


def certainty(model: Model, found: Registration, view: View, points: FloatArray) -> FloatArray:
    """Share ``(N,)``, in [0, 1], of the motions, weighted by how well they explain ``view``, that put ``points (N, 3)``
    of the reference image where ``found`` does.
    """
    if len(found.shares) > 1:
        motions, weights = np.concatenate([found.pose[None], found.rivals]), found.shares
    else:
        rivals = _alternatives(model, found, view)
        motions = rivals.motions
        weights = np.exp(np.minimum(rivals.score - rivals.score[0], 0) / RIVAL_SCALE)
    places = points @ np.swapaxes(motions[:, :3, :3], 1, 2) + motions[:, None, :3, 3]
    same = np.linalg.norm(places - places[0], axis=2) < SAME_PLACE_M
    return (weights[:, None] * same).sum(axis=0) / weights.sum()


def _similarities(templates: Sequence[Template], view: View) -> list[Float32Array]:
    """Of the cells of each of ``templates`` and those of ``view``."""
    return [one.view.descriptors.similarities(one.cells, view.descriptors, view.cells) for one in templates]


def _similarity(templates: Sequence[Template], view: View, similar: Sequence[Float32Array]) -> Similarity:
    """A function of motions ``(C, 4, 4)``: the mean descriptor similarity ``(C,)`` at their places.

    ``similar``: for each template the similarities of its cells and the view's.
    """
    points = np.concatenate([template.points for template in templates])
    # Column of each cell of the map; those far from all foreground share a last one of zeros.
    column = np.full(view.descriptors.features.shape[0] * view.descriptors.features.shape[1], len(view.cells))
    column[view.cells] = np.arange(len(view.cells))
    padded = np.pad(np.concatenate(similar), ((0, 0), (0, 1)))
    sizes = np.array([len(template.points) for template in templates])
    starts = np.cumsum(sizes) - sizes

    def similarity(motions: FloatArray) -> FloatArray:
        moved = points @ np.swapaxes(motions[:, :3, :3], 1, 2) + motions[:, None, :3, 3]
        pixels = project(moved.reshape(-1, 3), view.observation.intrinsics, view.observation.camera_pose)
        cells, shares = view.descriptors.around(pixels)
        rows = np.tile(np.arange(len(points)), len(motions))[:, None]
        values = (padded[rows, column[cells]] * shares).sum(axis=1).reshape(len(motions), -1)
        means = np.add.reduceat(values, starts, axis=1) / sizes
        return np.sort(means, axis=1)[:, -BEST_TEMPLATES:].mean(axis=1)

    return similarity
