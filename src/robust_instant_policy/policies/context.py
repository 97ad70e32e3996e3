"""The context [V, A] of the demonstrations (Oh et al. 2025, Sec. III-A), and a new scene's keypoints V'."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from robust_instant_policy.context import Prompt, write_prompt
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.perception import KeypointExtractor, Located
from robust_instant_policy.policies.confidence import recognition
from robust_instant_policy.policies.policy import Progress, Stage, Stopwatch, no_progress
from robust_instant_policy.policies.settings import Settings
from robust_instant_policy.trajectory import Trajectory, downsample

HARDLY_RECOGNISED = "the scene was hardly recognised; is everything there that was there in the demonstrations?"


@dataclass(frozen=True, eq=False)
class Context:
    """What every method over keypoints starts from, made from ``demonstrations``.

    ``keypoints (I, K, 3)``, metres, world, and ``pixels (I, K, 2)`` (u, v) of the I demonstrations; their downsampled
    ``trajectories``; the ``prompt`` that serialises both; ``notes`` for the user, one line each.
    """

    demonstrations: tuple[Demonstration, ...]
    extractor: KeypointExtractor
    keypoints: FloatArray
    pixels: FloatArray
    trajectories: tuple[Trajectory, ...]
    prompt: Prompt
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class LocatedScene:
    """What was recognised in one observation, and what that cost."""

    located: Located
    stage: Stage

    @property
    def keypoints(self) -> FloatArray:
        """``(K, 3)``, metres, world."""
        return self.located.keypoints

    @property
    def notes(self) -> tuple[str, ...]:
        """For the user, one line each."""
        if recognition(self.located.confidence) < 1:
            return (*self.located.notes, HARDLY_RECOGNISED)
        return self.located.notes


def build_context(
    demonstrations: Sequence[Demonstration], settings: Settings, progress: Progress = no_progress
) -> Context:
    """Find the keypoints that ``demonstrations`` share and serialise them.

    Raises `DatasetError` without demonstrations, `KeypointError` where images have too little in common.
    """
    if not demonstrations:
        raise DatasetError("no demonstrations; show the task at least once (rip record)")
    # Checks of the demonstrations, as a set and against their images, belong here.
    progress("keypoints", 0, 0)
    extractor = KeypointExtractor(
        settings.num_keypoints, settings.features, workspace=settings.workspace, seed=settings.seed
    ).fit([demonstration.observation for demonstration in demonstrations])
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
        extractor.notes_,
    )


def locate(context: Context, observation: Observation, progress: Progress = no_progress) -> LocatedScene:
    """Find the keypoints in ``observation``. Raises `KeypointError` where the scene cannot be recognised."""
    # Checks of the observation against the demonstrations belong here.
    progress("keypoints", 0, 0)
    watch = Stopwatch()
    with watch.stage("keypoints"):
        located = context.extractor.locate(observation)
    return LocatedScene(located, watch.stages[0])
