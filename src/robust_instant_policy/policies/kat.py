"""Keypoint action tokens: execute what the language model said (Di Palo and Johns 2024)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.llm import LanguageModel
from robust_instant_policy.policies.instant import InstantPolicy, Proposal
from robust_instant_policy.policies.policy import Plan
from robust_instant_policy.trajectory import Trajectory


class KeypointActionTokens:
    """The instant policy taken at its word: the plan is the first candidate, the others go along unused.

    ``llm`` is a language model, with ``options`` for the `InstantPolicy` over it; or an `InstantPolicy`
    made before, so that several policies share its keypoints and its samples.
    """

    name = "kat"

    def __init__(self, llm: LanguageModel | InstantPolicy, *, num_queries: int = 5, **options):
        self.instant = llm if isinstance(llm, InstantPolicy) else InstantPolicy(llm, **options)
        self.num_queries = num_queries

    def fit(self, demonstrations: Sequence[Demonstration]) -> Self:
        """Find keypoints and write the context; nothing is trained. Returns itself."""
        self.instant.fit(demonstrations)
        return self

    def plan(self, observation: Observation) -> Plan:
        """Raises `KeypointError` or `PlanningError` where no plan can be made."""
        return plan_of_first_candidate(self.instant.propose(observation, self.num_queries))

    def executions(self, plan: Plan) -> tuple[Trajectory, ...]:
        """Every candidate, as the paper executes KAT (Oh et al. 2025, Table I)."""
        return plan.candidates


def plan_of_first_candidate(proposal: Proposal) -> Plan:
    """The `Plan` that follows the first candidate and knows nothing about the agreement of the others."""
    trajectory = proposal.candidates[0]
    count = len(proposal.candidates)
    weights = np.zeros((count, len(trajectory)))
    weights[0] = 1.0
    return Plan(
        trajectory=trajectory,
        candidates=proposal.candidates,
        weights=weights,
        scale=np.zeros_like(trajectory.actions),
        hallucinated=np.zeros(count, dtype=bool),
        onset=np.full(count, -1),
        scores=np.zeros(count),
        confidence=None,
        keypoints=proposal.located.keypoints,
        pixels=proposal.located.pixels,
        keypoint_confidence=proposal.located.confidence,
        usage=proposal.usage,
        notes=proposal.notes,
    )
