"""The robust instant policy (Oh et al. 2025, Algorithm 1): keep what the candidates agree on."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import InvalidValueError, PlanningError, UsageError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.llm import LanguageModel
from robust_instant_policy.policies.instant import InstantPolicy, Proposal
from robust_instant_policy.policies.kat import KeypointActionTokens, plan_of_first_candidate
from robust_instant_policy.policies.policy import Plan, Stopwatch, Usage
from robust_instant_policy.regression import robust_gripper_trajectory
from robust_instant_policy.trajectory import Trajectory

DOF = 1.5  # ν of the paper, chosen there for the success rate
FIRST_QUERIES = 3  # with adaptive queries: the fewest among which one hallucination can be told
RECOGNISED = 0.5  # confidence of keypoints from which on a scene counts as recognised; 0.7 to 0.8 is usual
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
        enough = ENOUGH_CONFIDENCE * recognition(plan.keypoint_confidence)  # more samples do not show the scene better
        while queries < self.num_queries and (plan.confidence or 0.0) < enough:
            queries += 1
            plan = self.aggregate(self.instant.propose(observation, queries))
        return plan

    def executions(self, plan: Plan) -> tuple[Trajectory, ...]:
        """The robust trajectory alone."""
        return (plan.trajectory,)

    def aggregate(self, proposal: Proposal) -> Plan:
        """The plan for candidates that were sampled before (Oh et al. 2025, Eq. 4)."""
        return robust_plan(proposal, self.dof, self.estimator, self.instant.seed)


def recognition(keypoint_confidence: FloatArray) -> float:
    """How far a scene was recognised, from 0 to 1, by its keypoints' ``(K,)`` confidence.

    The lower quarter counts: one keypoint may be hidden, but an object that is not there has several.
    """
    return float(min(1.0, np.quantile(keypoint_confidence, 0.25) / RECOGNISED))


def robust_plan(proposal: Proposal, dof: float = DOF, estimator: str = "em", seed: int = 0) -> Plan:
    """The `Plan` that follows what the candidates agree on (Oh et al. 2025, Eq. 4).

    Its confidence is the regression's, less where the scene was hardly recognised: candidates may well agree on what
    to do with an object that is not there. Raises `PlanningError` where candidates hold no gripper.
    """
    watch = Stopwatch()
    with watch.stage("regression"):
        try:
            robust = robust_gripper_trajectory(
                [candidate.actions for candidate in proposal.candidates],
                times=[candidate.times for candidate in proposal.candidates],
                dof=dof,
                estimator=estimator,
                seed=seed,
                bends=proposal.bends,
                variation=proposal.variation,
            )
        except InvalidValueError as error:
            raise PlanningError(f"the answers are no trajectories of a gripper: {error}") from None
    seen = recognition(proposal.located.confidence)
    if seen < 1:
        note = "the scene was hardly recognised; is everything there that was there in the demonstrations?"
        proposal = replace(proposal, notes=(*proposal.notes, note))
    return replace(
        plan_of_first_candidate(proposal),
        trajectory=Trajectory(robust.actions, robust.times),
        weights=robust.weights,
        scale=robust.scale,
        hallucinated=robust.hallucinated,
        onset=robust.onset,
        scores=robust.scores,
        confidence=robust.confidence * seen,
        usage=Usage((*proposal.usage.stages, *watch.stages)),
    )
