"""Two stand-ins for a fitted policy, see `rollout.ScenePolicy`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.policies import LocatedScene, Plan
from robust_instant_policy.trajectory import Trajectory, downsample


@dataclass(frozen=True)
class RefusingPolicy:
    """A policy that could not be fitted to the demonstrations: every plan raises the ``error``."""

    error: Exception

    def plan(self, observation: Observation) -> Plan:
        raise self.error

    def plan_scene(self, scene: LocatedScene) -> Plan:
        raise self.error

    def executions(self, plan: Plan) -> tuple[Trajectory, ...]:
        return (plan.trajectory,)


@dataclass(frozen=True)
class ReplayedDemonstrator:
    """`variant.REPLAY`: what ``demonstrate`` returns for the current scene, thinned out like a demonstration."""

    demonstrate: Callable[[], Trajectory]
    downsampling: str

    def plan(self, observation: Observation) -> Plan:
        return self._plan()

    def plan_scene(self, scene: LocatedScene) -> Plan:
        return self._plan()

    def _plan(self) -> Plan:
        return Plan.of(downsample(self.demonstrate(), self.downsampling))

    def executions(self, plan: Plan) -> tuple[Trajectory, ...]:
        return (plan.trajectory,)
