"""The context [V, A] of the demonstrations (Oh et al. 2025, Sec. III-A), and a new scene's keypoints V'."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robust_instant_policy.context import Prompt, leave_one_out, write_prompt
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import UsageError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.gripper_changes import Pace
from robust_instant_policy.perception import CORRESPONDENCES, KeypointExtractor, Located
from robust_instant_policy.policies.confidence import recognition
from robust_instant_policy.policies.own_keypoints import OwnKeypoints
from robust_instant_policy.policies.policy import Progress, Stage, Stopwatch, no_progress
from robust_instant_policy.policies.settings import Settings
from robust_instant_policy.sanity import Envelope, Finding, SetReport, Surroundings, View, check_demonstrations
from robust_instant_policy.trajectory import Trajectory, downsample

HORIZONTAL = np.array([0.0, 0.0, 1.0, 0.0])  # plane through the world's origin
HARDLY_RECOGNISED = "the scene was hardly recognised; is everything there that was there in the demonstrations?"


@dataclass(frozen=True, eq=False)
class Context:
    """What every method over keypoints starts from, made from N ``demonstrations``.

    ``keypoints (I, K, 3)``, metres, world, and downsampled ``trajectories`` of those I that show all objects with
    keypoints; ``pixels (N, K, 2)`` (u, v) of all (no pixels, and no ``extractor``, where the keypoints were given); the
    ``prompt`` that serialises both; the ``report`` of what was checked; the ``surroundings`` of the
    gripper; ``prediction_errors (I, S)`` in metres, see `leave_one_out`; ``notes`` for the user, one line each; the
    ``pace`` of demonstrations whose rate is known.
    """

    demonstrations: tuple[Demonstration, ...]
    extractor: KeypointExtractor | OwnKeypoints | None
    keypoints: FloatArray
    pixels: FloatArray
    trajectories: tuple[Trajectory, ...]
    prompt: Prompt
    report: SetReport
    surroundings: Surroundings
    prediction_errors: FloatArray
    notes: tuple[str, ...]
    pace: Pace | None = None


@dataclass(frozen=True, eq=False)
class LocatedScene:
    """What was recognised in one observation, what its checks found, and what both cost.

    ``view`` is the observation as the checks see it; None where only keypoints are known. ``recognition`` is how far
    the scene was recognised, in [0, 1].
    """

    located: Located
    stage: Stage
    findings: tuple[Finding, ...] = ()
    view: View | None = None
    recognition: float = 1.0

    @property
    def keypoints(self) -> FloatArray:
        """``(K, 3)``, metres, world."""
        return self.located.keypoints

    @property
    def notes(self) -> tuple[str, ...]:
        """For the user, one line each."""
        hardly = (HARDLY_RECOGNISED,) if self.recognition < 1 else ()
        return (*map(str, self.findings), *self.located.notes, *hardly)


def build_context(
    demonstrations: Sequence[Demonstration], settings: Settings, progress: Progress = no_progress
) -> Context:
    """Check ``demonstrations``, find the keypoints that they share and serialise them.

    Raises `DatasetError` without demonstrations, `GeometryError` or `DemonstrationError` where they contradict
    themselves (`check_demonstrations`), and `KeypointError` where images have too little in common.
    """
    report = check_demonstrations(demonstrations)
    report.raise_if_wrong()
    progress("keypoints", 0, 0)
    extractor = _extractor(demonstrations, settings)
    kept = [i for i, left_out in enumerate(extractor.left_out_) if not left_out]
    trajectories = [demonstrations[i].trajectory for i in kept]
    observations = [demonstrations[i].observation for i in kept]
    return _context(extractor.keypoints_[kept], trajectories, settings, report, observations, demonstrations, extractor)


def _extractor(demonstrations: Sequence[Demonstration], settings: Settings) -> KeypointExtractor | OwnKeypoints:
    if settings.keypoints not in CORRESPONDENCES:
        return OwnKeypoints(settings.keypoints).fit(demonstrations)
    return KeypointExtractor(
        settings.num_keypoints,
        settings.features,
        settings.workspace,
        settings.seed,
        settings.descriptors,
        str(settings.keypoints),
    ).fit([one.observation for one in demonstrations], [one.trajectory for one in demonstrations])


def context_of_keypoints(keypoints: FloatArray, trajectories: Sequence[Trajectory], settings: Settings) -> Context:
    """The context of demonstrations whose ``keypoints (I, K, 3)``, metres, world, are known.

    There are no images to check; a plan is still held against the envelope of ``trajectories``.
    """
    report = SetReport((), Envelope.of(trajectories, HORIZONTAL), None)
    return _context(keypoints, trajectories, settings, report)


def _context(
    keypoints: FloatArray,
    trajectories: Sequence[Trajectory],
    settings: Settings,
    report: SetReport,
    observations: Sequence[Observation] = (),
    demonstrations: Sequence[Demonstration] = (),
    extractor: KeypointExtractor | OwnKeypoints | None = None,
) -> Context:
    """Thin the ``trajectories`` out and serialise them with their ``keypoints``. ``observations`` are the images of
    these; ``demonstrations`` are all, also those that were left out.
    """
    thinned = tuple(downsample(one, settings.downsampling, settings.num_steps) for one in trajectories)
    prompt = write_prompt(keypoints, thinned, settings.frames, settings.layout)
    aligned = prompt.aligned
    views = [View.of(observations[index]) for index in aligned.kept] if observations else []
    return Context(
        tuple(demonstrations),
        extractor,
        keypoints,
        np.zeros((len(keypoints), 0, 2)) if extractor is None else extractor.pixels_,
        thinned,
        prompt,
        report,
        Surroundings.of(views, aligned.actions),
        leave_one_out(prompt),
        (*(() if extractor is None else extractor.notes_), *report.notes, *prompt.notes()),
        Pace.of(demonstrations) if demonstrations else None,
    )


def scene_of_keypoints(keypoints: FloatArray) -> LocatedScene:
    """A scene whose ``keypoints (K, 3)``, metres, world, are known and certain."""
    count = len(keypoints)
    return LocatedScene(Located(keypoints, np.zeros((count, 2)), np.ones(count)), Stage("keypoints", 0.0))


def locate(context: Context, observation: Observation, progress: Progress = no_progress) -> LocatedScene:
    """Check ``observation`` against the demonstrations and find the keypoints in it.

    Raises `GeometryError` where it contradicts them and `KeypointError` where the scene cannot be recognised.
    """
    if context.extractor is None:
        raise UsageError("the keypoints of the demonstrations were given; plan with plan_scene(scene_of_keypoints(…))")
    progress("keypoints", 0, 0)
    watch = Stopwatch()
    with watch.stage("keypoints"):
        findings = context.report.require_observation(observation)
        located = context.extractor.locate(observation)
    extractor = context.extractor
    shown = extractor.confidence_[~extractor.left_out_]
    recognised = recognition(shown, located.confidence, extractor.object_of_)
    return LocatedScene(located, watch.stages[0], findings, View.of(observation), recognised)
