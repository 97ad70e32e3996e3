"""The K points that all demonstrations share, and where they are in a new image (Oh et al. 2025, Sec. III-A)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import InvalidValueError, KeypointError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.perception.cloud import foreground
from robust_instant_policy.perception.descriptors import DescriptorNetwork
from robust_instant_policy.perception.network import choose_network
from robust_instant_policy.perception.objects import MovingObject, Registration, View, moving_objects
from robust_instant_policy.perception.registration import NEAR_M, local_shift
from robust_instant_policy.perception.selection import lifted, select
from robust_instant_policy.perception.settings import DescriptorSettings, paper_settings

MIN_FIT = 0.15  # share of an object's points that must be explained in every demonstration
MIN_OBJECT_POINTS = 25
SAME_SHAPE = 0.7  # fit from which an object is the reference's own shape, so that keypoints need no following
PATCH_M = 0.04  # around a keypoint that must match for it to follow
OFF_CENTRE = 0.4  # of half the image; no lens is mounted that far off


@dataclass(frozen=True, eq=False)
class Located:
    """Keypoints of one image: ``keypoints (K, 3)`` metres, world; ``pixels (K, 2)`` (u, v);
    ``confidence (K,)`` in [0, 1]; ``notes`` say what was unusual.
    """

    keypoints: FloatArray
    pixels: FloatArray
    confidence: FloatArray
    notes: tuple[str, ...] = ()


def check_intrinsics(observation: Observation) -> None:
    """Raise `KeypointError` where the optical axis is far from the image's middle, as with another resolution's."""
    height, width = observation.depth.shape
    cx, cy = observation.intrinsics[:2, 2]
    if not (abs(cx / (width / 2) - 1) < OFF_CENTRE and abs(cy / (height / 2) - 1) < OFF_CENTRE):
        raise KeypointError(
            f"the intrinsics belong to an image of about {2 * cx:.0f}x{2 * cy:.0f} pixels, but this one has "
            f"{width}x{height}; scale them to it"
        )


class KeypointExtractor:
    """Finds keypoints that all demonstrations share, and finds the same ones in new images.

    ``num_keypoints``: K. ``features``: see `choose_network`. ``workspace (2, 3)``: lower and upper
    corner in metres, world; points outside are not looked at. Without ``settings``, the paper's for images of the
    first one's size. Deterministic for a ``seed``.

    After `fit`: ``keypoints_ (I, K, 3)`` metres, world; ``pixels_ (I, K, 2)`` (u, v); ``descriptor_name_``;
    ``notes_``, one line each about anything a user should know.

    Raises `KeypointError` when the images have too little in common or depth is missing.
    """

    def __init__(
        self,
        num_keypoints: int = 10,
        features: str | DescriptorNetwork = "auto",
        workspace: ArrayLike | None = None,
        seed: int = 0,
        settings: DescriptorSettings | None = None,
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
        settings = self.settings or paper_settings(*observations[0].rgb.shape[:2])
        self._network, note = choose_network(self.features, settings)
        self.descriptor_name_ = self._network.name
        notes = [note]
        views = []
        for observation in observations:
            view, note = self._view(observation)
            views.append(view)
            if note and note not in notes:
                notes.append(note)
        if len(views) == 1:
            notes.append(
                "one demonstration only: nothing to compare it with, so the keypoints are its most salient points"
            )
        if len({observation.rgb.shape for observation in observations}) > 1:
            notes.append("the images differ in size; each was brought to the same")
        self._objects = self._shared(views)
        if len(self._objects) > self.num_keypoints:
            notes.append(
                f"{len(self._objects)} objects were found for {self.num_keypoints} keypoints; the largest have one each"
            )
            by_size = sorted(self._objects, key=lambda thing: len(thing.templates[0].painted), reverse=True)
            self._objects = by_size[: self.num_keypoints]
        owner: list[int] = []
        places = []
        for number, thing in enumerate(self._objects):
            share = self.num_keypoints // len(self._objects) + (number < self.num_keypoints % len(self._objects))
            points, replaced = select(thing, views, share, self.seed)
            owner += [number] * share
            places.append(points)
            notes += replaced
        self._owner, self._places = np.array(owner, dtype=np.intp), np.concatenate(places)
        found = [self._place(view, [t.registrations[i] for t in self._objects]) for i, view in enumerate(views)]
        self.keypoints_ = np.stack([located.keypoints for located in found])
        self.pixels_ = np.stack([located.pixels for located in found])
        self.notes_ = tuple(notes)
        return self

    def locate(self, observation: Observation) -> Located:
        """The keypoints in a new image.

        Raises `KeypointError` for an image in which nothing stands out, or without depth.
        """
        view, note = self._view(observation)
        located = self._place(view, [thing.find(view) for thing in self._objects])
        return replace(located, notes=(note, *located.notes)) if note else located

    def _place(self, view: View, registrations: list[Registration]) -> Located:
        """The keypoints of objects that were found in ``view``."""
        poses = np.stack([registrations[number].pose for number in self._owner])
        expected = (poses[:, :3, :3] @ self._places[..., None])[..., 0] + poses[:, :3, 3]
        for k, number in enumerate(self._owner):
            if registrations[number].fit < SAME_SHAPE:
                template = self._objects[number].templates[0].painted
                patch = template[np.linalg.norm(template[:, :3] - self._places[k], axis=1) < PATCH_M]
                near = view.painted[np.linalg.norm(view.painted[:, :3] - expected[k], axis=1) < 2 * PATCH_M]
                if len(near):
                    expected[k] += local_shift(poses[k], patch, near)
        points, pixels, hanging = lifted(view, expected)
        belief = np.array([(r.fit + r.agreement) / 2 for r in registrations])[self._owner]
        confidence = belief * np.exp(-(((points - expected) ** 2).sum(axis=1)) / NEAR_M**2)
        confidence[hanging] /= 2
        notes = [f"keypoint {k} has no depth at its pixel; it is where its object says" for k in hanging]
        for number, registration in enumerate(registrations):
            if registration.fit < MIN_FIT:
                notes.append(f"object {number} was hardly recognised (fit {registration.fit:.2f})")
        return Located(points, pixels, np.clip(confidence, 0, 1), tuple(notes))

    def _view(self, observation: Observation) -> tuple[View, str]:
        check_intrinsics(observation)
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
