"""Keypoint action tokens: execute what the language model says (Di Palo and Johns 2024)."""

from robust_instant_policy.checks import checked_positive
from robust_instant_policy.llm import DEADLINE_S, LanguageModel
from robust_instant_policy.policies.aggregation import take_first
from robust_instant_policy.policies.context import LocatedScene
from robust_instant_policy.policies.keypoint_policy import KeypointPolicy
from robust_instant_policy.policies.policy import Plan, Progress, no_progress
from robust_instant_policy.policies.sampling import NO_SAMPLES, Samples, propose, sample
from robust_instant_policy.policies.settings import Settings
from robust_instant_policy.trajectory import Trajectory


class KeypointActionTokens(KeypointPolicy):
    """The plan is the language model's first trajectory; the other ``num_queries - 1`` go along unused.

    ``deadline_s`` bounds the wall time of all sampling for one plan. ``options`` are fields of `Settings`.
    """

    name = "kat"
    llm: LanguageModel
    deadline_s: float

    def __init__(
        self,
        llm: LanguageModel,
        settings: Settings | None = None,
        *,
        deadline_s: float = DEADLINE_S,
        progress: Progress = no_progress,
        **options: object,
    ):
        super().__init__(settings, progress=progress, **options)
        self.llm, self.deadline_s = llm, checked_positive("deadline_s", deadline_s)

    def plan_scene(self, scene: LocatedScene) -> Plan:
        return self.plan_from(scene, NO_SAMPLES)[0]

    def plan_from(self, scene: LocatedScene, earlier: Samples) -> tuple[Plan, Samples]:
        """`plan_scene` with ``earlier`` samples of the scene, with equal `Settings.of_samples`, and with those that it
        lacks; returns all of them, for other methods to plan from."""
        samples = self.sample(scene, earlier, self.settings.num_queries)
        proposal = propose(self.context_, scene, samples, self.settings.num_queries)
        return take_first(self.context_, scene, proposal), samples

    def sample(self, scene: LocatedScene, earlier: Samples, num_queries: int) -> Samples:
        """See `sampling.sample`."""
        return sample(
            self.context_, scene, self.llm, self.settings, num_queries, self.deadline_s, earlier, self.progress
        )

    def executions(self, plan: Plan) -> tuple[Trajectory, ...]:
        """Every candidate, as the paper executes KAT (Oh et al. 2025, Table I)."""
        return plan.candidates
