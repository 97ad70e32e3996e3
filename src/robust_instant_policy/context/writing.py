"""Select frames and serialise the demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

import numpy as np

from robust_instant_policy.context.alignment import align
from robust_instant_policy.context.factorised import FactorisedPrompt, make_questions
from robust_instant_policy.context.prompt import Frames, Layout, Order, Prompt
from robust_instant_policy.context.sequence import SequencePrompt, raw_rows, sequence_example
from robust_instant_policy.context.step_frames import StepFrames
from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.trajectory import ACTION_DIM, Trajectory


def write_prompt(
    keypoints: FloatArray,
    trajectories: Sequence[Trajectory],
    frames: Frames = "adaptive",
    layout: Layout = "factorised",
    order: Order = "given",
) -> Prompt:
    """The prompt for demonstrations with ``keypoints (I, K, 3)``, metres, world, and a trajectory each.

    ``frames="world"`` writes every number in the world frame, ``"adaptive"`` each step of each arm in the frame in
    which the demonstrations agree best. ``layout="sequence"`` puts whole trajectories into one query (with the world
    frame these are the Keypoint Action Tokens of the paper); ``"factorised"`` asks for blocks of steps. For ``order``
    see `Prompt`. Raises `InvalidValueError` for other settings and for demonstrations that do not fit together.
    """
    for name, value, known in (("frames", frames, Frames), ("layout", layout, Layout), ("order", order, Order)):
        if value not in get_args(known):
            raise InvalidValueError(f"{name} must be {' or '.join(map(repr, get_args(known)))}, got {value!r}")
    keypoints = np.asarray(keypoints, dtype=np.float64)
    if keypoints.ndim != 3 or keypoints.shape[2] != 3 or not len(keypoints):
        raise InvalidValueError(f"keypoints must be (I, K, 3), got {keypoints.shape}")
    if not np.isfinite(keypoints).all():
        raise InvalidValueError(f"keypoints {keypoints.shape} hold values that are not finite")
    if len(trajectories) != len(keypoints):
        raise InvalidValueError(f"{len(keypoints)} sets of keypoints for {len(trajectories)} trajectories")
    widths = {trajectory.actions.shape[1] for trajectory in trajectories}
    if len(widths) > 1:
        raise InvalidValueError(f"demonstrations differ in their number of arms: action widths {sorted(widths)}")
    num_arms = widths.pop() // ACTION_DIM

    aligned = align(trajectories)
    bounds = aligned.curvature()
    if frames == "world" and layout == "sequence":  # as in the paper: trajectories as they are, each of its own length
        lengths = [len(trajectory) for trajectory in trajectories]
        pairs = zip(keypoints, map(raw_rows, trajectories), strict=True)
        return SequencePrompt(
            keypoints,
            StepFrames.world(max(lengths), num_arms),
            np.full_like(bounds, bounds.max()),
            variation=None,
            order=order,
            examples=tuple(sequence_example(points, rows) for points, rows in pairs),
            lengths=(min(lengths), max(lengths)),
            raw=True,
        )
    keypoints, actions = keypoints[list(aligned.kept)], aligned.actions
    num_steps = actions.shape[1]
    if frames == "world":
        chosen = StepFrames.world(num_steps, num_arms)
    else:
        chosen = StepFrames.adaptive(keypoints, actions, aligned.key_steps)
    numbers = np.stack([chosen.encode(points, own) for points, own in zip(keypoints, actions, strict=True)])
    variation = chosen.variation(numbers) if frames == "adaptive" and len(numbers) > 1 else None
    if layout == "sequence":
        pairs = zip(keypoints, np.round(numbers), strict=True)
        examples = tuple(sequence_example(points, rows) for points, rows in pairs)
        return SequencePrompt(
            keypoints, chosen, bounds, variation, order, examples, lengths=(num_steps, num_steps), raw=False
        )
    median = np.round(np.median(numbers, axis=0))
    questions = make_questions(chosen, keypoints, numbers, median)
    return FactorisedPrompt(keypoints, chosen, bounds, variation, order, numbers, median, questions)
