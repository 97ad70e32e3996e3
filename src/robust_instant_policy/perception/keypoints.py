"""The K points that all demonstrations share, and where they are in a new image (Oh et al. 2025, Sec. IV-A)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import InvalidValueError, KeypointError
from robust_instant_policy.geometry import FloatArray, project, transform_points
from robust_instant_policy.perception.cloud import foreground
from robust_instant_policy.perception.descriptors import IntArray
from robust_instant_policy.perception.network import choose_network
from robust_instant_policy.perception.objects import MovingObject, View, moving_objects
from robust_instant_policy.perception.settings import PAPER_SIMULATION, DescriptorSettings

MIN_FIT = 0.15  # share of an object's points that must be explained in every demonstration
MIN_OBJECT_POINTS = 25


@dataclass(frozen=True, eq=False)
class Located:
    """Keypoints of one image: ``keypoints (K, 3)`` metres, world; ``pixels (K, 2)`` (u, v);
    ``confidence (K,)`` in [0, 1]; ``notes`` say what was unusual.
    """

    keypoints: FloatArray
    pixels: FloatArray
    confidence: FloatArray
    notes: tuple[str, ...] = ()


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
        self._objects = self._shared(views)
        poses = [[registration.pose for registration in thing.registrations] for thing in self._objects]
        self._owner, self._model = self._choose(self._objects)
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
        found = [thing.find(view) for thing in self._objects]
        points = np.stack([transform_points(found[b].pose, p) for b, p in zip(self._owner, self._model, strict=True)])
        confidence = np.array([found[b].fit for b in self._owner])
        pixels = project(points, observation.intrinsics, observation.camera_pose)
        return Located(points, pixels, confidence, (note,) if note else ())

    def _view(self, observation: Observation) -> tuple[View, str]:
        descriptors = self._network.describe(observation.rgb)
        cloud, note = foreground(observation, descriptors, self._network.salient, self.workspace, self.seed)
        if len(cloud.points) < MIN_OBJECT_POINTS:
            raise KeypointError("nothing stands out from the table in an image; is the object in the workspace?")
        return View.from_cloud(observation, descriptors, cloud, self.seed), note

    def _shared(self, views: list[View]) -> list[MovingObject]:
        """The objects that all views show."""
        found = moving_objects(views, MIN_OBJECT_POINTS, self.seed)
        shared = [thing for thing in found if thing.worst_fit >= MIN_FIT]
        if not shared:
            best = max((thing.worst_fit for thing in found), default=0.0)
            raise KeypointError(
                f"the images have nothing in common: the best object of the first explains {best:.2f} of itself in the "
                f"worst other image (needed: {MIN_FIT:.2f}); do all demonstrations show the same object?"
            )
        return shared

    def _choose(self, objects: list[MovingObject]) -> tuple[IntArray, FloatArray]:
        """Keypoints shared out among the objects, spread over each by farthest-point sampling."""
        owner, model = [], []
        for number, thing in enumerate(objects):
            points = thing.templates[0].painted[:, :3].astype(np.float64)
            share = self.num_keypoints // len(objects) + (number < self.num_keypoints % len(objects))
            chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmin())]
            while len(chosen) < share:
                distance = np.linalg.norm(points[:, None] - points[chosen], axis=2).min(axis=1)
                chosen.append(int(distance.argmax()))
            owner += [number] * share
            model += [points[c] for c in chosen[:share]]
        return np.array(owner, dtype=np.intp), np.array(model)
