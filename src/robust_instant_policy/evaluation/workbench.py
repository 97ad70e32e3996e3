"""The state of a worker: one simulator at a time, fitted policies, the language model, and cached results.

This is the only cache of an evaluation. Contexts, and the keypoints and samples of the current scene, are keyed by the
number of demonstrations and the settings that decide them. Methods share them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, cast

from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import ModelError
from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.evaluation.failures import FailureAnalysis, Truth, film, true_keypoints
from robust_instant_policy.evaluation.rollout import ScenePolicy, roll_out
from robust_instant_policy.evaluation.scenes import demonstrations_folder
from robust_instant_policy.evaluation.variant import REPLAY, Scene, Variant
from robust_instant_policy.evaluation.work import Analysis, Outcome, Planned, SceneWork, Setup
from robust_instant_policy.llm import LanguageModel, RecordedModel, ReplayedModel, SampleStore, connect, model_name
from robust_instant_policy.policies import (
    ClosedLoopPolicy,
    Context,
    KeypointActionTokens,
    KeypointPolicy,
    LocatedScene,
    Plan,
    Replanning,
    Samples,
    Settings,
    Training,
    build_context,
    locate,
    make_policy,
)
from robust_instant_policy.policies.policy import UNPLANNABLE
from robust_instant_policy.policies.sampling import NO_SAMPLES
from robust_instant_policy.policies.training import TrainingReport, no_report
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.scene_truth import SceneTruth
from robust_instant_policy.tasks.task import Task, offers, require
from robust_instant_policy.trajectory import downsample

if TYPE_CHECKING:  # it needs the extra "train"
    from robust_instant_policy.policies.diffusion.training import TrainedPolicy

ContextKey = tuple[int, Settings]  # number of demonstrations, and what decides the context beside them
DemonstrationSource = Callable[[str, int], list[Demonstration]]  # task, how many


class Workbench:
    """Runs scenes one after the other and reuses what they share.

    ``store`` and ``demonstrations`` default to the files in ``setup``.
    """

    def __init__(
        self,
        setup: Setup,
        store: SampleStore | None = None,
        demonstrations: DemonstrationSource | None = None,
        report: TrainingReport = no_report,
    ):
        self._setup = setup
        self._given_store = store
        self._report = report
        self._demonstrations = demonstrations or self._read_demonstrations
        self._task: Task | None = None
        self._place = ("", "", "", "")  # task, set of objects, their source and level in the simulator
        self._seed = 0  # of the current scene
        self._forget()

    def run(self, work: SceneWork) -> Iterator[Outcome]:
        """Do the work in one scene: first all executions, then the analysis of failed ones."""
        task = self._enter(work.scene)
        self._show(work)
        observation = task.reset(work.scene.seed)
        self._seed = work.scene.seed
        self._located.clear()
        self._samples.clear()
        failed = list(work.failed)
        for variant in work.variants:
            done = {candidate for scene, other, candidate in work.done if (scene, other) == (work.scene, variant)}
            policy = self._policy(variant)
            for episode in roll_out(task, policy, observation, work.scene, variant, done):
                yield episode
                if not episode.success:
                    failed.append(episode)
        for variant in work.plans:
            policy = self._policy(variant)
            if not isinstance(policy, ClosedLoopPolicy):
                with suppress(*UNPLANNABLE):
                    yield Planned(work.scene, variant, policy.plan(observation))
        if self._setup.analyses:
            yield from self._analyse(task, work.scene, failed, observation)

    def train(self, work: SceneWork, variant: Variant) -> TrainedPolicy:
        """Train the policy of ``variant`` for the scene of ``work``, as `run` would."""
        self._enter(work.scene)
        self._show(work)
        policy = self._policy(variant)
        return cast("TrainedPolicy", policy.fitted if isinstance(policy, ScenePolicy) else policy)

    def close(self) -> None:
        if self._task is not None:
            self._task.close()
            self._task = None
        if "model" in self.__dict__:
            self.model.close()

    @cached_property
    def model(self) -> LanguageModel:
        """Loaded at the first request, because not every method makes one."""
        store = self._given_store or SampleStore(self._setup.store)
        if self._setup.replay:
            return ReplayedModel(store, model_name(self._setup.llm))
        return RecordedModel(connect(self._setup.llm), store)

    def _enter(self, scene: Scene) -> Task:
        place = (scene.task, scene.objects, scene.assets, scene.level)
        if self._task is None or self._place != place:
            if self._task is not None:
                self._task.close()
                self._task = None
            if self._place[0] != scene.task:
                self._forget()
            self._task = make_task(scene.task, scene.objects, scene.assets, scene.level)
            self._place = place
        return self._task

    def _forget(self) -> None:
        self._shown: list[Demonstration] = []
        self._shown_truth: list[SceneTruth] = []
        self._contexts: dict[ContextKey, Context] = {}
        self._policies: dict[Variant, ScenePolicy | ClosedLoopPolicy] = {}
        self._located: dict[ContextKey, LocatedScene] = {}  # these two of the present scene
        self._samples: dict[ContextKey, Samples] = {}

    def _show(self, work: SceneWork) -> None:
        if len(self._shown) < work.demos:
            self._forget()
            self._shown = self._demonstrations(work.scene.task, work.demos)

    def _read_demonstrations(self, task: str, count: int, with_images: bool = False) -> list[Demonstration]:
        folder = demonstrations_folder(self._setup.data, task, with_images)
        return load_demonstrations(folder, task=task, limit=count)

    def context(self, demos: int, settings: Settings) -> Context:
        """The context of the first ``demos`` demonstrations."""
        key = demos, settings.of_context
        if key not in self._contexts:
            self._contexts[key] = build_context(self._shown[:demos], settings)
        return self._contexts[key]

    def plan(self, policy: KeypointPolicy, demos: int, observation: Observation) -> Plan:
        """The plan for the current scene, whose image is ``observation``."""
        key = demos, policy.settings.of_context
        if key not in self._located:
            self._located[key] = locate(policy.context_, observation)
        if not isinstance(policy, KeypointActionTokens):
            return policy.plan_scene(self._located[key])
        asked = demos, policy.settings.of_samples
        plan, self._samples[asked] = policy.plan_from(self._located[key], self._samples.get(asked, NO_SAMPLES))
        return plan

    def _demonstrate(self, downsampling: str, _: object) -> Plan:
        """What the demonstrator does in the current scene, thinned out; the scene is built anew afterwards."""
        assert self._task is not None
        require(self._task, "demonstrate")
        shown = self._task.demonstrate(self._seed).demonstration.trajectory
        self._task.reset(self._seed)
        return Plan.of(downsample(shown, downsampling))

    def _settings(self, variant: Variant) -> Settings:
        assert self._task is not None
        settings = Settings(
            features=variant.features, downsampling=variant.downsampling, num_queries=variant.queries
        ).changed(workspace=self._task.workspace)
        for name in ("keypoints", "column", "frames", "layout", "estimator"):  # empty where the method has none
            if value := getattr(variant, name):
                settings = settings.changed(**{name: value})
        return settings if variant.dof is None else settings.changed(dof=variant.dof)

    def _policy(self, variant: Variant) -> ScenePolicy | ClosedLoopPolicy:
        if variant not in self._policies:
            self._policies[variant] = self._fitted(variant)
        return self._policies[variant]

    def _fitted(self, variant: Variant) -> ScenePolicy | ClosedLoopPolicy:
        if variant.method == REPLAY:
            replay = partial(self._demonstrate, variant.downsampling)
            return ScenePolicy(replay, replay)
        training = None
        if variant.steps is not None:
            training = Training(self._setup.checkpoints, variant.steps, report=self._report)
        model = cast(LanguageModel, _Later(self))
        policy = make_policy(variant.method, model, self._settings(variant), training, self._setup.deadline_s)
        if not isinstance(policy, KeypointPolicy):  # closed loop; it satisfies `ClosedLoopPolicy` only after `fit`
            shown = self._read_demonstrations(self._place[0], variant.demos, with_images=True)
            return cast(ClosedLoopPolicy, policy).fit(shown)
        try:
            policy.fit_context(self.context(variant.demos, policy.settings))
        except UNPLANNABLE as error:
            refused = partial(_refused, error)
            return ScenePolicy(refused, refused)
        if variant.replan:
            return Replanning(policy, variant.replan)
        remembering = partial(self.plan, policy, variant.demos)  # uses the cache of the current scene
        return ScenePolicy(remembering, policy.plan_scene, policy.executions, policy)

    def _analyse(
        self, task: Task, scene: Scene, failed: Sequence[Episode], observation: Observation
    ) -> Iterator[Analysis]:
        analysis = FailureAnalysis(task, scene)
        truths: dict[ContextKey, Truth | None] = {}

        def truth(demos: int, settings: Settings) -> Truth | None:
            key = demos, settings.of_context
            if key not in truths:
                known = self._truth_of_demonstrations(demos)
                truths[key] = None
                with suppress(*UNPLANNABLE):
                    if known is not None:
                        truths[key] = true_keypoints(task, scene.seed, self.context(demos, settings), known)
            return truths[key]

        for episode in failed:
            policy, demos = self._policy(episode.variant), episode.variant.demos
            settings = self._settings(episode.variant)
            try:
                failure = analysis.examine(episode, policy, observation, partial(truth, demos, settings))
            except ModelError:
                if self._setup.replay:  # the samples for the true keypoints were never drawn
                    continue
                raise
            task.reset(scene.seed)
            yield Analysis(failure, film(task, policy, observation, episode.candidate) if self._setup.films else b"")

    def _truth_of_demonstrations(self, demos: int) -> list[SceneTruth] | None:
        """The true scene of each demonstration; None if the seed of one of them, or the task's truth, is unknown."""
        assert self._task is not None
        if not offers(self._task, "scene_truth"):
            return None
        shown = self._shown[:demos]
        seeds = [demonstration.seed for demonstration in shown if demonstration.seed is not None]
        if len(seeds) < len(shown):
            return None
        if len(self._shown_truth) < demos:
            name, objects, assets, level = self._place
            apart = None if objects == "seen" else make_task(name, assets=assets, level=level)
            task = apart or self._task
            try:
                for seed in seeds[len(self._shown_truth) :]:
                    task.reset(seed)
                    self._shown_truth.append(task.scene_truth())
            finally:
                if apart is not None:
                    apart.close()
        return self._shown_truth[:demos]


def _refused(error: Exception, _: object) -> Plan:
    """The plan of a policy that cannot be fitted to the demonstrations."""
    raise error


class _Later:
    """The workbench's model, loaded at the first use."""

    def __init__(self, bench: Workbench):
        self._bench = bench

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bench.model, name)
