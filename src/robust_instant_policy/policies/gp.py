"""A Gaussian process from keypoints to each step: the cheap learner that every expensive one must beat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from robust_instant_policy.context.alignment import align
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import UsageError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies.instant import Proposal
from robust_instant_policy.policies.keypoint_context import KeypointContext
from robust_instant_policy.policies.policy import Plan, Stopwatch, Usage
from robust_instant_policy.policies.rip import robust_plan
from robust_instant_policy.trajectory import Trajectory

# The kernel's parameters, of which the likelihood chooses the logarithms: how much of the outputs' variance is linear
# in the keypoints (per square metre), smooth in them, and noise; and over how many metres the smooth part varies.
LOG_BOUNDS = np.log([(1e-2, 1e4), (1e-6, 1e2), (1e-5, 1.0), (0.03, 3.0)])
LOG_STARTS = np.log([(10.0, 0.1, 1e-2, 0.3), (1.0, 1.0, 1e-2, 0.15), (10.0, 1e-3, 1e-1, 0.5)])


@dataclass(frozen=True, eq=False)
class GaussianProcess:
    """M outputs that share one kernel, linear plus squared-exponential plus noise (Rasmussen and Williams 2006, Ch. 2).

    The kernel's parameters are those of the greatest marginal likelihood.
    """

    inputs: FloatArray
    parameters: FloatArray
    mean: FloatArray
    output_scale: float
    dual: FloatArray
    factor: tuple

    @classmethod
    def fitted(cls, inputs: FloatArray, outputs: FloatArray) -> GaussianProcess:
        """To ``outputs (I, M)`` at ``inputs (I, N)``."""
        mean = outputs.mean(axis=0)
        output_scale = float(np.sqrt(((outputs - mean) ** 2).mean())) or 1.0
        centred, targets = inputs - inputs.mean(axis=0), (outputs - mean) / output_scale
        fits = [minimize(_misfit, start, (centred, targets), bounds=LOG_BOUNDS) for start in LOG_STARTS]
        best = min(fits, key=lambda fit: fit.fun).x
        factor = _factor(best, centred)
        return cls(inputs, best, mean, output_scale, cho_solve(factor, targets), factor)

    def predict(self, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Means ``(B, M)`` at ``inputs (B, N)``, and standard deviations ``(B,)``, noise included."""
        middle = self.inputs.mean(axis=0)
        new, old = inputs - middle, self.inputs - middle
        across = _kernel(self.parameters, new, old)
        explained = (across * cho_solve(self.factor, across.T).T).sum(axis=1)
        variance = np.diag(_kernel(self.parameters, new, new)) + np.exp(self.parameters[2]) - explained
        return self.mean + self.output_scale * across @ self.dual, self.output_scale * np.sqrt(variance)


def _kernel(parameters: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
    linear, smooth, _, length = np.exp(parameters)
    return linear * left @ right.T + smooth * np.exp(-0.5 * cdist(left, right, "sqeuclidean") / length**2)


def _factor(parameters: FloatArray, inputs: FloatArray) -> tuple:
    return cho_factor(_kernel(parameters, inputs, inputs) + np.exp(parameters[2]) * np.eye(len(inputs)), lower=True)


def _misfit(parameters: FloatArray, inputs: FloatArray, targets: FloatArray) -> float:
    """Negative log marginal likelihood, a target, without constants."""
    factor = _factor(parameters, inputs)
    determinant = 2 * np.log(np.diag(factor[0])).sum() * targets.shape[1]
    return 0.5 * float(determinant + (targets * cho_solve(factor, targets)).sum()) / targets.size


class KeypointRegression:
    """The trajectory as a Gaussian process of the scene's keypoints, in the world frame; ``context`` may be shared."""

    name = "gp"
    process_: GaussianProcess

    def __init__(self, context: KeypointContext):
        self.context = context

    def fit(self, demonstrations: Sequence[Demonstration]) -> Self:
        """Find keypoints and the kernel's parameters, in a fraction of a second; returns itself."""
        self.context.fit(demonstrations)
        self._written = self.context.trajectories_
        aligned = align(self._written)
        keypoints = self.context.keypoints_[list(aligned.kept)]
        self._shape = aligned.actions.shape[1:]
        self.process_ = GaussianProcess.fitted(
            keypoints.reshape(len(keypoints), -1), aligned.actions.reshape(len(keypoints), -1)
        )
        return self

    def plan(self, observation: Observation) -> Plan:
        """Raises `KeypointError` where the scene cannot be recognised."""
        if not hasattr(self, "process_"):
            raise UsageError("call fit(demonstrations) before asking for a plan")
        located, locating = self.context.locate(observation, self._written)
        watch = Stopwatch()
        with watch.stage("gaussian process"):
            mean, deviation = self.process_.predict(located.keypoints.reshape(1, -1))
        candidate = Trajectory.from_actions(mean.reshape(self._shape))
        notes = (*self.context.extractor.notes_, *located.notes)
        plan = robust_plan(Proposal(located, (candidate,), Usage((locating, *watch.stages)), notes))
        return replace(plan, scale=np.full(self._shape, deviation[0]), confidence=None)

    def executions(self, plan: Plan) -> tuple[Trajectory, ...]:
        """The prediction."""
        return (plan.trajectory,)
