"""The context [V, A] of the demonstrations (Oh et al. 2025, Sec. III-A), and a new scene's keypoints V'."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from robust_instant_policy.context import Prompt, leave_one_out, write_prompt
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.perception import KeypointExtractor, Located
from robust_instant_policy.policies.confidence import recognition
from robust_instant_policy.policies.policy import Progress, Stage, Stopwatch, no_progress
from robust_instant_policy.policies.settings import Settings
from robust_instant_policy.sanity import Finding, SetReport, check_demonstrations
from robust_instant_policy.trajectory import Trajectory, downsample

HARDLY_RECOGNISED = "the scene was hardly recognised; is everything there that was there in the demonstrations?"


@dataclass(frozen=True, eq=False)
class Context:
    """What every method over keypoints starts from, made from ``demonstrations``.

    ``keypoints (I, K, 3)``, metres, world, and ``pixels (I, K, 2)`` (u, v) of the I demonstrations; their downsampled
    ``trajectories``; the ``prompt`` that serialises both; the ``report`` of what was checked; ``prediction_errors
    (I, S)`` in metres, see `leave_one_out`; ``notes`` for the user, one line each.
    """

    demonstrations: tuple[Demonstration, ...]
    extractor: KeypointExtractor
    keypoints: FloatArray
    pixels: FloatArray
    trajectories: tuple[Trajectory, ...]
    prompt: Prompt
    report: SetReport
    prediction_errors: FloatArray
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class LocatedScene:
    """What was recognised in one observation, what its checks found, and what both cost."""

    located: Located
    stage: Stage
    findings: tuple[Finding, ...] = ()

    @property
    def keypoints(self) -> FloatArray:
        """``(K, 3)``, metres, world."""
        return self.located.keypoints

    @property
    def notes(self) -> tuple[str, ...]:
        """For the user, one line each."""
        hardly = (HARDLY_RECOGNISED,) if recognition(self.located.confidence) < 1 else ()
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
    extractor = KeypointExtractor(
        settings.num_keypoints, settings.features, workspace=settings.workspace, seed=settings.seed
    ).fit(
        [demonstration.observation for demonstration in demonstrations],
        [demonstration.trajectory for demonstration in demonstrations],
    )
    trajectories = tuple(
        downsample(demonstration.trajectory, settings.downsampling, settings.num_steps)
        for demonstration in demonstrations
    )
    prompt = write_prompt(extractor.keypoints_, trajectories, settings.frames, settings.layout)
    return Context(
        tuple(demonstrations),
        extractor,
        extractor.keypoints_,
        extractor.pixels_,
        trajectories,
        prompt,
        report,
        leave_one_out(extractor.keypoints_, trajectories, prompt.frames if settings.frames == "adaptive" else None),
        (*extractor.notes_, *report.notes),
    )


def locate(context: Context, observation: Observation, progress: Progress = no_progress) -> LocatedScene:
    """Check ``observation`` against the demonstrations and find the keypoints in it.

    Raises `GeometryError` where it contradicts them and `KeypointError` where the scene cannot be recognised.
    """
    progress("keypoints", 0, 0)
    watch = Stopwatch()
    with watch.stage("keypoints"):
        findings = context.report.require_observation(observation)
        located = context.extractor.locate(observation)
    return LocatedScene(located, watch.stages[0], findings)
