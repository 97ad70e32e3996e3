"""How well demonstrations predict each other when one is left out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robust_instant_policy.context.alignment import align
from robust_instant_policy.context.codec import MM
from robust_instant_policy.context.factorised import informative_inputs
from robust_instant_policy.context.step_frames import StepFrames
from robust_instant_policy.context.things import find_things
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX, Trajectory

MIN_DEMOS = 3  # with fewer, nothing is left to learn from
RIDGE_MM = 20.0  # standard deviation of an input below which it explains little


def leave_one_out(
    keypoints: FloatArray, trajectories: Sequence[Trajectory], frames: StepFrames | None = None
) -> FloatArray:
    """Error ``(I, S)``, metres, with which each demonstration is predicted from the others, at S key steps.

    Predicted are the gripper point and the fingertips of each arm in the ``frames`` of the steps (by default those in
    which the demonstrations agree best), by ridge regression on the keypoint coordinates that a language model would be
    shown; the error is that of the worst point. Key steps are the first and the last one and both sides of every
    gripper change. ``keypoints (I, K, 3)`` in metres. NaN with fewer than `MIN_DEMOS` demonstrations that do the same.
    """
    aligned = align(trajectories)
    keypoints, actions = keypoints[list(aligned.kept)], aligned.actions
    errors = np.zeros((len(actions), len(aligned.key_steps)))
    if len(actions) < MIN_DEMOS:
        return np.full_like(errors, np.nan)
    if frames is None or len(frames.arms[0]) != actions.shape[1]:
        frames = StepFrames.adaptive(keypoints, actions, aligned.key_steps, find_things(keypoints))
    numbers = np.stack([frames.encode(points, own) for points, own in zip(keypoints, actions, strict=True)])
    shown = np.stack([frames.inputs(points) for points in keypoints])  # (I, T, A, 3·K)
    for column, step in enumerate(aligned.key_steps):
        for arm in range(frames.num_arms):
            outputs = numbers[:, step, ACTION_DIM * arm : ACTION_DIM * arm + STATE_INDEX]
            inputs = shown[:, step, arm]
            chosen = list(informative_inputs(inputs, outputs))
            residuals = ridge_residuals(inputs[:, chosen], outputs).reshape(len(outputs), 3, 3)
            centre, gripper, left = np.moveaxis(residuals, 1, 0)
            points = np.stack([centre + gripper, centre + left, centre - left])
            worst = np.linalg.norm(points, axis=-1).max(axis=0) / MM
            errors[:, column] = np.maximum(errors[:, column], worst)
    return errors


def ridge_residuals(inputs: FloatArray, outputs: FloatArray) -> FloatArray:
    """Residuals ``(I, D)`` of ``outputs (I, D)`` at ``inputs (I, P)``, millimetres, each predicted from all the others.

    Ridge regression with an intercept; the residual without example i is e_i / (1 - h_ii), with the leverage h_ii of
    the fit to all examples (Allen 1974).
    """
    count = len(inputs)
    x = inputs - inputs.mean(axis=0)
    hat = x @ np.linalg.solve(x.T @ x + count * RIDGE_MM**2 * np.eye(x.shape[1]), x.T) + 1 / count
    return (outputs - hat @ outputs) / (1 - np.diag(hat))[:, None]
