"""Planning in a thread beside the running cell: stages can be cancelled, regressions are repeated at once."""

import math
import threading
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import PlanningError, RipError, UsageError
from robust_instant_policy.evaluation.scenes import demonstration_digests
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.llm import LanguageModel, connect
from robust_instant_policy.policies import (
    Context,
    LocatedScene,
    Neighbours,
    Plan,
    Proposal,
    Settings,
    aggregate,
    build_context,
    locate,
    propose,
    sample,
)
from robust_instant_policy.policies.aggregation import agree, take_first
from robust_instant_policy.policies.sampling import MIN_CANDIDATES, NO_SAMPLES
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX, Trajectory

DRAG_REACH = 0.12  # standard deviation, in normalised time, of the bump that a drag adds to a candidate
CLOSE_TIMEOUT_S = 5.0  # for the stage of a cancelled plan to end; a model that is busy longer is not closed
PAPER_ESTIMATOR = "em-number"  # the model of the paper's networks, fitted exactly in milliseconds


@dataclass(frozen=True)
class Choices:
    """Settings that redraw the plan: ``queries`` Q, ``dof`` ν, ``estimator``, and ``noise`` (standard deviation,
    metres) of the candidates. ``dragged`` are candidates that a person moved: index to the time in [0, 1] and the
    shift ``(3,)`` in metres there."""

    queries: int = 5
    dof: float = 1.5
    estimator: str = "em"
    noise: float = 0.0
    dragged: Mapping[int, tuple[float, FloatArray]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Draft:
    """What is known about one scene: the ``proposal`` has the candidates of the language model so far."""

    context: Context
    scene: LocatedScene
    settings: Settings
    proposal: Proposal
    prompt: str

    def plan(self, choices: Choices) -> Plan:
        """The regression on the candidates of ``choices``, in milliseconds."""
        settings = self.settings.changed(dof=choices.dof, estimator=choices.estimator)
        return aggregate(self.context, self.scene, self.changed(choices), settings)

    def gaussian(self, choices: Choices) -> Trajectory:
        """The Gaussian mean (ν = ∞) of the same candidates."""
        prompt = self.context.prompt.for_scene(self.scene.keypoints)
        settings = self.settings.changed(dof=math.inf, estimator=choices.estimator)
        robust = agree(self.changed(choices), settings, prompt.curvature, prompt.variation)
        return Trajectory(robust.actions, robust.times)

    def changed(self, choices: Choices) -> Proposal:
        """The candidates with noise, and where they were dragged to."""
        candidates = []
        for index, candidate in enumerate(self.proposal.candidates[: choices.queries]):
            shift = np.random.default_rng([self.settings.seed, index]).normal(0, 1, (len(candidate), 3)) * choices.noise
            if index in choices.dragged:
                at, way = choices.dragged[index]
                shift = shift + np.exp(-0.5 * ((candidate.times - at) / DRAG_REACH) ** 2)[:, None] * way
            candidates.append(_shifted(candidate, shift))
        return replace(self.proposal, candidates=tuple(candidates))

    def compared(self, choices: Choices) -> dict[str, Plan]:
        """The plan of each method that plans from the same candidates, and of neighbours."""
        proposal = self.changed(choices)
        settings = self.settings.changed(dof=choices.dof)
        plans = {
            "rip": aggregate(self.context, self.scene, proposal, settings),
            "rip-gauss": aggregate(self.context, self.scene, proposal, settings.changed(dof=math.inf)),
            "mean": aggregate(self.context, self.scene, proposal, settings.changed(estimator="mean")),
            "kat": take_first(self.context, self.scene, proposal),
        }
        if self.settings.layout == "factorised":
            plans["neighbours"] = Neighbours(settings).fit_context(self.context).plan_scene(self.scene)
        return plans


def _shifted(trajectory: Trajectory, shift: FloatArray) -> Trajectory:
    """``trajectory`` with every point of every gripper shifted by ``shift (T, 3)`` metres."""
    actions = trajectory.actions.copy()
    points = np.arange(actions.shape[1]) % ACTION_DIM < STATE_INDEX
    actions[:, points] += np.tile(shift, points.sum() // 3)
    return Trajectory(actions, trajectory.times)


class Cancelled(RipError):
    """The person does not want the plan any more."""


class Planner:
    """Plans in a thread of its own, one scene at a time; the language model and the last context stay loaded.

    ``on_progress`` receives the stage's name and its share in [0, 1], None where it is unknown; ``on_draft`` the draft,
    again with each candidate; ``on_end`` why planning ended early, empty where it did not.
    """

    def __init__(
        self,
        llm: str,
        on_progress: Callable[[str, float | None], None],
        on_draft: Callable[[Draft], None],
        on_end: Callable[[str], None],
    ):
        self._llm = llm
        self._on_progress, self._on_draft, self._on_end = on_progress, on_draft, on_end
        self._model: LanguageModel | None = None
        self._context: tuple[str, Settings, Context] | None = None
        self._job = 0
        self._lock = threading.Lock()  # of the language model: a cancelled plan may still end a stage

    def start(
        self, demonstrations: Sequence[Demonstration], observation: Observation, settings: Settings, queries: int
    ) -> None:
        """Plan for ``observation`` with Q ``queries``; an earlier plan is cancelled."""
        self._job += 1
        plan = partial(self._plan, tuple(demonstrations), observation, settings, queries)
        threading.Thread(target=self._work, args=(self._job, plan), name="planner", daemon=True).start()

    def cancel(self) -> None:
        """End planning; the result of a stage that is under way is dropped."""
        self._job += 1
        self._on_end("")

    def _work(self, job: int, plan: Callable[[Callable[..., None]], None]) -> None:
        def stage(name: str, share: float | None = None) -> None:
            if job != self._job:
                raise Cancelled
            self._on_progress(name, share)

        try:
            stage("waiting for the plan before")
            with self._lock:
                plan(stage)
            stage("done", 1.0)
            self._on_end("")
        except Cancelled:
            pass
        except Exception as error:
            if isinstance(error, RipError):
                reason = str(error)
            else:  # such as a fault inside a model's library
                traceback.print_exc()
                reason = f"unexpected {type(error).__name__}: {error}; see the terminal"
            if job == self._job:
                self._on_end(reason)

    def _plan(
        self,
        demonstrations: tuple[Demonstration, ...],
        observation: Observation,
        settings: Settings,
        queries: int,
        stage: Callable[..., None],
    ) -> None:
        if not demonstrations:
            raise UsageError("nothing was demonstrated yet: show the task first")
        known, digest = self._context, demonstration_digests(demonstrations)[-1]
        if known is None or known[:2] != (digest, settings.of_context):
            stage(f"keypoints of {len(demonstrations)} demonstrations")
            self._context = known = digest, settings.of_context, build_context(demonstrations, settings)
        context = known[2]
        stage("keypoints of the scene")
        scene = locate(context, observation)
        if self._model is None:
            stage("loading the language model")
            self._model = connect(self._llm)
        prompt = context.prompt.for_scene(scene.keypoints)
        texts = [query.text for query in prompt.queries(scene.keypoints)]
        draft = Draft(context, scene, settings, Proposal(()), "\n\n--- next prompt ---\n\n".join(texts))
        samples = NO_SAMPLES
        for count in range(1, queries + 1):
            stage(f"candidate {count} of {queries}", (count - 1) / queries)
            samples = sample(context, scene, self._model, settings, count, earlier=samples)
            try:
                proposal = propose(context, scene, samples, count)
            except PlanningError:
                if count >= MIN_CANDIDATES and count == queries:
                    raise
                continue
            draft = replace(draft, proposal=proposal)
            stage(f"candidate {count} of {queries}", count / queries)
            self._on_draft(draft)

    def close(self) -> None:
        self._job += 1
        if self._lock.acquire(timeout=CLOSE_TIMEOUT_S) and self._model is not None:
            self._model.close()
