"""Objects that move as one between images: what the demonstrations showed of them, and how they are found again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, invert_pose, project, transform_points
from robust_instant_policy.perception.cloud import Cloud
from robust_instant_policy.perception.descriptors import NEIGHBOURS, DescriptorMap, Float32Array, IntArray
from robust_instant_policy.perception.registration import painted, polish, proposals

MAX_OBJECT_POINTS = 250
MAX_PIECE_POINTS = 500
MAX_OBJECT_CELLS = 80
SAME_OBJECT_M = 0.025  # points of an image this near to where the object was found belong to it
BEST_VIEWS = 3  # demonstrations whose descriptors judge a motion
BUDDY_PATCHES = 2.0  # distance from its place within which a best buddy is one


@dataclass(frozen=True, eq=False)
class View:
    """One image, described: ``painted (N, 6)`` is an even choice of its foreground; ``cells`` those with foreground
    in them, whose mean points are ``cell_points``, followed by the cells around those.
    """

    observation: Observation
    descriptors: DescriptorMap
    cloud: Cloud
    painted: Float32Array
    cells: IntArray
    cell_points: FloatArray

    @property
    def patch_size(self) -> float:
        """Distance between neighbouring patches on the table, in metres."""
        depth = np.nanmedian(self.cloud.depth)
        return float(self.descriptors.step.mean() * depth / self.observation.intrinsics[0, 0])

    @classmethod
    def from_cloud(cls, observation: Observation, descriptors: DescriptorMap, cloud: Cloud, seed: int) -> View:
        cells, inverse, counts = np.unique(cloud.cells, return_inverse=True, return_counts=True)
        sums = np.stack([np.bincount(inverse, cloud.points[:, axis]) for axis in range(3)], axis=1)
        pieces = [np.flatnonzero(cloud.pieces == piece) for piece in np.unique(cloud.pieces)]
        kept = np.concatenate([thin(piece, MAX_PIECE_POINTS, seed) for piece in pieces])
        around = np.unique([descriptors.shifted(cells, row, col) for row, col in NEIGHBOURS])
        return cls(
            observation,
            descriptors,
            cloud,
            painted(cloud.points[kept], cloud.colours[kept]),
            np.concatenate([cells, np.setdiff1d(around, cells)]),
            sums / counts[:, None],
        )


@dataclass(frozen=True, eq=False)
class Registration:
    """Where an object is in an image: ``pose (4, 4)`` from the reference image's world to the image's; ``fit`` of
    its points and ``agreement`` of its descriptors, in [0, 1]; ``template``: the one that fitted best.
    """

    pose: FloatArray
    fit: float
    agreement: float
    template: int


AT_HOME = Registration(np.eye(4), 1.0, 1.0, 0)


@dataclass(frozen=True, eq=False)
class Template:
    """What one image showed of an object, carried back to where the reference image has it: ``painted (N, 6)``,
    and the image's ``cells`` with their ``points``.
    """

    view: View
    painted: Float32Array
    cells: IntArray
    points: FloatArray


class MovingObject:
    """Something rigid (or nearly so), with a template for each image in which it was found.

    ``registrations`` say where it is in each of the images, in their order.
    """

    def __init__(self, views: Sequence[View], points: Float32Array, seed: int):
        """Find the painted ``points (N, 6)`` of the first of ``views`` in all others, the surest first."""
        self._seed = seed
        self.templates: list[Template] = []
        self._remember(views[0], AT_HOME, points)
        self.registrations = [AT_HOME] * len(views)
        alone = {i: self.find(views[i]) for i in range(1, len(views))}
        for index in sorted(alone, key=lambda i: -alone[i].fit - alone[i].agreement):
            self.registrations[index] = self.find(views[index])
            self._remember(views[index], self.registrations[index])

    @property
    def worst_fit(self) -> float:
        return min(registration.fit for registration in self.registrations)

    def find(self, view: View) -> Registration:
        """Where the object is in ``view``."""
        inside = len(view.cell_points)
        similar = [t.view.descriptors.similarities(t.cells, view.descriptors, view.cells) for t in self.templates]
        likeness = np.array([table[:, :inside].max(axis=1).mean() for table in similar])
        motions = proposals(
            np.concatenate([template.points for template in self.templates]),
            view.cell_points,
            np.concatenate(similar)[:, :inside],
        )
        index = int(likeness.argmax())
        pose, fit, agreement = polish(
            motions, self.templates[index].painted, view.painted, lambda m: self._agreements(m, view, similar)
        )
        return Registration(pose, fit, agreement, index)

    def residuals(self, views: Sequence[View], points: FloatArray) -> FloatArray:
        """Distance ``(I, N)`` in metres from where ``points (N, 3)`` of the first view should be to what is there."""
        pairs = zip(views, self.registrations, strict=True)
        return np.stack([cKDTree(v.cloud.points).query(transform_points(r.pose, points))[0] for v, r in pairs])

    def buddies(self, views: Sequence[View], points: FloatArray) -> FloatArray:
        """Share ``(N,)`` of ``views`` in which each of ``points (N, 3)`` has a best buddy near its place.

        Two descriptors are best buddies if each is the other's nearest neighbour (Amir et al. 2022). The points are
        places in the first view.
        """
        home = views[0]
        cells = home.cells[: len(home.cell_points)]
        mine = cKDTree(home.cell_points).query(points)[1]
        reach = BUDDY_PATCHES * home.patch_size
        votes = np.zeros(len(points))
        for view, registration in zip(views[1:], self.registrations[1:], strict=True):
            similar = home.descriptors.similarities(cells, view.descriptors, view.cells[: len(view.cell_points)])
            there = similar.argmax(axis=1)
            back = similar.argmax(axis=0)[there]
            cycle = np.linalg.norm(home.cell_points[back] - home.cell_points, axis=1) < reach
            expected = transform_points(registration.pose, home.cell_points)
            near = np.linalg.norm(view.cell_points[there] - expected, axis=1) < reach
            votes += (cycle & near)[mine]
        return votes / max(len(views) - 1, 1) if len(views) > 1 else np.ones(len(points))

    def _remember(self, view: View, registration: Registration, points: Float32Array | None = None) -> None:
        back = invert_pose(registration.pose)
        known = points if points is not None else self.templates[registration.template].painted
        if points is None:
            carried = np.concatenate([transform_points(back, view.painted[:, :3]), view.painted[:, 3:]], axis=1)
            points = carried[cKDTree(known[:, :3]).query(carried[:, :3])[0] < SAME_OBJECT_M].astype(np.float32)
        if len(points) == 0:
            return
        points = points[thin(np.arange(len(points)), MAX_OBJECT_POINTS, self._seed)]
        local = transform_points(back, view.cell_points)
        inside = np.flatnonzero(cKDTree(known[:, :3]).query(local)[0] < SAME_OBJECT_M)
        inside = thin(inside, MAX_OBJECT_CELLS, self._seed)
        self.templates.append(Template(view, points, view.cells[inside], local[inside]))

    def _agreements(self, motions: FloatArray, view: View, similar: list[Float32Array]) -> FloatArray:
        """For each motion, how similar the descriptors are where it puts them: the mean of the best templates."""
        column = np.full(view.descriptors.grid[0] * view.descriptors.grid[1], len(view.cells))
        column[view.cells] = np.arange(len(view.cells))
        padded = np.pad(np.concatenate(similar), ((0, 0), (0, 1)))  # far from all foreground nothing agrees
        points = np.concatenate([template.points for template in self.templates])
        sizes = np.array([len(template.points) for template in self.templates])
        starts = np.cumsum([0, *sizes[:-1]])
        moved = points @ np.swapaxes(motions[:, :3, :3], 1, 2) + motions[:, None, :3, 3]
        pixels = project(moved.reshape(-1, 3), view.observation.intrinsics, view.observation.camera_pose)
        cells, shares = view.descriptors.around(pixels)
        rows = np.tile(np.arange(len(points)), len(motions))[:, None]
        values = (padded[rows, column[cells]] * shares).sum(axis=1).reshape(len(motions), -1)
        means = np.add.reduceat(values, starts, axis=1) / sizes
        return np.sort(means, axis=1)[:, -BEST_VIEWS:].mean(axis=1)


def moving_objects(views: Sequence[View], min_points: int, seed: int) -> list[MovingObject]:
    """The connected pieces of the first view that are large enough, found in all the others."""
    cloud = views[0].cloud
    result = []
    for piece in np.unique(cloud.pieces):
        members = np.flatnonzero(cloud.pieces == piece)
        points = painted(cloud.points[members], cloud.colours[members])[
            thin(np.arange(len(members)), MAX_OBJECT_POINTS, seed)
        ]
        if len(points) < min_points:
            continue
        result.append(MovingObject(views, points, seed))
    return result


def thin(indices: IntArray, count: int, seed: int) -> IntArray:
    """At most ``count`` of ``indices``, drawn evenly."""
    if len(indices) <= count:
        return indices
    return np.sort(np.random.default_rng(seed).choice(indices, count, replace=False))
