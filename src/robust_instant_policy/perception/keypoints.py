"""K points that all demonstrations share, and their places in a new image (Oh et al. 2025, Sec. III-A)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import InvalidValueError, KeypointError, UnknownNameError
from robust_instant_policy.geometry import FloatArray, project, transform_points
from robust_instant_policy.perception.depth import MAX_LIFT_M, lift_to_surface
from robust_instant_policy.perception.descriptors import DescriptorNetwork
from robust_instant_policy.perception.matching import certainty, find_again, plausibility, register_all
from robust_instant_policy.perception.models import (
    MAX_MISSING,
    MIN_FITNESS,
    SAME_THING_FITNESS,
    Registration,
    RigidObject,
)
from robust_instant_policy.perception.nearest import Image, SharedDescriptors, share_descriptors
from robust_instant_policy.perception.network import choose_network
from robust_instant_policy.perception.objects import find_objects, segmentation, without
from robust_instant_policy.perception.registration import MAX_STRETCH, RESIDUAL_M, register_translation
from robust_instant_policy.perception.relevance import hand_places, reference, relevances, shares, still
from robust_instant_policy.perception.selection import best_buddies, select_points
from robust_instant_policy.perception.settings import DescriptorSettings, paper_settings
from robust_instant_policy.perception.view import Hands, View, make_view
from robust_instant_policy.trajectory import Trajectory

CORRESPONDENCES = ("registration", "nearest")
SAME_SHAPE_FITNESS = 0.7  # from which keypoints need no registration of their own
OTHER_SIZE = 2.0  # times as far may the surface be from where it is expected, if objects differ in size
SCENERY_WEIGHT = 0.2  # of what never moves, beside what does
HAND_SHOWN = 0.8  # share of the images from which on what lies at the start of the path is a hand
NEIGHBOURHOOD_M = 0.04  # around a keypoint, for a registration of its own


P = ParamSpec("P")
T = TypeVar("T")


# Registration multiplies many small matrices: threads of BLAS wait for each other there, at three times the time.
def one_blas_thread(method: Callable[P, T]) -> Callable[P, T]:
    @wraps(method)
    def limited(*arguments: P.args, **options: P.kwargs) -> T:
        with threadpool_limits(limits=1, user_api="blas"):
            return method(*arguments, **options)

    return limited


@dataclass(frozen=True, eq=False)
class Located:
    """Keypoints of one image: ``keypoints (K, 3)`` metres, world; ``pixels (K, 2)`` (u, v);
    ``confidence (K,)`` in [0, 1]; ``notes`` tell what was unusual, one line each; ``doubled``: the numbers of objects
    with keypoints of which the image shows a second thing of the same look.
    """

    keypoints: FloatArray
    pixels: FloatArray
    confidence: FloatArray
    notes: tuple[str, ...] = ()
    doubled: tuple[int, ...] = ()


class KeypointExtractor:
    """Finds K keypoints that all demonstrations share, and the same ones in new images.

    ``num_keypoints``: K. ``features``: see `choose_network`. ``workspace (2, 3)``: lower and upper corner in metres,
    world; points outside are ignored. ``settings``: by default the paper's for images of the first one's size.
    ``correspondence``: "registration" of objects, or "nearest" as published: best buddies and nearest neighbours (see
    `perception.nearest`), which uses no workspace. Deterministic for a ``seed``.

    After `fit`: ``keypoints_ (I, K, 3)`` metres, world, ``pixels_ (I, K, 2)`` (u, v) and ``confidence_ (I, K)`` in
    [0, 1] of I demonstrations; ``left_out_ (I,)``, those that do not show an object with keypoints, which are guessed
    there; ``network_`` and its name, ``descriptor_name_``; ``objects_``; ``object_of_ (K,)``, the number of each
    keypoint's; ``segmentations_``, see `segmentation`; ``notes_`` for the user, one line each.
    """

    def __init__(
        self,
        num_keypoints: int = 10,
        features: str | DescriptorNetwork = "auto",
        workspace: ArrayLike | None = None,
        seed: int = 0,
        settings: DescriptorSettings | None = None,
        correspondence: str = "registration",
    ):
        if correspondence not in CORRESPONDENCES:
            raise UnknownNameError("correspondence", correspondence, CORRESPONDENCES)
        if num_keypoints < 1:
            raise InvalidValueError(f"num_keypoints must be at least 1, got {num_keypoints}")
        self.num_keypoints = num_keypoints
        self.features = features
        self.workspace = None if workspace is None else np.asarray(workspace, dtype=np.float64).reshape(2, 3)
        self.seed = seed
        self.settings = settings
        self.correspondence = correspondence
        self._shared: SharedDescriptors | None = None

    @one_blas_thread
    def fit(
        self, observations: Sequence[Observation], trajectories: Sequence[Trajectory] | None = None
    ) -> KeypointExtractor:
        """Choose keypoints and find them in ``observations``, the demonstrations' first images.

        With the demonstrations' ``trajectories`` the keypoints lie on what the hand approaches, grasps or moves
        relative to, otherwise on all objects (and always with nearest neighbours). Raises `KeypointError` where the
        images have too little in common, depth or foreground are missing, or paths do not belong to them.
        """
        if not observations:
            raise KeypointError("no demonstrations were given; record at least one")
        if trajectories is not None:
            _check_paths(observations, trajectories)
        settings = self.settings or paper_settings(*observations[0].rgb.shape[:2])
        self.network_, note = choose_network(self.features, settings)
        self.descriptor_name_ = self.network_.name
        if self.correspondence == "nearest":
            return self._fit_nearest(observations, note)
        self._hands = Hands.at_start(trajectories) if trajectories else None
        views = [self._view(observation) for observation in observations]
        shown = np.mean([view.shows_hand for view in views])
        if 0 < shown < HAND_SHOWN:  # an arm that is parked in view is there in all images: these are things
            self._hands = None
            views = [self._view(observation) for observation in observations]
        notes = [note, *dict.fromkeys(line for view in views for line in view.notes)]
        if len(views) == 1:
            notes.append(
                "one demonstration only: nothing to compare it with, so the keypoints are its most salient points"
            )
        if len({observation.rgb.shape for observation in observations}) > 1:
            notes.append("the images differ in size; each was brought to the same")
        order = list(range(len(views)))  # exchanges the first with the reference, and back
        hands = None
        if trajectories is not None:
            hands = hand_places(views, trajectories)
            first = reference(views, hands)
            order[0], order[first] = first, 0
            views, trajectories, hands = [views[i] for i in order], [trajectories[i] for i in order], hands[order]
        objects = find_objects(views, self.seed, hands)
        self.objects_ = without(objects, [not thing.shared for thing in objects])
        if not self.objects_:
            best = max((min(one.fitness for one in thing.registrations) for thing in objects), default=0.0)
            raise KeypointError(
                f"the images have nothing in common: the best object of one of them has a fitness of {best:.2f} in the "
                f"worst other image (needed: {MIN_FITNESS:.2f}); do all demonstrations show the same object?"
            )
        weights = _weights(self.objects_, views, trajectories)
        counts = shares(weights, self.num_keypoints)
        if (left := int(((weights > 0) & (np.array(counts) == 0)).sum())) > 0:
            notes.append(
                f"{len(self.objects_)} objects were found for {self.num_keypoints} keypoints; {left} of them have none"
            )
        with_keypoints = {i for number in np.flatnonzero(counts) for i in (number, self.objects_[number].model.parent)}
        # An object without keypoints that is hardly recognised would only claim points of other objects.
        dropped = [
            number not in with_keypoints and thing.typical_fitness < SAME_THING_FITNESS
            for number, thing in enumerate(self.objects_)
        ]
        self.objects_ = without(self.objects_, dropped)
        counts = [count for count, drop in zip(counts, dropped, strict=True) if not drop]
        self._places = []  # of each object's keypoints, in the first image
        buddies = best_buddies(views)
        for thing, count in zip(self.objects_, counts, strict=True):
            points, replaced = (
                select_points(thing, views, buddies, count, self.seed) if count else (np.zeros((0, 3)), [])
            )
            self._places.append(points)
            notes += replaced
        registrations = [[thing.registrations[i] for thing in self.objects_] for i in order]
        views = [views[i] for i in order]
        found = [self._locate(*pair) for pair in zip(views, registrations, strict=True)]
        self.keypoints_ = np.stack([located.keypoints for located in found])
        self.pixels_ = np.stack([located.pixels for located in found])
        self.confidence_ = np.stack([located.confidence for located in found])
        self.object_of_ = np.repeat(np.arange(len(counts)), counts)
        missing = ~np.array([thing.shown[order] for thing in self.objects_])  # (O, I)
        missing[np.array(counts) == 0] = False
        self.left_out_: NDArray[np.bool_] = np.asarray(missing.any(axis=0))
        if self.left_out_.mean() > MAX_MISSING:
            raise KeypointError(
                f"{self.left_out_.sum()} of {len(views)} demonstrations lack one of the objects with keypoints; "
                "record them with all objects in view"
            )
        for number, i in np.argwhere(missing):
            notes.append(
                f"demonstration {i} is left out: object {number}, which has keypoints, is missing there, hidden, or of "
                "another look"
            )
        models = [thing.model for thing in self.objects_]
        self.segmentations_ = tuple(
            segmentation(models, own, view) for own, view in zip(registrations, views, strict=True)
        )
        self.notes_ = tuple(notes)
        return self

    def _fit_nearest(self, observations: Sequence[Observation], note: str) -> KeypointExtractor:
        images = [Image.of(observation, self.network_) for observation in observations]
        self._shared, notes = share_descriptors(images, self.num_keypoints, self.seed)
        self.objects_, self.segmentations_, self.object_of_ = [], (), np.full(self.num_keypoints, -1)
        self.notes_ = (note, *notes)
        found = [
            (image.points(cells), image.pixels(cells)) for image, cells in zip(images, self._shared.cells, strict=True)
        ]
        self.keypoints_, self.pixels_ = (np.stack(of_images) for of_images in zip(*found, strict=True))
        self.confidence_ = self._shared.agreement()
        self.left_out_ = np.zeros(len(images), dtype=bool)
        return self

    @one_blas_thread
    def locate(self, observation: Observation) -> Located:
        """The keypoints in a new image.

        Raises `KeypointError` where depth or foreground are missing.
        """
        if self._shared is not None:
            image = Image.of(observation, self.network_)
            cells, similarity = self._shared.find(image)
            return Located(image.points(cells), image.pixels(cells), similarity)
        view = self._view(observation)
        models = [thing.model for thing in self.objects_]
        registrations = register_all(models, view)
        located = self._locate(view, registrations)
        notes, doubled = list(located.notes), []
        chosen = [number for number, places in enumerate(self._places) if len(places)]
        for number, second in find_again(models, registrations, view, chosen).items():
            doubled.append(number)
            place = transform_points(second.motion, models[number].points.mean(axis=0))
            col, row = project(place[None], view.observation.intrinsics, view.observation.camera_pose)[0]
            notes.append(
                f"warning: a second thing, at pixel ({col:.0f}, {row:.0f}), looks like object {number}, which has "
                "keypoints: take it away if it is not the one that is meant"
            )
        return replace(located, notes=tuple(notes), doubled=tuple(doubled))

    def _view(self, observation: Observation) -> View:
        return make_view(observation, self.network_, self.workspace, self.seed, self._hands)

    def _locate(self, view: View, registrations: Sequence[Registration]) -> Located:
        """The keypoints of objects with known ``registrations`` in ``view``."""
        triples = list(zip(self.objects_, self._places, registrations, strict=True))
        expected = np.concatenate([_expected_places(view, *triple) for triple in triples])
        counts = [len(places) for places in self._places]
        # An object of another size has its surface further from where it is expected.
        size_factor = np.repeat([OTHER_SIZE if t.model.varies else 1.0 for t in self.objects_], counts)
        points, pixels, measured = lift_to_surface(view.observation, view.depth, expected, MAX_LIFT_M * size_factor)
        quality = [found.fitness * found.similarity * plausibility(t.model, found, view) for t, _, found in triples]
        confidence = np.repeat(quality, counts)
        confidence *= np.concatenate(
            [certainty(t.model, found, view, places) for t, places, found in triples if len(places)]
        )
        confidence *= np.exp(-((points - expected) ** 2).sum(axis=1) / (RESIDUAL_M * size_factor) ** 2)
        confidence[~measured] /= 2
        notes = list(view.notes)
        for k in np.flatnonzero(~measured):
            notes.append(f"keypoint {k} has no depth at its pixel; it is where its object says")
        for number, found in enumerate(registrations):
            if found.fitness < MIN_FITNESS and counts[number]:
                share = f"{counts[number]} of {sum(counts)} keypoints"
                notes.append(f"object {number}, with {share}, was hardly recognised (fit {found.fitness:.2f})")
        return Located(transform_points(view.to_world, points), pixels, np.clip(confidence, 0, 1), tuple(notes))


def _check_paths(observations: Sequence[Observation], trajectories: Sequence[Trajectory]) -> None:
    if len(observations) != len(trajectories):
        raise KeypointError(f"{len(observations)} images and {len(trajectories)} paths were given; give one of each")
    if len(arms := sorted({path.num_arms for path in trajectories})) > 1:
        raise KeypointError(f"paths of {' and '.join(map(str, arms))} arms are mixed; keep demonstrations of one kind")


def _weights(
    things: Sequence[RigidObject], views: Sequence[View], trajectories: Sequence[Trajectory] | None
) -> FloatArray:
    """Of objects ``(O,)``, for their numbers of keypoints."""
    places = [
        [
            transform_points(view.to_world @ found.motion, thing.points) if shown else None
            for view, found, shown in zip(views, thing.registrations, thing.shown, strict=True)
        ]
        for thing in things
    ]
    if trajectories is not None:
        relevant = relevances(places, trajectories)
        if relevant.any():
            return relevant * np.array([thing.typical_fitness for thing in things])
    sizes = np.array([len(thing.points) for thing in things], dtype=np.float64)
    weights = 1 + sizes / (1e3 * sizes.max())  # equal, but with too few keypoints the largest come first
    scenery = np.array([still([one for one in points if one is not None]) for points in places])
    return weights if scenery.all() else np.where(scenery, weights * SCENERY_WEIGHT, weights)


def _expected_places(view: View, thing: RigidObject, places: FloatArray, found: Registration) -> FloatArray:
    """Where ``places (k, 3)`` of an object in the first image are in ``view``, metres, world."""
    expected = transform_points(found.motion, places)
    lowest, highest = thing.points[:, 2].min(), thing.points[:, 2].max()
    lift = found.motion[2, 3]  # of its top; unless the whole thing is lifted, its base stays on the table
    if thing.model.varies and thing.model.parent < 0 and abs(lift) < (MAX_STRETCH - 1) * (highest - lowest):
        expected[:, 2] -= lift * ((highest - places[:, 2]) / (highest - lowest)).clip(0, 1)
    if thing.model.varies or found.fitness >= SAME_SHAPE_FITNESS:
        return expected
    # An object of another size or articulation: register the neighbourhood of each keypoint.
    template = thing.model.templates[0].xyzrgb
    for k, place in enumerate(places):
        source = template[np.linalg.norm(template[:, :3] - place, axis=1) < NEIGHBOURHOOD_M]
        target = view.target[np.linalg.norm(view.target[:, :3] - expected[k], axis=1) < 2 * NEIGHBOURHOOD_M]
        if len(target):
            expected[k] += register_translation(found.motion, source, target)
    return expected
