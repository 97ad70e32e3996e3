"""The nearest demonstrations, carried over to the new scene: neither learning nor a language model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

from robust_instant_policy.context import InContextPrompt
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.policies.instant import Proposal
from robust_instant_policy.policies.keypoint_context import KeypointContext
from robust_instant_policy.policies.policy import Plan, Stopwatch, Usage
from robust_instant_policy.policies.rip import robust_plan
from robust_instant_policy.trajectory import Trajectory


class Neighbours:
    """RIP without the language model, which shows what the model adds.

    The candidates are the ``num_queries`` demonstrations nearest to the new scene, each step carried over in its
    adaptive frame; they are aggregated as RIP aggregates samples. ``context`` may be shared with other policies.
    """

    name = "neighbours"

    def __init__(self, context: KeypointContext, num_queries: int = 5):
        self.context, self.num_queries = context, num_queries
        self._frames = InContextPrompt(frames="adaptive", layout="factorised")
        self._written: Sequence[Trajectory] = ()

    def fit(self, demonstrations: Sequence[Demonstration]) -> Self:
        """Find keypoints and choose frames; nothing is trained. Returns itself."""
        self.context.fit(demonstrations)
        self._frames.fit(self.context.keypoints_, self.context.trajectories_)
        self._written = self.context.trajectories_
        return self

    def plan(self, observation: Observation) -> Plan:
        """Raises `KeypointError` where the scene cannot be recognised."""
        located, locating = self.context.locate(observation, self._written)
        watch = Stopwatch()
        with watch.stage("neighbours"):
            candidates = self._frames.carried_over(located.keypoints, self.num_queries)
        notes = (*self.context.extractor.notes_, *located.notes)
        usage = Usage((locating, *watch.stages))
        frames = self._frames
        return robust_plan(Proposal(located, candidates, usage, notes, frames.bends_, frames.variation_))

    def executions(self, plan: Plan) -> tuple[Trajectory, ...]:
        """The robust trajectory alone."""
        return (plan.trajectory,)
