"""Select frames and serialise the demonstrations."""

from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.checks import checked_array
from robust_instant_policy.context.alignment import AlignedDemonstrations, align
from robust_instant_policy.context.discovery import find_things
from robust_instant_policy.context.factorised import FactorisedPrompt, as_turns, make_questions
from robust_instant_policy.context.prompt import Frames, Layout, Prompt
from robust_instant_policy.context.sequence import SequencePrompt, raw_rows, sequence_example
from robust_instant_policy.context.step_frames import StepFrames, hands_of
from robust_instant_policy.context.things import WORLD, locate
from robust_instant_policy.context.ways import find_ranking, find_split
from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.trajectory import ACTION_DIM, Trajectory


def write_prompt(
    keypoints: FloatArray,
    trajectories: Sequence[Trajectory],
    frames: Frames = "adaptive",
    layout: Layout = "factorised",
) -> Prompt:
    """The prompt for demonstrations with ``keypoints (I, K, 3)``, metres, world, and a trajectory each.

    ``frames="world"`` writes every number in the world frame, ``"adaptive"`` each step of each arm in the frame in
    which the demonstrations agree best. ``layout="sequence"`` puts whole trajectories into one query (with the world
    frame these are the Keypoint Action Tokens of the paper); ``"factorised"`` asks for blocks of steps.
    Raises `InvalidValueError` for other settings and for demonstrations that do not fit together.
    """
    for name, value, known in (("frames", frames, Frames), ("layout", layout, Layout)):
        if value not in get_args(known):
            raise InvalidValueError(f"{name} must be {' or '.join(map(repr, get_args(known)))}, got {value!r}")
    keypoints = checked_array("keypoints", keypoints, "(I, K, 3)")
    if len(trajectories) != len(keypoints) or not trajectories:
        raise InvalidValueError(f"{len(keypoints)} sets of keypoints for {len(trajectories)} trajectories")
    widths = {trajectory.actions.shape[1] for trajectory in trajectories}
    if len(widths) > 1:
        raise InvalidValueError(f"demonstrations differ in their number of arms: action widths {sorted(widths)}")
    num_arms = widths.pop() // ACTION_DIM

    aligned = align(trajectories)
    kept = keypoints[list(aligned.kept)]
    if layout == "factorised" and frames == "adaptive":
        return adaptive_prompt(kept, aligned)
    if layout == "factorised":
        world = StepFrames.world(aligned.actions.shape[1], num_arms)
        return replace(_factorised(world, kept, aligned, np.arange(len(kept))), variation=None)
    if frames == "adaptive":
        return _sequence(kept, aligned)
    # as in the paper: trajectories as they are, each of its own length
    lengths = [len(trajectory) for trajectory in trajectories]
    return SequencePrompt(
        keypoints,
        aligned,
        StepFrames.world(max(lengths), num_arms),
        variation=None,
        shown=tuple(range(len(keypoints))),
        examples=tuple(map(sequence_example, keypoints, map(raw_rows, trajectories))),
        lengths=(min(lengths), max(lengths)),
        raw=True,
    )


def adaptive_prompt(keypoints: FloatArray, aligned: AlignedDemonstrations) -> FactorisedPrompt:
    """The factorised prompt in adaptive frames of ``aligned`` demonstrations with ``keypoints (I, K, 3)``.

    One prompt for each way to act, within the prompt of the way that more demonstrations go.
    """
    hands = hands_of(aligned.actions[:, list(aligned.key_steps)])
    ranking = find_ranking(keypoints, hands)
    named = keypoints if ranking is None else ranking.renamed(keypoints)
    things = find_things(named)
    split = find_split(things, locate([WORLD, *things], named), hands)

    def way(shown: NDArray[np.bool_], among: NDArray[np.bool_], second: NDArray[np.bool_] | None) -> FactorisedPrompt:
        """The prompt that shows some demonstrations, in the frames that suit all those ``among`` which they are."""
        frames = StepFrames.adaptive(named[among], aligned.actions[among], aligned.key_steps, things, ranking, second)
        return _factorised(frames, keypoints, aligned, np.flatnonzero(shown))

    every = np.ones(len(named), dtype=bool)
    if split is None:
        return way(every, every, None)
    sides = (~split.second, split.second)
    ways = tuple(way(side, every, split.second) if split.alike else way(side, side, None) for side in sides)
    return replace(max(ways, key=lambda one: len(one.shown)), split=split, parts=ways)


def _sequence(keypoints: FloatArray, aligned: AlignedDemonstrations) -> SequencePrompt:
    frames = StepFrames.adaptive(keypoints, aligned.actions, aligned.key_steps, find_things(keypoints))
    numbers = frames.encode(frames.poses(keypoints), aligned.actions)
    steps = aligned.actions.shape[1]
    return SequencePrompt(
        keypoints,
        aligned,
        frames,
        frames.variation(numbers),
        aligned.kept,
        examples=tuple(map(sequence_example, keypoints, np.round(numbers))),
        lengths=(steps, steps),
        raw=False,
    )


def _factorised(
    frames: StepFrames, keypoints: FloatArray, aligned: AlignedDemonstrations, shown: np.ndarray
) -> FactorisedPrompt:
    """The prompt of those of the ``aligned`` demonstrations whose indices are ``shown``."""
    keypoints = keypoints[shown]
    poses = frames.poses(keypoints)
    numbers = frames.encode(poses, aligned.actions[shown])
    hands, reference = as_turns(numbers)
    median = np.round(np.median(hands, axis=0))
    questions = make_questions(frames, frames.inputs(poses, keypoints), hands - median, aligned.key_steps)
    return FactorisedPrompt(
        keypoints,
        aligned,
        frames,
        frames.variation(numbers),
        tuple(aligned.kept[index] for index in shown),
        hands,
        median,
        reference,
        questions,
    )
