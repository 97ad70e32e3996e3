"""Rigid objects: models from the demonstrations, and their registration in a new image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robust_instant_policy.geometry import FloatArray, invert_pose, project, transform_points
from robust_instant_policy.perception.descriptors import Float32Array, IntArray
from robust_instant_policy.perception.registration import (
    Candidates,
    Similarity,
    find_rivals,
    refine,
    settle_turn,
    vote_for_motions,
)
from robust_instant_policy.perception.view import MIN_FOREGROUND_POINTS, View, subsample

MAX_TEMPLATE_POINTS = 250
MAX_TEMPLATE_CELLS = 80
SAME_OBJECT_M = 0.025  # from a registered object's points: greatest distance of other points of the object
BEST_TEMPLATES = 3  # whose mean descriptor similarity rates a motion
CLAIM_M = 0.012  # from a registered object's points: image points that it explains
MAX_SHARED = 0.3  # of the points that an object explains, with a better registered one


@dataclass(frozen=True, eq=False)
class Registration:
    """An object in an image: ``pose (4, 4)`` from the reference image's world to the image's; ``fitness`` of its
    points and ``similarity`` of its descriptors, in [0, 1]; ``template``: number of the one with the most similar ones;
    ``rivals``: other motions that explain the image, the pose's own score first.
    """

    pose: FloatArray
    fitness: float
    similarity: float
    template: int
    rivals: Candidates | None = None

    @property
    def score(self) -> float:
        return (self.fitness + self.similarity) / 2


IN_REFERENCE = Registration(np.eye(4), 1.0, 1.0, 0)


@dataclass(frozen=True, eq=False)
class Template:
    """An object in one image, in the reference image's frame: ``xyzrgb (N, 6)`` in metres (see `View`), and the
    ``view``'s ``cells (M,)`` with their ``points (M, 3)``.
    """

    view: View
    xyzrgb: Float32Array
    cells: IntArray
    points: FloatArray


@dataclass(frozen=True, eq=False)
class RigidObject:
    """An object of the reference image: a template of every image in which it was seen, the reference's first, and
    its ``registrations`` in all images.
    """

    templates: tuple[Template, ...]
    registrations: tuple[Registration, ...]

    @property
    def worst_fitness(self) -> float:
        return min(registration.fitness for registration in self.registrations)


def find_objects(views: Sequence[View], seed: int) -> list[RigidObject]:
    """The pieces of the first view, registered in all ``views``."""
    home = views[0]
    models = [
        (_template(home, np.eye(4), points := home.xyzrgb[subsample(piece, MAX_TEMPLATE_POINTS, seed)], points, seed),)
        for piece in home.pieces
        if len(piece) >= MIN_FOREGROUND_POINTS
    ]
    found = [[IN_REFERENCE] * len(models), *(register_all(models, view) for view in views[1:])]
    things = []
    for number, model in enumerate(models):
        templates, registrations = list(model), [row[number] for row in found]
        for i in sorted(range(1, len(views)), key=lambda i: -registrations[i].score):
            better = [k for k in range(len(models)) if found[i][k].score > found[i][number].score]
            taken = _explained(models, found[i], better)
            registrations[i] = register(templates, views[i], taken)
            templates += _another_template(views[i], registrations[i], templates, seed)
        things.append(RigidObject(tuple(templates), tuple(registrations)))
    return things


def register_all(models: Sequence[Sequence[Template]], view: View) -> list[Registration]:
    """Find all objects, each given by its templates, in ``view``, so that no two explain the same points of it.

    Each is registered on its own. From the best one on, an object that explains points of better ones is registered
    again without those.
    """
    found = [register(templates, view) for templates in models]
    tree = cKDTree(view.target[:, :3])
    taken = np.zeros(len(view.target), dtype=bool)
    settled: list[int] = []
    for i in sorted(range(len(models)), key=lambda i: -found[i].score):
        if _shared(tree, taken, models[i], found[i]) > MAX_SHARED:
            again = register(models[i], view, _explained(models, found, settled))
            options = [replace(one, fitness=one.fitness * (1 - _shared(tree, taken, models[i], one))) for one in (found[i], again)]
            found[i] = max(options, key=lambda one: one.score)
        settled.append(i)
        taken[_claim(tree, models[i], found[i])] = True
    return found


def _explained(models: Sequence[Sequence[Template]], found: Sequence[Registration], which: Sequence[int]) -> FloatArray:
    """Points ``(N, 3)`` of the objects ``which``, where they were found."""
    moved = [transform_points(found[i].pose, models[i][found[i].template].xyzrgb[:, :3]) for i in which]
    return np.concatenate([np.zeros((0, 3)), *moved])


def _claim(tree: cKDTree, templates: Sequence[Template], found: Registration) -> IntArray:
    """Numbers of the points in ``tree`` that an object explains."""
    moved = transform_points(found.pose, templates[found.template].xyzrgb[:, :3])
    near = tree.query_ball_point(moved, CLAIM_M)
    return np.unique(np.concatenate([np.asarray(one, dtype=np.intp) for one in near]))


def _shared(tree: cKDTree, taken: NDArray[np.bool_], templates: Sequence[Template], found: Registration) -> float:
    """Share of the points that an object explains that are ``taken (M,)``."""
    claimed = _claim(tree, templates, found)
    return float(taken[claimed].mean()) if len(claimed) else 0.0


def _another_template(
    view: View, found: Registration, templates: Sequence[Template], seed: int
) -> list[Template]:
    """The object as ``view`` shows it, or nothing where it does not."""
    to_reference = invert_pose(found.pose)
    known = templates[found.template].xyzrgb
    points = transform_points(to_reference, view.target[:, :3])
    same = cKDTree(known[:, :3]).query(points)[0] < SAME_OBJECT_M
    if not same.any():
        return []
    seen = np.concatenate([points, view.target[:, 3:]], axis=1)[same].astype(np.float32)
    return [_template(view, to_reference, seen, known, seed)]


def _template(view: View, to_reference: FloatArray, xyzrgb: Float32Array, known: Float32Array, seed: int) -> Template:
    """Of ``xyzrgb (N, 6)`` and of the cells near ``known (M, 6)``, both in the reference image's frame."""
    points = transform_points(to_reference, view.cell_points)
    near = subsample(np.flatnonzero(cKDTree(known[:, :3]).query(points)[0] < SAME_OBJECT_M), MAX_TEMPLATE_CELLS, seed)
    kept = subsample(np.arange(len(xyzrgb)), MAX_TEMPLATE_POINTS, seed)
    return Template(view, xyzrgb[kept], view.cells[near], points[near])


def register(templates: Sequence[Template], view: View, taken: FloatArray | None = None) -> Registration:
    """Find the object of ``templates`` in ``view``, apart from the points near ``taken (T, 3)``, metres, world."""
    target, free = view.target, np.arange(len(view.cell_points))
    if taken is not None and len(taken):
        others = cKDTree(taken)
        target = target[others.query(target[:, :3], distance_upper_bound=CLAIM_M)[0] > CLAIM_M]
        free = np.flatnonzero(others.query(view.cell_points, distance_upper_bound=CLAIM_M)[0] > CLAIM_M)
        if len(target) < MIN_FOREGROUND_POINTS or not len(free):
            return Registration(np.eye(4), 0.0, 0.0, 0)
    similar = [t.view.descriptors.similarities(t.cells, view.descriptors, view.cells) for t in templates]
    with_foreground = [table[:, free] for table in similar]
    points = np.concatenate([template.points for template in templates])
    motions = vote_for_motions(points, view.cell_points[free], np.concatenate(with_foreground))
    index = int(np.argmax([table.max(axis=1).mean() for table in with_foreground]))
    source, similarity = templates[index].xyzrgb, _similarity(templates, view, similar)
    candidates = refine(motions, source, target, similarity)
    pose = settle_turn(candidates.motions[0], source, target, similarity)
    rivals = find_rivals(pose, source, target, similarity)
    return Registration(pose, float(candidates.fitness[0]), float(candidates.similarity[0]), index, rivals)


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
