"""Demonstrations as text for a language model, and its answers as trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from robust_instant_policy.context.alignment import align
from robust_instant_policy.context.codec import (
    MM,
    millimetres,
    read_rows,
    row_grammar,
    row_pattern,
    rows_grammar,
    rows_pattern,
    write_row,
)
from robust_instant_policy.context.frames import WORLD, Frame, candidate_frames, choose_frames, poses_in
from robust_instant_policy.errors import InvalidValueError, PlanningError
from robust_instant_policy.geometry import FloatArray, invert_pose, transform_points
from robust_instant_policy.query import Query
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX, Trajectory

AGREE_MM = 1.0  # a number on which all demonstrations agree this closely is not asked for
MIN_DEMOS_TO_AGREE = 3
INPUTS_PER_QUERY = 2  # keypoint coordinates shown with each example
NOISE_MM = 5.0  # variation of a coordinate that says nothing
STEPS_PER_QUERY = 4  # neighbouring steps asked for together: they share the examples' inputs
TOKENS_PER_NUMBER = 6  # upper bound for a number with its separator
REACH_MM = 5000.0  # numbers beyond this are no place a robot can go

INSTRUCTION = (
    "Each example maps numbers to numbers. Find the rule and complete the last example. "
    "Answer with the missing numbers only, in the same layout, without any other words."
)

Layout = Literal["sequence", "factorised"]
Frames = Literal["world", "adaptive"]
Order = Literal["given", "nearest-last"]


@dataclass(frozen=True, eq=False)
class _Question:
    """What one query asks: the numbers ``asked`` (step, dimension) of an arm's neighbouring steps written in one frame.

    ``digits`` bounds the length of each, ``inputs`` are the keypoint coordinates shown with it (in the frame of the
    ``arm`` at ``step``), and ``examples`` has a line for each demonstration.
    """

    arm: int
    step: int
    asked: tuple[tuple[int, int], ...]
    digits: tuple[int, ...]
    inputs: tuple[int, ...]
    examples: tuple[str, ...]


class InContextPrompt:
    """Writes prompts from demonstrations and reads the answers.

    ``frames="world"`` writes every number in the world frame, ``"adaptive"`` each step of each arm in the frame in
    which the demonstrations agree best. ``layout="sequence"`` puts whole trajectories into one prompt (with the world
    frame this is Keypoint Action Tokens, Di Palo and Johns 2024); ``"factorised"`` asks for each step by itself.

    ``order="nearest-last"`` puts the demonstrations whose keypoints lie nearest to the new scene's at the end, at
    the cost that a model cannot go on from what it read for the last scene, as it can with ``"given"``.

    After `fit`, ``frames_`` lists for each arm the frame of each step. Evenly spread over the trajectories to come,
    ``bends_ (B,)``, metres, says how sharply the gripper turns (see `AlignedDemonstrations.usual_bends`), and
    ``variation_ (B,)``, metres, how far the demonstrations differ in those frames, as the standard deviation of a
    point's coordinate; None in the world's frame, where they differ as the scenes do, and of a single demonstration.
    """

    def __init__(self, frames: Frames = "adaptive", layout: Layout = "factorised", order: Order = "given"):
        if frames not in ("world", "adaptive"):
            raise InvalidValueError(f"frames must be 'world' or 'adaptive', got {frames!r}")
        if layout not in ("sequence", "factorised"):
            raise InvalidValueError(f"layout must be 'sequence' or 'factorised', got {layout!r}")
        if order not in ("given", "nearest-last"):
            raise InvalidValueError(f"order must be 'given' or 'nearest-last', got {order!r}")
        self.frames, self.layout, self.order = frames, layout, order

    def fit(self, keypoints: FloatArray, trajectories: Sequence[Trajectory]) -> InContextPrompt:
        """Learn nothing but what to write: ``keypoints (I, K, 3)`` metres and a trajectory of each demonstration."""
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
        self._num_keypoints = keypoints.shape[1]
        self._num_arms = widths.pop() // ACTION_DIM
        if self.frames == "world" and self.layout == "sequence":
            # The paper's prompt: trajectories as they are, whatever their lengths and wherever the gripper changes.
            bends = align(trajectories).usual_bends()
            self.bends_ = np.full_like(bends, bends.max())
            self.variation_: FloatArray | None = None
            self._lengths = [len(trajectory) for trajectory in trajectories]
            self.frames_: list[list[Frame]] = [[WORLD] * max(self._lengths)] * self._num_arms
            self._keypoints = keypoints
            self._write_sequences([_world_rows(trajectory) for trajectory in trajectories])
            return self
        aligned = align(trajectories)
        self.bends_ = aligned.usual_bends()
        self._keypoints = keypoints[list(aligned.kept)]
        self._lengths = [aligned.actions.shape[1]]
        self._choose_frames(aligned.actions, aligned.key_steps)
        pairs = list(zip(self._keypoints, aligned.actions, strict=True))
        numbers = np.stack([self._encode(points, actions) for points, actions in pairs])
        self.variation_ = self._variation(numbers) if self.frames == "adaptive" and len(numbers) > 1 else None
        if self.layout == "sequence":
            self._write_sequences(list(np.round(numbers)))
        else:
            shown = np.stack([self._inputs(points) for points in self._keypoints])
            self._numbers = numbers
            self._centre = np.round(np.median(numbers, axis=0))
            questions = (
                _ask(arm, steps, numbers - self._centre, shown)
                for arm, frames in enumerate(self.frames_)
                for steps in _neighbours(frames, STEPS_PER_QUERY)
            )
            self._questions = [question for question in questions if question.asked]
        return self

    def queries(self, keypoints: FloatArray) -> list[Query]:
        """What to ask for a scene with ``keypoints (K, 3)``: one query for sequences, one a step otherwise."""
        keypoints = self._checked(keypoints)
        order = self._order(keypoints)
        if self.layout == "sequence":
            columns = ACTION_DIM * self._num_arms
            form = (min(self._lengths), max(self._lengths), columns, range(STATE_INDEX, columns, ACTION_DIM))
            return [
                Query(
                    "".join(self._examples[demo] for demo in order) + _sequence_input(keypoints),
                    max_tokens=max(self._lengths) * columns * TOKENS_PER_NUMBER,
                    grammar=rows_grammar(*form),
                    pattern=rows_pattern(*form),
                    stop=("\n\n",),
                    instruction=INSTRUCTION,
                )
            ]
        inputs = self._inputs(keypoints)
        return [
            Query(
                "".join(asked.examples[demo] for demo in order) + _shown(inputs[asked.step, asked.arm], asked.inputs),
                max_tokens=sum(asked.digits) + 2 * len(asked.digits) + 1,
                grammar=row_grammar(asked.digits),
                pattern=row_pattern(asked.digits),
                stop=("\n",),
                instruction=INSTRUCTION,
            )
            for asked in self._questions
        ]

    def accepts(self, query_index: int, text: str) -> bool:
        """Whether the answer ``text`` to a query can be read for certain."""
        return self._read(query_index, text) is not None

    def trajectory(self, texts: Sequence[str], keypoints: FloatArray) -> Trajectory:
        """The trajectory that one answer to each query stands for, in the scene of ``keypoints (K, 3)``.

        Raises `PlanningError`, with the answer's words, for one that cannot be read.
        """
        keypoints = self._checked(keypoints)
        parts = []
        for index, text in enumerate(texts):
            numbers = self._read(index, text)
            if numbers is None:
                raise PlanningError(f"the language model's answer cannot be read as numbers: {_excerpt(text)}")
            parts.append(numbers)
        if self.layout == "sequence":
            rows = parts[0]
            if self.frames == "world":
                return Trajectory.from_actions(_from_world_rows(rows))
            total = self._lengths[0]
            return Trajectory(self._decode(keypoints, rows), np.linspace(0, 1, total)[: len(rows)])
        rows = self._centre.copy()
        for question, offsets in zip(self._questions, parts, strict=True):
            for (step, dim), offset in zip(question.asked, offsets, strict=True):
                rows[step, dim] += offset
        return Trajectory.from_actions(self._decode(keypoints, rows))

    def median_trajectory(self, keypoints: FloatArray) -> Trajectory:
        """What the frames alone say, without a model: in each step's frame the demonstrations' median.

        A reference to measure models against. Only for ``layout="factorised"``.
        """
        return Trajectory.from_actions(self._decode(self._checked(keypoints), self._centre))

    def carried_over(self, keypoints: FloatArray, count: int) -> tuple[Trajectory, ...]:
        """The ``count`` demonstrations nearest to the scene of ``keypoints (K, 3)``, the nearest first, each carried
        over to it: its numbers stay as they are in each step's frame, and the frames move with the keypoints.

        What can be done without a model. Only for ``layout="factorised"``.
        """
        keypoints = self._checked(keypoints)
        nearest = self._from_furthest_to_nearest(keypoints)[::-1][:count]
        return tuple(Trajectory.from_actions(self._decode(keypoints, self._numbers[demo])) for demo in nearest)

    def _read(self, query_index: int, text: str) -> FloatArray | None:
        if self.layout == "factorised":
            question = self._questions[query_index]
            answer = read_rows(text, len(question.asked))
            if answer is None or np.abs(answer[0]).max() > REACH_MM:
                return None
            numbers = answer[0]
            for (step, dim), number in zip(question.asked, numbers, strict=True):
                if dim % ACTION_DIM == STATE_INDEX and number + self._centre[step, dim] not in (0, 1):
                    return None
            return numbers
        rows = read_rows(text, ACTION_DIM * self._num_arms)
        if rows is None or np.abs(rows).max() > REACH_MM:
            return None
        if not np.isin(rows[:, STATE_INDEX::ACTION_DIM], (0, 1)).all():
            return None
        if len(rows) < min(self._lengths) - 1:
            return None
        return rows[: max(self._lengths)]

    def _write_sequences(self, rows: Sequence[np.ndarray]) -> None:
        self._examples = [
            _sequence_input(points) + "".join(write_row(row) + "\n" for row in own) + "\n"
            for points, own in zip(self._keypoints, rows, strict=True)
        ]

    def _order(self, keypoints: FloatArray) -> list[int]:
        """The demonstrations in the order in which they are shown."""
        if self.order == "nearest-last":
            return self._from_furthest_to_nearest(keypoints)
        return list(range(len(self._keypoints)))

    def _from_furthest_to_nearest(self, keypoints: FloatArray) -> list[int]:
        """The demonstrations by the mean distance of their keypoints from ``keypoints (K, 3)``."""
        distances = np.linalg.norm(self._keypoints - keypoints, axis=-1).mean(axis=-1)
        return sorted(range(len(distances)), key=lambda demo: -distances[demo])

    def _choose_frames(self, actions: FloatArray, key_steps: Sequence[int]) -> None:
        steps = actions.shape[1]
        if self.frames == "world":
            self.frames_ = [[WORLD] * steps] * self._num_arms
            return
        candidates = candidate_frames(self._keypoints)
        poses = poses_in(candidates, self._keypoints)
        rows = actions.reshape(len(actions), steps, self._num_arms, ACTION_DIM)[..., :STATE_INDEX]
        triplets = rows.reshape(*rows.shape[:-1], 3, 3)
        self.frames_ = [
            [candidates[index] for index in choose_frames(candidates, poses, triplets[:, :, arm], key_steps)]
            for arm in range(self._num_arms)
        ]

    def _poses(self, keypoints: FloatArray) -> FloatArray:
        """Pose of the frame of each step and arm ``(T, A, 4, 4)``."""
        frames = [frame for of_step in zip(*self.frames_, strict=True) for frame in of_step]
        return poses_in(frames, keypoints[None])[:, 0].reshape(-1, self._num_arms, 4, 4)

    def _encode(self, keypoints: FloatArray, actions: FloatArray) -> FloatArray:
        """Numbers ``(T, 10·A)``: in each step's frame, in millimetres, the point between the fingertips, then the palm
        and the first fingertip as seen from it; the gripper's state."""
        rows = actions.reshape(len(actions), self._num_arms, ACTION_DIM).copy()
        for poses, row in zip(self._poses(keypoints), rows, strict=True):
            for pose, arm in zip(poses, row, strict=True):
                palm, left, right = transform_points(invert_pose(pose), arm[:STATE_INDEX].reshape(3, 3))
                centre = (left + right) / 2
                arm[:STATE_INDEX] = MM * np.concatenate([centre, palm - centre, left - centre])
        return rows.reshape(len(actions), -1)

    def _decode(self, keypoints: FloatArray, numbers: FloatArray) -> FloatArray:
        """The inverse of `_encode` for the first ``len(numbers)`` steps."""
        rows = numbers.reshape(len(numbers), self._num_arms, ACTION_DIM).copy()
        for poses, row in zip(self._poses(keypoints), rows, strict=False):
            for pose, arm in zip(poses, row, strict=True):
                arm[:STATE_INDEX] = transform_points(pose, _points(arm / MM)).ravel()
        return rows.reshape(len(numbers), -1)

    def _variation(self, numbers: FloatArray) -> FloatArray:
        """Metres ``(T,)``, from the numbers of all demonstrations ``(I, T, 10·A)``."""
        points = _points(numbers.reshape(*numbers.shape[:2], self._num_arms, ACTION_DIM))
        return np.sqrt(points.var(axis=0, ddof=1).mean(axis=(1, 2, 3))) / MM

    def _inputs(self, keypoints: FloatArray) -> FloatArray:
        """The keypoints in the frame of each step and arm, in millimetres ``(T, A, 3·K)``."""
        poses = self._poses(keypoints)
        shown = [MM * transform_points(invert_pose(pose), keypoints).ravel() for pose in poses.reshape(-1, 4, 4)]
        return np.reshape(shown, (*poses.shape[:2], -1))

    def _checked(self, keypoints: FloatArray) -> FloatArray:
        keypoints = np.asarray(keypoints, dtype=np.float64)
        if keypoints.shape != (self._num_keypoints, 3) or not np.isfinite(keypoints).all():
            raise InvalidValueError(f"keypoints must be ({self._num_keypoints}, 3) and finite, got {keypoints.shape}")
        return keypoints


def _neighbours(frames: Sequence[Frame], most: int) -> list[tuple[int, ...]]:
    """Runs of at most ``most`` steps in the same frame, or on one way, of nearly equal length within each run."""
    starts = [0, *(step for step in range(1, len(frames)) if not frames[step].goes_with(frames[step - 1])), len(frames)]
    blocks = []
    for start, stop in pairwise(starts):
        for part in np.array_split(np.arange(start, stop), -(-(stop - start) // most)):
            blocks.append(tuple(int(step) for step in part))
    return blocks


def _ask(arm: int, steps: Sequence[int], offsets: FloatArray, shown: FloatArray) -> _Question:
    """The question about ``steps`` of ``arm``, from the demonstrations' ``offsets (I, T, 10·A)`` from their median and
    the ``shown (I, T, A, 3·K)`` keypoints, all in millimetres."""
    whole = np.round(offsets).astype(int)
    reach = np.abs(whole).max(axis=0)
    is_state = np.arange(offsets.shape[2]) % ACTION_DIM == STATE_INDEX
    if len(offsets) >= MIN_DEMOS_TO_AGREE:
        varies = np.where(is_state, reach > 0, np.abs(offsets).max(axis=0) > AGREE_MM)
    else:  # too few to tell what always stays the same
        varies = np.broadcast_to(~is_state, reach.shape)
    own = range(ACTION_DIM * arm, ACTION_DIM * (arm + 1))
    asked = tuple((step, dim) for step in steps for dim in own if varies[step, dim])
    if not asked:
        return _Question(arm, steps[0], (), (), (), ())
    rows = np.stack([whole[:, step, dim] for step, dim in asked], axis=1)
    digits = tuple(max(1, len(str(round(1.5 * reach[step, dim])))) for step, dim in asked)
    seen = shown[:, steps[0], arm]
    inputs = _telling_inputs(seen, rows)
    examples = tuple(_shown(points, inputs) + write_row(row) + "\n" for points, row in zip(seen, rows, strict=True))
    return _Question(arm, steps[0], asked, digits, inputs, examples)


def _telling_inputs(shown: FloatArray, outputs: FloatArray) -> tuple[int, ...]:
    """The few of ``shown (I, 3·K)`` keypoint coordinates that tell most about the ``outputs (I, D)``.

    One after the other the coordinate along which the outputs vary most together (orthogonal matching pursuit), so
    that no two say the same.
    """
    inputs = shown - shown.mean(axis=0)
    rest = outputs - outputs.mean(axis=0)
    chosen: list[int] = []
    for _ in range(min(INPUTS_PER_QUERY, shown.shape[1])):
        scale = np.linalg.norm(inputs, axis=0) + NOISE_MM * np.sqrt(len(shown))
        strength = np.linalg.norm((inputs / scale).T @ rest, axis=1)
        strength[chosen] = -1.0
        best = int(np.argmax(strength))
        chosen.append(best)
        along = inputs[:, best] / max(float(np.linalg.norm(inputs[:, best])), 1e-9)
        rest = rest - np.outer(along, along @ rest)
        inputs = inputs - np.outer(along, along @ inputs)
    return tuple(sorted(chosen))


def _shown(inputs: FloatArray, chosen: Sequence[int]) -> str:
    # A line of its own: after a space, models would have to write a minus otherwise than in the examples, where space
    # and minus are one token.
    return write_row(np.round(inputs[list(chosen)])) + "\n"


def _sequence_input(keypoints: FloatArray) -> str:
    return write_row(millimetres(keypoints).ravel()) + "\n"


def _points(numbers: FloatArray) -> FloatArray:
    """Palm and fingertips ``(..., 3, 3)`` in a frame, from an arm's numbers ``(..., 10)`` in it."""
    centre, palm, left = np.moveaxis(numbers[..., :STATE_INDEX].reshape(*numbers.shape[:-1], 3, 3), -2, 0)
    return np.stack([centre + palm, centre + left, centre - left], axis=-2)


def _world_rows(trajectory: Trajectory) -> np.ndarray:
    rows = millimetres(trajectory.actions)
    rows[:, STATE_INDEX::ACTION_DIM] = np.round(trajectory.gripper_state)
    return rows


def _from_world_rows(rows: FloatArray) -> FloatArray:
    actions = rows / MM
    actions[:, STATE_INDEX::ACTION_DIM] = rows[:, STATE_INDEX::ACTION_DIM]
    return actions


def _excerpt(text: str, length: int = 80) -> str:
    shown = " ".join(text.split())
    return repr(shown if len(shown) <= length else shown[:length] + "…")
