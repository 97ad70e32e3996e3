"""What a worker works with: one simulator at a time, the policies that were fitted, the model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import KeypointError, ModelError, PlanningError
from robust_instant_policy.evaluation.episodes import Episode
from robust_instant_policy.evaluation.failures import Inquest, Truth, film, true_keypoints
from robust_instant_policy.evaluation.rollout import roll_out
from robust_instant_policy.evaluation.scenes import demonstrations_folder
from robust_instant_policy.evaluation.variant import Scene, Variant
from robust_instant_policy.evaluation.work import Analysis, Outcome, Planned, SceneWork, Setup
from robust_instant_policy.llm import LanguageModel, RecordedModel, ReplayedModel, SampleStore, connect, model_name
from robust_instant_policy.policies import (
    IMAGE_METHODS,
    ClosedLoopPolicy,
    InstantPolicy,
    Policy,
    Training,
    make_policy,
)
from robust_instant_policy.policies.training import TrainingReport, no_report
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.scene_truth import SceneTruth
from robust_instant_policy.tasks.task import Task

if TYPE_CHECKING:  # it needs the extra "train"
    from robust_instant_policy.policies.diffusion.training import TrainedPolicy

AnyPolicy = Policy | ClosedLoopPolicy
Context = tuple[int, str, str, str, str]  # demonstrations, downsampling, frames, layout, features
DemonstrationSource = Callable[[str, int], list[Demonstration]]  # task, how many


class Workbench:
    """Runs scenes one after the other; whatever the next scene can use again stays.

    ``store`` and ``demonstrations`` default to the files that ``setup`` names.
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
        self._place = ("", "", "")  # the task, the set of objects and their source that the simulator holds
        self._forget()

    def run(self, work: SceneWork) -> Iterator[Outcome]:
        """Everything that is to be done in one scene: first all executions, then failed episodes are taken apart."""
        task = self._enter(work.scene)
        shown = self._show(work)
        observation = task.reset(work.scene.seed)
        failed = list(work.failed)
        for variant in work.variants:
            done = {candidate for scene, other, candidate in work.done if (scene, other) == (work.scene, variant)}
            policy = self._policy(variant, shown)
            for episode in roll_out(task, policy, observation, work.scene, variant, done):
                yield episode
                if not episode.success:
                    failed.append(episode)
        for variant in work.plans:
            policy = self._policy(variant, shown)
            if not isinstance(policy, ClosedLoopPolicy):
                with suppress(KeypointError, PlanningError):
                    yield Planned(work.scene, variant, policy.plan(observation))
        yield from self._take_apart(task, work.scene, failed, shown, observation)

    def train(self, work: SceneWork, variant: Variant) -> TrainedPolicy:
        """Make and train the policy of ``variant`` for the scenes of ``work``, as `run` would."""
        self._enter(work.scene)
        return cast("TrainedPolicy", self._policy(variant, self._show(work)))

    def close(self) -> None:
        if self._task is not None:
            self._task.close()
            self._task = None
        if "model" in self.__dict__:
            self.model.close()

    @cached_property
    def model(self) -> LanguageModel:
        """Loaded when a method asks it first: not every method does."""
        store = self._given_store or SampleStore(self._setup.store)
        if self._setup.replay:
            return ReplayedModel(store, model_name(self._setup.llm))
        return RecordedModel(connect(self._setup.llm), store)

    def _enter(self, scene: Scene) -> Task:
        place = (scene.task, scene.objects, scene.assets)
        if self._task is None or self._place != place:
            if self._task is not None:
                self._task.close()
                self._task = None
            if self._place[0] != scene.task:
                self._forget()
            self._task = make_task(scene.task, scene.objects, scene.assets)
            self._place = place
        return self._task

    def _forget(self) -> None:
        self._shown: list[Demonstration] = []
        self._shown_truth: list[SceneTruth] = []
        self._instants: dict[Context, InstantPolicy] = {}
        self._policies: dict[Variant, AnyPolicy] = {}

    def _show(self, work: SceneWork) -> list[Demonstration]:
        if len(self._shown) < work.demos:
            self._forget()
            self._shown = self._demonstrations(work.scene.task, work.demos)
        return self._shown

    def _read_demonstrations(self, task: str, count: int, with_images: bool = False) -> list[Demonstration]:
        folder = demonstrations_folder(self._setup.data, task, with_images)
        return load_demonstrations(folder, task=task, limit=count)

    def _instant(self, variant: Variant) -> InstantPolicy:
        """Shared by all methods that start from the same keypoints and the same prompt."""
        frames, layout = variant.frames or "adaptive", variant.layout or "factorised"
        context = (variant.demos, variant.downsampling, frames, layout, variant.features)
        if context not in self._instants:
            assert self._task is not None
            settings: dict[str, Any] = {"frames": frames, "layout": layout}
            self._instants[context] = InstantPolicy(
                _Later(self),
                workspace=self._task.workspace,
                downsampling=variant.downsampling,
                features=variant.features,
                deadline_s=self._setup.deadline_s,
                **settings,
            )
        return self._instants[context]

    def _policy(self, variant: Variant, shown: Sequence[Demonstration]) -> AnyPolicy:
        if variant not in self._policies:
            options: dict[str, Any] = {} if variant.dof is None else {"dof": variant.dof}
            if variant.steps is not None:
                options["training"] = Training(self._setup.checkpoints, variant.steps, report=self._report)
            policy = make_policy(variant.method, self._instant(variant), variant.queries, **options)
            demonstrations = shown[: variant.demos]
            if variant.method in IMAGE_METHODS:
                demonstrations = self._read_demonstrations(self._place[0], variant.demos, with_images=True)
            self._policies[variant] = policy.fit(demonstrations)
        return self._policies[variant]

    def _take_apart(
        self,
        task: Task,
        scene: Scene,
        failed: Sequence[Episode],
        shown: Sequence[Demonstration],
        observation: Observation,
    ) -> Iterator[Analysis]:
        inquest = Inquest(task, scene)
        truths: dict[InstantPolicy, Truth | None] = {}
        for episode in failed:
            variant = episode.variant
            policy, instant = self._policy(variant, shown), self._instant(variant)

            def truth(instant: InstantPolicy = instant, demos: int = variant.demos) -> Truth | None:
                if instant not in truths:
                    known = self._truth_of_demonstrations(scene.task, shown, demos)
                    truths[instant] = (
                        None
                        if known is None
                        else true_keypoints(task, scene.seed, instant.context, shown[:demos], known)
                    )
                return truths[instant]

            try:
                failure = inquest.examine(episode, policy, observation, instant.context, truth)
            except ModelError:
                if self._setup.replay:  # nobody asked the model what it would have said with the true keypoints
                    continue
                raise
            task.reset(scene.seed)
            yield Analysis(failure, film(task, policy, observation, episode.candidate) if self._setup.films else b"")

    def _truth_of_demonstrations(
        self, task_name: str, shown: Sequence[Demonstration], demos: int
    ) -> list[SceneTruth] | None:
        """Of each demonstration that is shown; None where one was not recorded in a scene that can be drawn again."""
        seeds = [demonstration.seed for demonstration in shown[:demos] if demonstration.seed is not None]
        if len(seeds) < len(shown[:demos]):
            return None
        if len(self._shown_truth) < demos:
            apart = None if self._place[1] == "seen" else make_task(task_name, assets=self._place[2])
            task = apart or self._task
            assert task is not None
            try:
                for seed in seeds[len(self._shown_truth) :]:
                    task.reset(seed)
                    self._shown_truth.append(task.scene_truth())
            finally:
                if apart is not None:
                    apart.close()
        return self._shown_truth[:demos]


class _Later:
    """The workbench's model, which need not be there before it is asked."""

    def __init__(self, bench: Workbench):
        self._bench = bench

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bench.model, name)
