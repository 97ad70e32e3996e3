"""Failure analysis: which stage a failed episode failed in, found by replacing stages with the truth one by one.

The stages are checked in this order, and a failure counts for the first one that explains it:

- *execution*: the demonstrator's own trajectory for the scene, downsampled and executed like a plan, fails too;
- *keypoints*: with the true keypoints in place of those that perception found, the same method succeeds;
- *regression*: one of the candidates that were aggregated succeeds by itself;
- *samples*: none of them does, or the trajectory that failed is a single sample, not aggregated.

For a closed-loop policy only the execution is checked; other failures count as *policy*. A user's task may have no
demonstrator or no ground truth: checks that need them are left out, and a failure that only the ground truth could
attribute is *unknown*.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from robust_instant_policy.datasets.video import FILM_OPTIONS, VideoEncoder
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.evaluation.episodes import Episode, EpisodeKey
from robust_instant_policy.evaluation.rollout import ScenePolicy, execute
from robust_instant_policy.evaluation.variant import Scene, Variant
from robust_instant_policy.perception import KeypointExtractor, Located
from robust_instant_policy.perception.accuracy import KnownScene, measure
from robust_instant_policy.policies import ClosedLoopPolicy, Context, LocatedScene, Stage
from robust_instant_policy.policies.policy import UNPLANNABLE
from robust_instant_policy.tasks.task import FrameSink, Task, offers
from robust_instant_policy.trajectory import Trajectory, downsample

VIDEO_FOLDER = "videos"
STAGES = ("keypoints", "samples", "regression", "execution", "policy", "unknown")


@dataclass(frozen=True)
class Failure:
    """The ``stage`` to which a failed episode is attributed, and the results of the checks; None: not checked.

    ``demonstrator`` says whether the demonstrator's trajectory succeeds when played back, ``true_keypoints`` whether
    the method succeeds with the true keypoints, ``good_candidate`` whether one of the candidates that were aggregated
    does by itself; ``keypoint_error`` is the largest error, in metres, of a keypoint found on an object.
    """

    scene: Scene
    variant: Variant
    candidate: int
    stage: str
    demonstrator: bool | None
    true_keypoints: bool | None
    keypoint_error: float | None
    good_candidate: bool | None

    @property
    def key(self) -> EpisodeKey:
        return self.scene, self.variant, self.candidate


def video_file(scene: Scene, variant: Variant, candidate: int) -> str:
    """Path in a run's folder of the video of an episode."""
    return f"{VIDEO_FOLDER}/{scene}-{variant.file_name}-{candidate}.mp4"


@dataclass(frozen=True, eq=False)
class Truth:
    """The true keypoints of a scene; for keypoints on the background, the located ones.

    ``error`` is the largest distance, in metres, between a keypoint found on an object and the truth.
    """

    located: Located
    error: float


def true_keypoints(task: Task, seed: int, context: Context, shown_truth: Sequence[KnownScene]) -> Truth | None:
    """The true keypoints of ``context`` in the scene of ``seed``; None if they cannot be computed.

    ``shown_truth`` is the simulator's knowledge of the demonstrations' own scenes.
    """
    if context.extractor is None or not offers(task, "scene_truth"):
        return None
    observation = task.reset(seed)
    images = [demonstration.observation for demonstration in context.demonstrations]
    try:
        accuracy = measure(
            cast(KeypointExtractor, context.extractor), images, shown_truth, [observation], [task.scene_truth()]
        )
    except UNPLANNABLE:
        return None
    found, truth = accuracy.located[0], accuracy.truth[0]
    if not accuracy.on_object:
        return Truth(found, 0.0)
    known = np.where(np.isnan(truth), found.keypoints, truth)
    return Truth(replace(found, keypoints=known), float(np.nanmax(accuracy.errors)))


class FailureAnalysis:
    """Analyses the failed episodes of one scene; checks that they share are made once."""

    def __init__(self, task: Task, scene: Scene):
        self._task, self._scene = task, scene
        self._replayed: dict[str, bool] = {}

    def examine(
        self,
        episode: Episode,
        policy: ScenePolicy | ClosedLoopPolicy,
        observation: Observation,
        truth: Callable[[], Truth | None],
    ) -> Failure:
        """Find the stage to which the failure of ``policy`` from ``observation`` in ``episode`` is due.

        Raises `ModelError` where samples are missing that the method would need with the true keypoints.
        """
        shown = self._demonstrator_succeeds(episode.variant.downsampling)
        found = Failure(episode.scene, episode.variant, episode.candidate, "policy", shown, None, None, None)
        if shown is False:
            return replace(found, stage="execution")
        if isinstance(policy, ClosedLoopPolicy):
            return found
        known = truth()
        if known is None:
            return replace(found, stage="keypoints" if offers(self._task, "scene_truth") else "unknown")
        self._task.reset(self._scene.seed)
        better = self._succeeds_with(known.located, policy, episode.candidate)
        found = replace(found, true_keypoints=better, keypoint_error=known.error)
        if better:
            return replace(found, stage="keypoints")
        try:
            plan = policy.plan(observation)
        except UNPLANNABLE:
            return replace(found, stage="samples", good_candidate=False)
        if any(trajectory is candidate for trajectory in policy.executions(plan) for candidate in plan.candidates):
            return replace(found, stage="samples", good_candidate=False)
        good = any(self._plays(candidate) for candidate in plan.candidates)
        return replace(found, stage="regression" if good else "samples", good_candidate=good)

    def _demonstrator_succeeds(self, downsampling: str) -> bool | None:
        if not offers(self._task, "demonstrate"):
            return None
        if downsampling not in self._replayed:
            shown = self._task.demonstrate(self._scene.seed).demonstration.trajectory
            self._task.reset(self._scene.seed)
            self._replayed[downsampling] = self._plays(downsample(shown, downsampling))
        return self._replayed[downsampling]

    def _succeeds_with(self, located: Located, policy: ScenePolicy, candidate: int) -> bool:
        try:
            trajectories = policy.executions(policy.plan_scene(LocatedScene(located, Stage("keypoints", 0.0))))
        except UNPLANNABLE:
            return False
        return self._plays(trajectories[min(candidate, len(trajectories) - 1)])

    def _plays(self, trajectory: Trajectory) -> bool:
        return execute(self._task, trajectory).success


def film(task: Task, policy: ScenePolicy | ClosedLoopPolicy, observation: Observation, candidate: int) -> bytes:
    """Executes the episode again in the task's scene; returns an MP4, empty if nothing moved."""
    encoder = VideoEncoder(task.video_hz, FILM_OPTIONS)
    sink: FrameSink = encoder.add
    if isinstance(policy, ClosedLoopPolicy):
        task.follow(policy.controller(observation), policy.max_seconds, sink)
    else:
        try:
            execute(task, policy.executions(policy.plan(observation))[candidate], sink)
        except UNPLANNABLE:
            return b""
    return encoder.finish()
