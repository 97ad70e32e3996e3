"""The robust instant policy (Oh et al. 2025, Algorithm 1): keep what the candidates agree on."""

from __future__ import annotations

import math
from dataclasses import replace

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import UsageError
from robust_instant_policy.llm import LanguageModel
from robust_instant_policy.policies.instant import InstantPolicy, Proposal
from robust_instant_policy.policies.kat import KeypointActionTokens, plan_of_first_candidate
from robust_instant_policy.policies.policy import Plan, Stopwatch, Usage
from robust_instant_policy.regression import robust_gripper_trajectory
from robust_instant_policy.trajectory import Trajectory

DOF = 1.5  # ν of the paper, chosen there for the success rate
FIRST_QUERIES = 3  # with adaptive queries: the fewest among which one hallucination can be told
ENOUGH_CONFIDENCE = 0.3  # with adaptive queries: above it, no more are asked (chosen in docs/prompts.md)


class RobustInstantPolicy(KeypointActionTokens):
    """Samples ``num_queries`` trajectories and follows their Student's t-regression.

    ``dof`` is the paper's ν; infinity is its Gaussian ablation. ``estimator`` is "em" (the default), "network" (the
    paper's; "network-sim" and "network-real" with its own training), "mixture" or "median". With ``adaptive`` the
    policy starts from three queries and asks for more only while the regression is unsure, ``num_queries`` at most.
    Further ``options`` are those of `InstantPolicy`.
    """

    def __init__(
        self,
        llm: LanguageModel | InstantPolicy,
        *,
        num_queries: int = 5,
        dof: float = DOF,
        estimator: str = "em",
        adaptive: bool = False,
        **options,
    ):
        if not dof > 0:
            raise UsageError(f"dof must be positive (or infinite), got {dof}")
        super().__init__(llm, num_queries=num_queries, **options)
        self.dof, self.estimator, self.adaptive = dof, estimator, adaptive
        self.name = "rip-gauss" if math.isinf(dof) else "rip-adaptive" if adaptive else "rip"

    def plan(self, observation: Observation) -> Plan:
        """Raises `KeypointError` or `PlanningError` where no plan can be made."""
        queries = min(FIRST_QUERIES, self.num_queries) if self.adaptive else self.num_queries
        plan = self.aggregate(self.instant.propose(observation, queries))
        while queries < self.num_queries and (plan.confidence or 0.0) < ENOUGH_CONFIDENCE:
            queries += 1
            plan = self.aggregate(self.instant.propose(observation, queries))
        return plan

    def executions(self, plan: Plan) -> tuple[Trajectory, ...]:
        """The robust trajectory alone."""
        return (plan.trajectory,)

    def aggregate(self, proposal: Proposal) -> Plan:
        """The plan for candidates that were sampled before (Oh et al. 2025, Eq. 4)."""
        return robust_plan(proposal, self.dof, self.estimator, self.instant.seed)


def robust_plan(proposal: Proposal, dof: float = DOF, estimator: str = "em", seed: int = 0) -> Plan:
    """The `Plan` that follows what the candidates agree on (Oh et al. 2025, Eq. 4)."""
    watch = Stopwatch()
    with watch.stage("regression"):
        robust = robust_gripper_trajectory(
            [candidate.actions for candidate in proposal.candidates],
            times=[candidate.times for candidate in proposal.candidates],
            dof=dof,
            estimator=estimator,
            seed=seed,
            bends=proposal.bends,
            variation=proposal.variation,
        )
    return replace(
        plan_of_first_candidate(proposal),
        trajectory=Trajectory(robust.actions, robust.times),
        weights=robust.weights,
        scale=robust.scale,
        hallucinated=robust.hallucinated,
        onset=robust.onset,
        scores=robust.scores,
        confidence=robust.confidence,
        usage=Usage((*proposal.usage.stages, *watch.stages)),
    )
