"""The rigid objects of demonstrations: pieces of the first image, their parts, and their places in all images."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robust_instant_policy.geometry import FloatArray, fit_upright, invert_pose, transform_points
from robust_instant_policy.perception.descriptors import Float32Array, IntArray
from robust_instant_policy.perception.matching import (
    CLAIM_M,
    MAX_PART_TRAVEL_M,
    MAX_RIVAL_LOSS,
    RIVAL_SCALE,
    alternatives,
    explained,
    owners,
    register,
    register_all,
    register_model,
    shapes_in,
    stretched,
)
from robust_instant_policy.perception.models import (
    IN_REFERENCE,
    MAX_MISSING,
    MIN_FITNESS,
    NO_MOTIONS,
    SAME_THING_FITNESS,
    Model,
    Registration,
    RigidObject,
    another_template,
    similarity_in,
    template_of,
)
from robust_instant_policy.perception.parts import MIN_GAIN, UNEXPLAINED_M, candidate_parts, gain, surface_distances
from robust_instant_policy.perception.pieces import STRIP_M, UNRELATED
from robust_instant_policy.perception.registration import (
    COLOUR_CAP_M,
    KEPT_COLOUR_CAP_M,
    horizontal_axes,
    refine,
    refine_pose,
)
from robust_instant_policy.perception.surroundings import Surroundings, grid_around, log_sizes, shown
from robust_instant_policy.perception.view import View

KEPT_COLOUR_M = 0.008  # median over images of the distance in colour, for an object that keeps its colours
HAND_REACH_M = 0.05  # of an object's points, at which a place of the hand counts 1/e
MIN_NEAR = 0.2  # of that count, from which on the hand handles an object
HAND_SPREAD_M = 0.04  # standard deviation of the hand's places in the frame of an object that it handles
MAX_HAND_LOSS = 12.0  # of the logarithm of a motion's chance, for one place of the hand
GONE = 0.3  # of the greatest loss, for an object that is not where the hand takes it,
HELD = 0.1  # if the hand takes it there in most demonstrations
ALIGNMENT_ROUNDS = 3  # over all demonstrations
MAX_OBJECTS = 30  # with their parts
SAME_SIZE = 0.04  # greatest logarithm of the stretch between views of an object of one size
MIN_IMAGES_OF_KIND = 3  # that tell whether objects differ in size
TOUCH_M = 0.03  # between a part and its object in the reference image

Pair = tuple[Registration, Registration]


def find_objects(views: Sequence[View], seed: int, hands: FloatArray | None = None) -> list[RigidObject]:
    """The rigid objects of the first view, registered in all ``views``.

    A piece of the first view is one object, or several if parts of it move differently in the other views. ``hands
    (I, E, 3)``: places of the hand at corresponding moments of the demonstrations, metres, in the views' worlds: they
    tell how a thing is turned that is grasped or pushed at the same place in all of them.
    """
    home = views[0]
    pieces = _joined(home, views[1:], seed) if len(views) > 1 else list(home.pieces)
    models = [Model((template_of(home, piece, seed),)) for piece in pieces]
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
        models[number] = replace(models[number], templates=(template_of(home, rest, seed),))
        models.append(Model((template_of(home, part, seed),), number))
        pieces[number] = rest
        pieces.append(part)
        found[0].append(IN_REFERENCE)
        for row, (of_rest, of_part) in zip(found[1:], pairs, strict=True):
            row[number] = of_rest
            row.append(of_part)
    models = _attached(models, [len(piece) for piece in pieces], found)
    for number in {model.parent for model in models} - {-1}:
        members = [i for i, model in enumerate(models) if i == number or model.parent == number]
        family = (template_of(home, np.concatenate([pieces[i] for i in members]), seed),)
        models[number] = replace(models[number], family=family)
    things = [_complete(models, found, number, views, seed, handled) for number in range(len(models))]
    if not any(thing.shared for thing in things):  # do they have other colours in some images?
        models = [replace(model, colour_cap=COLOUR_CAP_M) for model in models]
        things = [_complete(models, found, number, views, seed, handled) for number in range(len(models))]
    shapes = [
        shapes_in([thing.model for thing in things], [thing.registrations[i] for thing in things], view)
        for i, view in enumerate(views)
    ]
    return [
        _with_surroundings(_with_shapes(thing, [row[number] for row in shapes]) if varies else thing, views)
        for number, (thing, varies) in enumerate(zip(things, _vary(np.array(shapes)), strict=True))
    ]


def _joined(home: View, views: Sequence[View], seed: int) -> list[IntArray]:
    """The pieces of the first view; those that are near each other, and that one motion explains in the other
    ``views``, are one: something hid what is between them.
    """
    pieces = list(home.pieces)
    for number in np.argsort([-len(piece) for piece in pieces], kind="stable"):
        for other in range(len(pieces)):
            one, two = pieces[number], pieces[other]
            if other == number or not 0 < len(two) <= len(one):
                continue
            if cKDTree(home.points[one]).query(home.points[two])[0].min() > STRIP_M:
                continue
            both = np.concatenate([one, two])
            templates = (template_of(home, both, seed),)
            motions = [register(templates, view).pose for view in views]
            if all(surface_distances(home.points[part], views, motions).mean() < UNEXPLAINED_M for part in (both, two)):
                pieces[number], pieces[other] = both, both[:0]
    return [piece for piece in pieces if len(piece)]


def _aligned(
    model: Model, views: Sequence[View], found: Sequence[Registration], hands: FloatArray
) -> tuple[list[Registration], Model]:
    """The registrations of an object in ``views``, of those ``found`` and their rivals, for which the surroundings of
    the object and the ``hands`` (see `find_objects`) in its frame agree best; and the object with its surroundings.
    """
    stretch = len(views) >= MIN_IMAGES_OF_KIND
    points = model.points
    centre, radius = points.mean(axis=0, keepdims=True), float(np.sqrt(points.var(axis=0).sum()))
    near = _nearness(model, hands[0])
    options, priors = [np.eye(4)[None]], [np.zeros(1)]
    poses = [np.eye(4)[None]]
    for number, (view, one) in enumerate(zip(views[1:], found[1:], strict=True), 1):
        by_hand = NO_MOTIONS
        if near.max() > MIN_NEAR:
            by_hand = fit_upright(hands[0], hands[number], near + 1e-9)[None]
            similarity = similarity_in(model.templates, view)
            by_hand = refine(
                by_hand, model.templates[0].xyzrgb, view.target, similarity, view.hides, model.colour_cap
            ).motions
        rivals = alternatives(model, one, view, by_hand)
        prior = (rivals.score - rivals.score.max()) / RIVAL_SCALE
        prior = prior - _hand_loss(rivals.motions, hands[0], hands[number], near)
        if one.fitness > SAME_THING_FITNESS:  # a hand that takes another thing here tells nothing of this one
            places = transform_points(rivals.motions, centre)[:, 0]
            elsewhere = np.linalg.norm(places - transform_points(one.pose, centre), axis=1) > radius
            prior[elsewhere & (rivals.fitness < SAME_THING_FITNESS)] = -np.inf
        kept = np.union1d(0, np.flatnonzero(prior > prior.max() - 2 * MAX_RIVAL_LOSS))
        poses.append(rivals.motions[kept])
        options.append(stretched(model, poses[-1], view) if stretch else poses[-1])
        priors.append(prior[kept])
    cells, grid = grid_around(points)
    axes = horizontal_axes(points)[:2, :2]
    states = [shown(cells, view, motions) for view, motions in zip(views, options, strict=True)]
    sizes = [log_sizes(axes, motions) for motions in options]

    def agreed(which: Sequence[int]) -> Surroundings:
        seen, own = (np.array([values[k][chosen[k]] for k in which]) for values in (states, sizes))
        return Surroundings.from_states(cells, grid, seen, stretch, axes, own)

    chosen = [0] * len(views)
    for turn in range(ALIGNMENT_ROUNDS):
        for i in range(1, len(views)):
            others = agreed([k for k in range(len(views)) if k < i or (k > i and turn)])
            chosen[i] = int((priors[i] + others.log_chance_of(states[i], sizes[i])).argmax())
    known = model.templates[0].xyzrgb
    typical = np.median([_colour_difference(known, views[i], poses[i][chosen[i]]) for i in range(1, len(views))])
    if typical < KEPT_COLOUR_M:
        model = replace(model, colour_cap=KEPT_COLOUR_CAP_M)
    aligned = [found[0]]
    for i in range(1, len(views)):
        one, pose = found[i], poses[i][chosen[i]]
        if (pose != one.pose).any():
            similarity = similarity_in(model.templates, views[i])
            source = model.templates[one.template].xyzrgb
            pose, fitness, similar = refine_pose(
                pose, source, views[i].target, similarity, views[i].hides, model.colour_cap
            )
            one = Registration(pose, fitness, similar, one.template)
        aligned.append(one)
    if near.max() > MIN_NEAR:
        pairs = zip(aligned, hands, strict=True)
        loss = np.array([_hand_loss(one.pose[None], hands[0], places, near)[0] for one, places in pairs])
        unlike = np.array([one.fitness < SAME_THING_FITNESS for one in aligned])
        gone = unlike & (loss > GONE * MAX_HAND_LOSS * near.sum())
        if gone.mean() <= MAX_MISSING and np.median(loss) < HELD * MAX_HAND_LOSS * near.sum():
            aligned = [replace(one, fitness=0.0) if lost else one for one, lost in zip(aligned, gone, strict=True)]
    return aligned, replace(model, surroundings=agreed(range(len(views))))


def _hand_loss(motions: FloatArray, shown: FloatArray, hands: FloatArray, near: FloatArray) -> FloatArray:
    """By how much places ``hands (E, 3)`` of the hand in an image speak against an object's ``motions (C, 4, 4)``: of
    the logarithm of the chance ``(C,)``. ``shown (E, 3)`` are those in the reference image, which are ``near (E,)`` it.
    """
    back = np.linalg.inv(motions)
    moved = hands @ np.swapaxes(back[:, :3, :3], 1, 2) + back[:, None, :3, 3]
    squares = ((moved - shown) ** 2).sum(axis=2) / (2 * HAND_SPREAD_M**2)
    return np.asarray(np.minimum(squares, MAX_HAND_LOSS) @ near)


def _with_surroundings(thing: RigidObject, views: Sequence[View]) -> RigidObject:
    """``thing`` with what the ``views`` show around it."""
    if thing.model.parent >= 0 or thing.model.surroundings is None:
        return replace(thing, model=replace(thing.model, surroundings=None))
    showing = np.flatnonzero(thing.shown).tolist()
    motions = [thing.registrations[i].motion for i in showing]
    seen = Surroundings.of(thing.points, [views[i] for i in showing], motions, thing.model.varies)
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


def _split(
    home: View, piece: IntArray, views: Sequence[View], found: Sequence[Registration], seed: int
) -> tuple[IntArray, IntArray, list[Pair]] | None:
    """The rest of a ``piece`` of the first view and a part of it that moves differently, with the registrations of both
    in ``views``; None if it is rigid. ``found``: the registrations of the whole.
    """
    motions = [one.pose for one in found]
    best, split = 0.0, None
    for part in candidate_parts(home, piece, views, motions):
        rest_model, part_model = (Model((template_of(home, piece[which], seed),)) for which in (~part, part))
        pairs = []
        for view, whole in zip(views, found, strict=True):
            rest = register(rest_model.templates, view, starts=whole.pose[None])
            # What the rest explains, or may explain: what is now where the part hid it.
            was_hidden = home.hides(transform_points(invert_pose(rest.pose), view.target[:, :3]))
            taken = np.concatenate([explained([rest_model], [rest], [0]), view.target[was_hidden, :3]])
            pairs.append((rest, register(part_model.templates, view, taken, parent=rest.pose)))
            if pairs[-1][1].fitness < MIN_FITNESS:
                break
        of_rest, of_part, of_whole = ([one.fitness for one in row] for row in (*zip(*pairs, strict=True), found))
        if min(of_part) < MIN_FITNESS or np.median(of_part) < SAME_THING_FITNESS:
            continue
        # Two motions explain the images better than one, or the part follows noise.
        if part.mean() * np.mean(of_part) + (1 - part.mean()) * np.mean(of_rest) < np.mean(of_whole):
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
    are ``handled`` stay where the hand tells, and others yield to them where they fit.
    """
    model, registrations = models[number], [row[number] for row in found]
    templates = list(model.templates)
    for i in sorted(range(1, len(views)), key=lambda i: -registrations[i].score):
        if number in handled and not registrations[i].fitness:
            continue
        rank = [(k in handled and one.fitness > SAME_THING_FITNESS, one.score) for k, one in enumerate(found[i])]
        better = [k for k in range(len(models)) if rank[k] > rank[number]]
        taken = explained(models, found[i], better)
        start = registrations[i].pose[None]
        if number in handled:
            one = register(templates, views[i], taken, start, vote=False, colour_cap=model.colour_cap)
            registrations[i] = one if one.fitness else registrations[i]
        else:
            grown = [*models[:number], replace(model, templates=tuple(templates)), *models[number + 1 :]]
            registrations[i] = register_model(grown, number, views[i], found[i], taken, start)
        others = explained(models, found[i], [k for k in range(len(models)) if k != number])
        if registrations[i].fitness >= MIN_FITNESS:
            templates += another_template(views[i], registrations[i], templates, others, seed)
    return RigidObject(replace(model, templates=tuple(templates)), tuple(registrations))


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


def segmentation(models: Sequence[Model], found: Sequence[Registration], view: View) -> NDArray[np.int16]:
    """``(H, W)``: the number of the object at each pixel of ``view``, or the key in `REASONS` of why there is none."""
    labels = view.labels.copy()
    owner = owners(models, [one.motion for one in found], view.points)
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
