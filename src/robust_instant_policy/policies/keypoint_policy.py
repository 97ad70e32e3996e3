"""What all methods over keypoints have in common."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Self

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import UsageError
from robust_instant_policy.policies.context import Context, LocatedScene, build_context, locate
from robust_instant_policy.policies.policy import Plan, Progress, no_progress
from robust_instant_policy.policies.settings import Settings
from robust_instant_policy.trajectory import Trajectory


class KeypointPolicy(ABC):
    """A `Policy` that sees a scene as keypoints.

    ``options`` are fields of `Settings`, and change those of ``settings``. After `fit`, ``context_`` is the `Context`
    of the demonstrations.
    """

    name: str
    context_: Context

    def __init__(self, settings: Settings | None = None, *, progress: Progress = no_progress, **options: object):
        self.settings = (settings or Settings()).changed(**options)
        self.progress = progress

    def fit(self, demonstrations: Sequence[Demonstration]) -> Self:
        """Find keypoints and serialise the demonstrations; returns itself. See `build_context` for errors."""
        return self.fit_context(build_context(demonstrations, self.settings, self.progress))

    def fit_context(self, context: Context) -> Self:
        """`fit` with a context that was built before, with equal `Settings.of_context`; returns itself."""
        self.context_ = context
        return self

    def plan(self, observation: Observation) -> Plan:
        """Raises `KeypointError` or `PlanningError` where no plan can be made."""
        if not hasattr(self, "context_"):
            raise UsageError("call fit(demonstrations) before asking for a plan")
        return self.plan_scene(locate(self.context_, observation, self.progress))

    @abstractmethod
    def plan_scene(self, scene: LocatedScene) -> Plan:
        """`plan` for a scene whose keypoints are known; raises `PlanningError`."""

    def executions(self, plan: Plan) -> tuple[Trajectory, ...]:
        """The planned trajectory."""
        return (plan.trajectory,)
