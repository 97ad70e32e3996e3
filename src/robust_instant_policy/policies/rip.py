"""The robust instant policy (Oh et al. 2025, Algorithm 1): keep what the candidates agree on."""

import math
from typing import Any, Self

from robust_instant_policy.llm import LanguageModel
from robust_instant_policy.policies.aggregation import aggregate
from robust_instant_policy.policies.context import LocatedScene
from robust_instant_policy.policies.instant import KeypointActionTokens
from robust_instant_policy.policies.policy import Plan
from robust_instant_policy.policies.sampling import MIN_CANDIDATES, Samples, count_candidates, propose
from robust_instant_policy.policies.settings import Settings
from robust_instant_policy.trajectory import Trajectory

ENOUGH_AGREEMENT = 0.3  # with adaptive queries, no more are asked above it (chosen in docs/prompts.md)


class RobustInstantPolicy(KeypointActionTokens):
    """Samples ``num_queries`` trajectories and follows their Student's t-regression.

    The options are those of `KeypointActionTokens`; see `Settings` for ``dof``, ``estimator`` and ``adaptive``.
    """

    @classmethod
    def paper(cls, llm: LanguageModel, column: str = "sim", **options: Any) -> Self:
        """What Oh et al. (2025) did and nothing else, with ``column`` "sim" or "real" of their Table II.

        See `Settings.of`; ``options`` as elsewhere, ``estimator="em-number"`` for the networks' model fitted exactly.
        """
        return cls(llm, Settings.of({"sim": "paper", "real": "paper-real"}.get(column, column)), **options)

    @property
    def name(self) -> str:  # type: ignore[override]
        if self.settings.estimator == "mean":
            return "mean"
        if math.isinf(self.settings.dof):
            return "rip-gauss"
        return "rip-adaptive" if self.settings.adaptive else "rip"

    def plan_from(self, scene: LocatedScene, earlier: Samples) -> tuple[Plan, Samples]:
        settings, most = self.settings, self.settings.num_queries
        queries = min(MIN_CANDIDATES, most) if settings.adaptive else most
        samples = self.sample(scene, earlier, queries)
        while True:
            enough = count_candidates(samples, queries) >= min(MIN_CANDIDATES, most)
            if enough or queries == most:
                plan = aggregate(self.context_, scene, propose(self.context_, scene, samples, queries), settings)
                # More samples do not show the scene better: what is enough depends on how well it was recognised.
                threshold = ENOUGH_AGREEMENT * scene.recognition
                if queries == most or plan.evidence["agreement"] >= threshold:
                    return plan, samples
            queries += 1
            samples = self.sample(scene, samples, queries)

    def executions(self, plan: Plan) -> tuple[Trajectory, ...]:
        """The robust trajectory alone."""
        return (plan.trajectory,)
