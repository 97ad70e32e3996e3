"""How well demonstrations predict each other when one is left out."""

from collections.abc import Sequence

import numpy as np

from robust_instant_policy.context.codec import MM
from robust_instant_policy.context.factorised import FactorisedPrompt, informative_inputs
from robust_instant_policy.context.prompt import Prompt
from robust_instant_policy.context.writing import adaptive_prompt
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX

MIN_DEMOS = 3  # with fewer, nothing is left to learn from
RIDGE_MM = 20.0  # standard deviation of an input below which it explains little


def leave_one_out(prompt: Prompt) -> FloatArray:
    """Error ``(I, S)``, metres, with which each demonstration is predicted from the others, at S key steps.

    Predicted are the gripper point and the fingertips of each arm in the frames of the steps, from the demonstrations
    that go the same way, by ridge regression on the keypoint coordinates that a language model would be shown; the
    error is that of the worst point. Frames and ways are those of the adaptive, factorised prompt. Key steps are the
    first and the last one and both sides of every gripper change. NaN with fewer than `MIN_DEMOS` demonstrations that
    use the gripper alike.
    """
    aligned = prompt.aligned
    errors = np.zeros((len(aligned.kept), len(aligned.key_steps)))
    if len(errors) < MIN_DEMOS:
        return np.full_like(errors, np.nan)
    if not isinstance(prompt, FactorisedPrompt) or prompt.variation is None:
        prompt = adaptive_prompt(prompt.keypoints[[prompt.shown.index(demo) for demo in aligned.kept]], aligned)
    for way in prompt.ways:
        rows = [aligned.kept.index(demo) for demo in way.shown]
        errors[rows] = _errors(way, aligned.actions[rows], aligned.key_steps)
    return errors


def _errors(way: FactorisedPrompt, actions: FloatArray, key_steps: Sequence[int]) -> FloatArray:
    errors = np.zeros((len(actions), len(key_steps)))
    poses = way.frames.poses(way.keypoints)
    numbers, shown = way.frames.encode(poses, actions), way.frames.inputs(poses, way.keypoints)
    for column, step in enumerate(key_steps):
        for arm in range(way.frames.num_arms):
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
