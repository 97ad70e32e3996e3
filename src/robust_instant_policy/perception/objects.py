"""Rigid objects: models from the demonstrations, and their registration in a new image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from robust_instant_policy.geometry import FloatArray, invert_pose, project, transform_points
from robust_instant_policy.perception.descriptors import Float32Array, IntArray
from robust_instant_policy.perception.registration import refine, vote_for_motions
from robust_instant_policy.perception.view import MIN_FOREGROUND_POINTS, View, subsample

MAX_TEMPLATE_POINTS = 250
MAX_TEMPLATE_CELLS = 80
SAME_OBJECT_M = 0.025  # from a registered object's points: greatest distance of other points of the object
BEST_TEMPLATES = 3  # whose mean descriptor similarity rates a motion


@dataclass(frozen=True, eq=False)
class Registration:
    """An object in an image: ``pose (4, 4)`` from the reference image's world to the image's; ``fitness`` of its
    points and ``similarity`` of its descriptors, in [0, 1]; ``template``: number of the one with the most similar ones.
    """

    pose: FloatArray
    fitness: float
    similarity: float
    template: int


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
    """The segments of the first view, registered in all ``views``."""
    first = views[0]
    return [
        _model(views, first.xyzrgb[subsample(segment, MAX_TEMPLATE_POINTS, seed)], seed)
        for segment in first.pieces
        if len(segment) >= MIN_FOREGROUND_POINTS
    ]


def _model(views: Sequence[View], xyzrgb: Float32Array, seed: int) -> RigidObject:
    """The object of ``xyzrgb (N, 6)`` in the first of ``views``. Each other view adds a template, the best first."""
    templates = [_template(views[0], np.eye(4), xyzrgb, xyzrgb, seed)]
    registrations = [IN_REFERENCE, *(register(templates, view) for view in views[1:])]
    for i in sorted(range(1, len(views)), key=lambda i: -registrations[i].fitness - registrations[i].similarity):
        registrations[i] = register(templates, views[i])
        known = templates[registrations[i].template].xyzrgb
        to_reference = invert_pose(registrations[i].pose)
        points = transform_points(to_reference, views[i].target[:, :3])
        same = cKDTree(known[:, :3]).query(points)[0] < SAME_OBJECT_M
        if same.any():
            seen = np.concatenate([points, views[i].target[:, 3:]], axis=1)[same].astype(np.float32)
            templates.append(_template(views[i], to_reference, seen, known, seed))
    return RigidObject(tuple(templates), tuple(registrations))


def _template(view: View, to_reference: FloatArray, xyzrgb: Float32Array, known: Float32Array, seed: int) -> Template:
    """Of ``xyzrgb (N, 6)`` and of the cells near ``known (M, 6)``, both in the reference image's frame."""
    points = transform_points(to_reference, view.cell_points)
    near = subsample(np.flatnonzero(cKDTree(known[:, :3]).query(points)[0] < SAME_OBJECT_M), MAX_TEMPLATE_CELLS, seed)
    kept = subsample(np.arange(len(xyzrgb)), MAX_TEMPLATE_POINTS, seed)
    return Template(view, xyzrgb[kept], view.cells[near], points[near])


def register(templates: Sequence[Template], view: View) -> Registration:
    """Find the object of ``templates`` in ``view``."""
    similar = [t.view.descriptors.similarities(t.cells, view.descriptors, view.cells) for t in templates]
    with_foreground = [table[:, : len(view.cell_points)] for table in similar]
    points = np.concatenate([template.points for template in templates])
    motions = vote_for_motions(points, view.cell_points, np.concatenate(with_foreground))
    index = int(np.argmax([table.max(axis=1).mean() for table in with_foreground]))

    # Column of each cell of the map; those far from all foreground share a last one of zeros.
    column = np.full(view.descriptors.features.shape[0] * view.descriptors.features.shape[1], len(view.cells))
    column[view.cells] = np.arange(len(view.cells))
    padded = np.pad(np.concatenate(similar), ((0, 0), (0, 1)))
    sizes = np.array([len(template.points) for template in templates])
    starts = np.cumsum(sizes) - sizes

    def similarity(motions: FloatArray) -> FloatArray:
        """Mean descriptor similarity ``(C,)`` at the places of ``motions (C, 4, 4)``, of the best templates."""
        moved = points @ np.swapaxes(motions[:, :3, :3], 1, 2) + motions[:, None, :3, 3]
        pixels = project(moved.reshape(-1, 3), view.observation.intrinsics, view.observation.camera_pose)
        cells, shares = view.descriptors.around(pixels)
        rows = np.tile(np.arange(len(points)), len(motions))[:, None]
        values = (padded[rows, column[cells]] * shares).sum(axis=1).reshape(len(motions), -1)
        means = np.add.reduceat(values, starts, axis=1) / sizes
        return np.sort(means, axis=1)[:, -BEST_TEMPLATES:].mean(axis=1)

    return Registration(*refine(motions, templates[index].xyzrgb, view.target, similarity), index)
