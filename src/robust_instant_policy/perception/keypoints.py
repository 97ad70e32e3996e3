"""The K points that all demonstrations share, and where they are in a new image (Oh et al. 2025, Sec. IV-A)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import InvalidValueError, KeypointError
from robust_instant_policy.geometry import FloatArray, invert_pose, project, transform_points
from robust_instant_policy.perception.cloud import Cloud, foreground
from robust_instant_policy.perception.descriptors import NEIGHBOURS, DescriptorMap, Float32Array, IntArray
from robust_instant_policy.perception.network import choose_network
from robust_instant_policy.perception.registration import painted, polish, proposals
from robust_instant_policy.perception.settings import PAPER_SIMULATION, DescriptorSettings

MIN_FIT = 0.15  # share of an object's points that must be explained in every demonstration
MIN_OBJECT_POINTS = 25
MAX_OBJECT_POINTS = 300
MAX_PIECE_POINTS = 600
MAX_OBJECT_CELLS = 80
BEST_VIEWS = 3


@dataclass(frozen=True, eq=False)
class Located:
    """Keypoints of one image: ``keypoints (K, 3)`` metres, world; ``pixels (K, 2)`` (u, v);
    ``confidence (K,)`` in [0, 1]; ``notes`` say what was unusual.
    """

    keypoints: FloatArray
    pixels: FloatArray
    confidence: FloatArray
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _View:
    """One image, described."""

    observation: Observation
    descriptors: DescriptorMap
    cloud: Cloud
    painted: Float32Array  # an even choice of the cloud's points with their colours
    cells: IntArray  # cells with foreground in them, then the cells around those
    cell_points: FloatArray  # the mean points of the former


@dataclass(frozen=True, eq=False)
class Registration:
    """Where an object is in an image: ``pose (4, 4)`` from the reference image's world to the image's;
    ``fit`` of its points and ``agreement`` of its descriptors, in [0, 1].
    """

    pose: FloatArray
    fit: float
    agreement: float


@dataclass(eq=False)
class _Body:
    """What moves as one: points in the frame of the reference image, and the views that showed it."""

    points: FloatArray
    colours: Float32Array
    seen: list[tuple[_View, IntArray, FloatArray]]

    def find(self, view: _View) -> Registration:
        similar = np.concatenate(
            [other.descriptors.similarities(cells, view.descriptors, view.cells) for other, cells, _ in self.seen]
        )
        source = np.concatenate([points for _, _, points in self.seen])
        motions = proposals(source, view.cell_points, similar[:, : len(view.cell_points)])
        return Registration(
            *polish(
                motions,
                painted(self.points, self.colours),
                view.painted,
                lambda motions: np.array([self._agreement(motion, view, similar) for motion in motions]),
            )
        )

    def _agreement(self, motion: FloatArray, view: _View, similar: FloatArray) -> float:
        """Mean similarity of the object's descriptors with those where ``motion`` puts them, best demonstrations."""
        points = transform_points(motion, np.concatenate([points for _, _, points in self.seen]))
        pixels = project(points, view.observation.intrinsics, view.observation.camera_pose)
        column = np.full(view.descriptors.grid[0] * view.descriptors.grid[1], len(view.cells))
        column[view.cells] = np.arange(len(view.cells))
        padded = np.pad(similar, ((0, 0), (0, 1)))  # far from all foreground nothing agrees
        cells, shares = view.descriptors.around(pixels)
        value = (np.take_along_axis(padded, column[cells], axis=1) * shares).sum(axis=1)
        ends = np.cumsum([len(points) for _, _, points in self.seen])[:-1]
        means = sorted(float(part.mean()) for part in np.split(value, ends))
        return float(np.mean(means[-BEST_VIEWS:]))

    def remember(self, view: _View, registration: Registration, seed: int) -> None:
        """Add the cells of ``view`` in which the object lies to what it is recognised by."""
        back = invert_pose(registration.pose)
        local = transform_points(back, view.cell_points)
        distance, _ = cKDTree(self.points).query(local)
        inside = np.flatnonzero(distance < 0.015)
        if len(inside):
            inside = thin(inside, MAX_OBJECT_CELLS, seed)
            self.seen.append((view, view.cells[inside], local[inside]))


def thin(indices: IntArray, count: int, seed: int) -> IntArray:
    """At most ``count`` of ``indices``, drawn evenly."""
    if len(indices) <= count:
        return indices
    return np.sort(np.random.default_rng(seed).choice(indices, count, replace=False))


class KeypointExtractor:
    """Finds keypoints that all demonstrations share, and finds the same ones in new images.

    ``num_keypoints``: K. ``features``: see `choose_network`. ``workspace (2, 3)``: lower and upper
    corner in metres, world; points outside are not looked at. Deterministic for a ``seed``.

    After `fit`: ``keypoints_ (I, K, 3)`` metres, world; ``pixels_ (I, K, 2)`` (u, v); ``descriptor_name_``;
    ``notes_``, one line each about anything a user should know.

    Raises `KeypointError` when the images have too little in common or depth is missing.
    """

    def __init__(
        self,
        num_keypoints: int = 10,
        features: str = "auto",
        workspace: ArrayLike | None = None,
        seed: int = 0,
        settings: DescriptorSettings = PAPER_SIMULATION,
    ):
        if num_keypoints < 1:
            raise InvalidValueError(f"num_keypoints must be at least 1, got {num_keypoints}")
        self.num_keypoints = num_keypoints
        self.features = features
        self.workspace = None if workspace is None else np.asarray(workspace, dtype=np.float64).reshape(2, 3)
        self.seed = seed
        self.settings = settings

    def fit(self, observations: Sequence[Observation]) -> KeypointExtractor:
        if not observations:
            raise KeypointError("no demonstrations were given; record at least one")
        self._network, note = choose_network(self.features, self.settings)
        self.descriptor_name_ = self._network.name
        notes = [note]
        views = []
        for observation in observations:
            view, note = self._view(observation)
            views.append(view)
            if note and note not in notes:
                notes.append(note)
        bodies, poses = self._bodies(views)
        self._bodies_ = bodies
        self._owner, self._model = self._choose(bodies, poses)
        self.keypoints_ = np.stack(
            [
                np.stack([transform_points(poses[b][i], p) for b, p in zip(self._owner, self._model, strict=True)])
                for i in range(len(views))
            ]
        )
        self.pixels_ = np.stack(
            [
                project(points, view.observation.intrinsics, view.observation.camera_pose)
                for points, view in zip(self.keypoints_, views, strict=True)
            ]
        )
        self.notes_ = tuple(notes)
        return self

    def locate(self, observation: Observation) -> Located:
        """The keypoints in a new image."""
        view, note = self._view(observation)
        found = [body.find(view) for body in self._bodies_]
        points = np.stack([transform_points(found[b].pose, p) for b, p in zip(self._owner, self._model, strict=True)])
        confidence = np.array([found[b].fit for b in self._owner])
        pixels = project(points, observation.intrinsics, observation.camera_pose)
        return Located(points, pixels, confidence, (note,) if note else ())

    def _view(self, observation: Observation) -> tuple[_View, str]:
        descriptors = self._network.describe(observation.rgb)
        cloud, note = foreground(observation, descriptors, self._network.salient, self.workspace, self.seed)
        if len(cloud.points) < MIN_OBJECT_POINTS:
            raise KeypointError("nothing stands out from the table in an image; is the object in the workspace?")
        cells, inverse, counts = np.unique(cloud.cells, return_inverse=True, return_counts=True)
        sums = np.stack([np.bincount(inverse, cloud.points[:, axis]) for axis in range(3)], axis=1)
        kept = np.concatenate(
            [
                thin(np.flatnonzero(cloud.pieces == piece), MAX_PIECE_POINTS, self.seed)
                for piece in np.unique(cloud.pieces)
            ]
        )
        around = np.unique([descriptors.shifted(cells, row, col) for row, col in NEIGHBOURS])
        cells = np.concatenate([cells, np.setdiff1d(around, cells)])
        return _View(
            observation,
            descriptors,
            cloud,
            painted(cloud.points[kept], cloud.colours[kept]),
            cells,
            sums / counts[:, None],
        ), note

    def _bodies(self, views: list[_View]) -> tuple[list[_Body], list[list[FloatArray]]]:
        """The objects of the first image that are found in all others, with their poses in each."""
        reference = views[0]
        label = reference.cloud.pieces
        bodies, poses, best = [], [], 0.0
        for piece in np.unique(label):
            members = np.flatnonzero(label == piece)
            if len(members) < MIN_OBJECT_POINTS:
                continue
            members = thin(members, MAX_OBJECT_POINTS, self.seed)
            body = _Body(reference.cloud.points[members], reference.cloud.colours[members], [])
            body.remember(reference, Registration(np.eye(4), 1.0, 1.0), self.seed)
            found: dict[int, Registration] = {0: Registration(np.eye(4), 1.0, 1.0)}
            alone = {i: body.find(view) for i, view in enumerate(views) if i not in found}
            for index in sorted(alone, key=lambda i: -alone[i].fit - alone[i].agreement):
                found[index] = body.find(views[index])  # the surest first, so that they help with the others
                body.remember(views[index], found[index], self.seed)
            worst = min(registration.fit for registration in found.values())
            best = max(best, worst)
            if worst >= MIN_FIT:
                bodies.append(body)
                poses.append([found[i].pose for i in range(len(views))])
        if not bodies:
            raise KeypointError(
                f"the images have nothing in common: the best object of the first explains {best:.2f} of itself in the "
                f"worst other image (needed: {MIN_FIT:.2f}); do all demonstrations show the same object?"
            )
        return bodies, poses

    def _choose(self, bodies: list[_Body], poses: list[list[FloatArray]]) -> tuple[IntArray, FloatArray]:
        """Keypoints shared out among the bodies, spread over each by farthest-point sampling."""
        owner, model = [], []
        for number, body in enumerate(bodies):
            share = self.num_keypoints // len(bodies) + (number < self.num_keypoints % len(bodies))
            centre = body.points.mean(axis=0)
            chosen = [int(np.linalg.norm(body.points - centre, axis=1).argmin())]
            while len(chosen) < share:
                distance = np.linalg.norm(body.points[:, None] - body.points[chosen], axis=2).min(axis=1)
                chosen.append(int(distance.argmax()))
            owner += [number] * share
            model += [body.points[c] for c in chosen[:share]]
        return np.array(owner, dtype=np.intp), np.array(model)
