"""The nearest demonstrations, transferred to the new scene: neither learning nor a language model."""

from robust_instant_policy.context import FactorisedPrompt
from robust_instant_policy.errors import UsageError
from robust_instant_policy.policies.aggregation import aggregate
from robust_instant_policy.policies.context import LocatedScene
from robust_instant_policy.policies.keypoint_policy import KeypointPolicy
from robust_instant_policy.policies.policy import Plan, Stopwatch
from robust_instant_policy.policies.sampling import Proposal


class Neighbours(KeypointPolicy):
    """RIP without the language model, which shows what the model adds.

    The candidates are the ``num_queries`` demonstrations nearest to the new scene, each step transferred in its
    frame; they are aggregated as RIP aggregates samples. Needs ``layout="factorised"``.
    """

    name = "neighbours"

    def plan_scene(self, scene: LocatedScene) -> Plan:
        prompt = self.context_.prompt.for_scene(scene.keypoints)
        if not isinstance(prompt, FactorisedPrompt):
            raise UsageError("neighbours need layout='factorised'")
        watch = Stopwatch()
        with watch.stage("neighbours"):
            candidates = prompt.carried_over(scene.keypoints, self.settings.num_queries)
        return aggregate(self.context_, scene, Proposal(candidates, tuple(watch.stages)), self.settings)
