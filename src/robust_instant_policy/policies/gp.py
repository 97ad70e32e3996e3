"""A Gaussian process from keypoints to each step: a fast baseline for the language models."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from robust_instant_policy.context.codec import MM
from robust_instant_policy.context.step_frames import StepFrames
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies.aggregation import agree, make_plan
from robust_instant_policy.policies.context import Context, LocatedScene
from robust_instant_policy.policies.keypoint_policy import KeypointPolicy
from robust_instant_policy.policies.policy import Plan, Stopwatch
from robust_instant_policy.policies.sampling import Proposal
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


class KeypointRegression(KeypointPolicy):
    """The trajectory as a Gaussian process of the scene's keypoints.

    It predicts how a step's numbers in its frame differ from the demonstrations' median: with ``frames="world"`` the
    whole motion, with ``"adaptive"`` what the frames do not carry over.
    """

    name = "gp"
    ways_: tuple[tuple[StepFrames, FloatArray, GaussianProcess], ...]

    def fit_context(self, context: Context) -> Self:
        """Find the kernel's parameters for each way to act, in a fraction of a second; returns itself."""
        super().fit_context(context)
        aligned = context.prompt.aligned
        if self.settings.frames == "world":
            num_steps = aligned.actions.shape[1]
            ways = [(StepFrames.world(num_steps, aligned.num_arms), aligned.kept)]
        else:
            ways = [(way.frames, way.shown) for way in context.prompt.ways]
        self.ways_ = tuple(
            _fitted(
                frames,
                context.keypoints[list(shown)],
                aligned.actions[[aligned.kept.index(demo) for demo in shown]],
            )
            for frames, shown in ways
        )
        return self

    def plan_scene(self, scene: LocatedScene) -> Plan:
        way = 0 if len(self.ways_) == 1 else self.context_.prompt.decide(scene.keypoints)[0]
        frames, median, process = self.ways_[way]
        watch = Stopwatch()
        with watch.stage("gaussian process"):
            residual, deviation = process.predict(scene.keypoints.reshape(1, -1))
            numbers = median + MM * residual.reshape(median.shape)
            trajectory = Trajectory.from_actions(frames.decode(scene.keypoints, numbers))
        proposal = Proposal((trajectory,), tuple(watch.stages))
        regression = Stopwatch()
        with regression.stage("regression"):  # of one candidate: a rigid gripper, open or closed
            rigid = replace(agree(proposal, self.settings), scale=np.full(median.shape, deviation[0]))
        return make_plan(self.context_, scene, proposal, rigid, regression.stages)


def _fitted(
    frames: StepFrames, keypoints: FloatArray, actions: FloatArray
) -> tuple[StepFrames, FloatArray, GaussianProcess]:
    """``frames``, the median in them of ``actions (I, T, 10·A)`` in scenes with ``keypoints (I, K, 3)``, and the
    process of the differences from it."""
    numbers = frames.encode(frames.poses(keypoints), actions)
    median = np.median(numbers, axis=0)
    residuals = (numbers - median) / MM
    inputs = keypoints.reshape(len(keypoints), -1)
    return frames, median, GaussianProcess.fitted(inputs, residuals.reshape(len(keypoints), -1))
