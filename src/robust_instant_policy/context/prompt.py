"""Demonstrations as text for a language model, and its answers as trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from robust_instant_policy.context.alignment import align
from robust_instant_policy.context.codec import (
    MM,
    millimetres,
    read_row,
    read_rows,
    row_grammar,
    row_pattern,
    write_row,
)
from robust_instant_policy.context.frames import WORLD, Frame, candidate_frames, choose_frames
from robust_instant_policy.errors import InvalidValueError, PlanningError
from robust_instant_policy.geometry import FloatArray, invert_pose, transform_points
from robust_instant_policy.query import Query
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX, Trajectory

AGREE_MM = 1.0  # a number on which all demonstrations agree this closely is not asked for
MIN_DEMOS_TO_AGREE = 3
INPUTS_PER_STEP = 3  # keypoint coordinates shown with each step
TOKENS_PER_NUMBER = 6  # upper bound for a number with its separator
REACH_MM = 5000.0  # numbers beyond this are no place a robot can go

INSTRUCTION = (
    "Each example maps numbers to numbers. Find the rule and complete the last example. "
    "Answer with the missing numbers only, in the same layout, without any other words."
)

Layout = Literal["sequence", "factorised"]
Frames = Literal["world", "adaptive"]


@dataclass(frozen=True, eq=False)
class _Step:
    """What one step asks for: ``asked`` of its numbers vary, the others are those of ``centre`` (mm)."""

    centre: FloatArray
    asked: tuple[int, ...]
    digits: tuple[int, ...]
    inputs: tuple[int, ...]
    examples: str


class InContextPrompt:
    """Writes prompts from demonstrations and reads the answers.

    ``frames="world"`` writes every number in the world frame, ``"adaptive"`` each step in the frame in which the
    demonstrations agree best. ``layout="sequence"`` puts whole trajectories into one prompt (with the world frame
    this is Keypoint Action Tokens, Di Palo and Johns 2024); ``"factorised"`` asks for each step by itself.

    After `fit`, ``frames_`` lists the frame of each step.
    """

    def __init__(self, frames: Frames = "adaptive", layout: Layout = "factorised"):
        if frames not in ("world", "adaptive"):
            raise InvalidValueError(f"frames must be 'world' or 'adaptive', got {frames!r}")
        if layout not in ("sequence", "factorised"):
            raise InvalidValueError(f"layout must be 'sequence' or 'factorised', got {layout!r}")
        self.frames, self.layout = frames, layout

    def fit(self, keypoints: FloatArray, trajectories: Sequence[Trajectory]) -> InContextPrompt:
        """Learn nothing but what to write: ``keypoints (I, K, 3)`` metres and a trajectory of each demonstration."""
        keypoints = np.asarray(keypoints, dtype=np.float64)
        if keypoints.ndim != 3 or keypoints.shape[2] != 3 or not len(keypoints):
            raise InvalidValueError(f"keypoints must be (I, K, 3), got {keypoints.shape}")
        if len(trajectories) != len(keypoints):
            raise InvalidValueError(f"{len(keypoints)} sets of keypoints for {len(trajectories)} trajectories")
        widths = {trajectory.actions.shape[1] for trajectory in trajectories}
        if len(widths) > 1:
            raise InvalidValueError(f"demonstrations differ in their number of arms: action widths {sorted(widths)}")
        self._num_keypoints = keypoints.shape[1]
        self._num_arms = widths.pop() // ACTION_DIM
        if self.frames == "world" and self.layout == "sequence":
            # The paper's prompt: trajectories as they are, whatever their lengths.
            self._lengths = [len(trajectory) for trajectory in trajectories]
            self.frames_: list[Frame] = [WORLD] * max(self._lengths)
            self._prefix = "".join(
                _sequence_input(points) + "".join(write_row(row) + "\n" for row in _world_rows(trajectory)) + "\n"
                for points, trajectory in zip(keypoints, trajectories, strict=True)
            )
            return self
        aligned = align(trajectories)
        keypoints = keypoints[list(aligned.kept)]
        actions = aligned.actions
        self._choose_frames(keypoints, actions, aligned.key_steps)
        self._lengths = [actions.shape[1]]
        numbers = np.stack([self._encode(points, own) for points, own in zip(keypoints, actions, strict=True)])
        shown = np.stack([self._inputs(points) for points in keypoints])
        if self.layout == "sequence":
            self._prefix = "".join(
                _sequence_input(points) + "".join(write_row(row) + "\n" for row in np.round(rows)) + "\n"
                for points, rows in zip(keypoints, numbers, strict=True)
            )
        else:
            self._steps = [_plan_step(numbers[:, step], shown[:, step]) for step in range(actions.shape[1])]
            self._queried = [step for step, plan in enumerate(self._steps) if plan.asked]
        return self

    def queries(self, keypoints: FloatArray) -> list[Query]:
        """What to ask for a scene with ``keypoints (K, 3)``: one query for sequences, one a step otherwise."""
        keypoints = self._checked(keypoints)
        if self.layout == "sequence":
            columns = ACTION_DIM * self._num_arms
            rows = max(self._lengths)
            text = self._prefix + _sequence_input(keypoints)
            return [
                Query(text, max_tokens=rows * columns * TOKENS_PER_NUMBER, stop=("\n\n",), instruction=INSTRUCTION)
            ]
        inputs = self._inputs(keypoints)
        queries = []
        for index in self._queried:
            step = self._steps[index]
            queries.append(
                Query(
                    step.examples + _shown(inputs[index], step.inputs),
                    max_tokens=sum(step.digits) + 2 * len(step.digits) + 1,
                    grammar=row_grammar(step.digits),
                    pattern=row_pattern(step.digits),
                    stop=("\n",),
                    instruction=INSTRUCTION,
                )
            )
        return queries

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
        rows = np.stack([step.centre for step in self._steps])
        for index, offsets in zip(self._queried, parts, strict=True):
            rows[index, list(self._steps[index].asked)] += offsets
        return Trajectory.from_actions(self._decode(keypoints, rows))

    def _read(self, query_index: int, text: str) -> FloatArray | None:
        if self.layout == "factorised":
            step = self._steps[self._queried[query_index]]
            lines = [line for line in text.splitlines() if line.strip()]
            numbers = read_row(lines[0], len(step.asked)) if lines else None
            if numbers is None or np.abs(numbers).max() > REACH_MM:
                return None
            states = [n for n, dim in zip(numbers, step.asked, strict=True) if dim % ACTION_DIM == STATE_INDEX]
            if any(state + step.centre[STATE_INDEX] not in (0, 1) for state in states):
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

    def _choose_frames(self, keypoints: FloatArray, actions: FloatArray, key_steps: Sequence[int]) -> None:
        steps = actions.shape[1]
        if self.frames == "world":
            self.frames_ = [WORLD] * steps
            return
        candidates = candidate_frames(keypoints)
        poses = np.stack([np.stack([frame.pose(points) for points in keypoints]) for frame in candidates])
        triplets = actions.reshape(len(actions), steps, -1, ACTION_DIM)[..., :STATE_INDEX]
        chosen = choose_frames(candidates, poses, triplets.reshape(len(actions), steps, -1, 3), key_steps)
        self.frames_ = [candidates[index] for index in chosen]

    def _poses(self, keypoints: FloatArray) -> FloatArray:
        """Pose of each step's frame ``(T, 4, 4)``."""
        known: dict[int, FloatArray] = {}
        for frame in self.frames_:
            if id(frame) not in known:
                known[id(frame)] = frame.pose(keypoints)
        return np.stack([known[id(frame)] for frame in self.frames_])

    def _encode(self, keypoints: FloatArray, actions: FloatArray) -> FloatArray:
        """Numbers ``(T, 10·A)`` in millimetres in the steps' frames: tool centre, then palm and first fingertip from it."""
        rows = actions.reshape(len(actions), self._num_arms, ACTION_DIM).copy()
        for pose, row in zip(self._poses(keypoints), rows, strict=True):
            for arm in row:
                palm, left, right = transform_points(invert_pose(pose), arm[:STATE_INDEX].reshape(3, 3))
                centre = (left + right) / 2
                arm[:STATE_INDEX] = MM * np.concatenate([centre, palm - centre, left - centre])
        return rows.reshape(len(actions), -1)

    def _decode(self, keypoints: FloatArray, numbers: FloatArray) -> FloatArray:
        """The inverse of `_encode` for the first ``len(numbers)`` steps."""
        rows = numbers.reshape(len(numbers), self._num_arms, ACTION_DIM).copy()
        for pose, row in zip(self._poses(keypoints), rows, strict=False):
            for arm in row:
                centre, palm, left = arm[:STATE_INDEX].reshape(3, 3) / MM
                points = np.stack([centre + palm, centre + left, centre - left])
                arm[:STATE_INDEX] = transform_points(pose, points).ravel()
        return rows.reshape(len(numbers), -1)

    def _inputs(self, keypoints: FloatArray) -> FloatArray:
        """The keypoints in each step's frame, in millimetres ``(T, 3·K)``."""
        return np.stack(
            [MM * transform_points(invert_pose(pose), keypoints).ravel() for pose in self._poses(keypoints)]
        )

    def _checked(self, keypoints: FloatArray) -> FloatArray:
        keypoints = np.asarray(keypoints, dtype=np.float64)
        if keypoints.shape != (self._num_keypoints, 3) or not np.isfinite(keypoints).all():
            raise InvalidValueError(f"keypoints must be ({self._num_keypoints}, 3) and finite, got {keypoints.shape}")
        return keypoints


def _plan_step(numbers: FloatArray, shown: FloatArray) -> _Step:
    """Decide what a step asks, from the demonstrations' ``numbers (I, 10·A)`` and ``shown (I, 3·K)`` keypoints."""
    centre = np.round(np.median(numbers, axis=0))
    offsets = np.round(numbers - centre).astype(int)
    reach = np.abs(offsets).max(axis=0)
    varies = np.abs(numbers - np.median(numbers, axis=0)).max(axis=0) > AGREE_MM
    state = np.arange(len(centre)) % ACTION_DIM == STATE_INDEX
    varies = np.where(state, reach > 0, varies) if len(numbers) >= MIN_DEMOS_TO_AGREE else ~state
    asked = tuple(int(dim) for dim in np.flatnonzero(varies))
    digits = tuple(max(1, len(str(round(1.5 * reach[dim])))) for dim in asked)
    inputs = _telling_inputs(shown, numbers[:, list(asked)]) if asked else ()
    examples = "".join(
        _shown(points, inputs) + write_row(row[list(asked)]) + "\n" for points, row in zip(shown, offsets, strict=True)
    )
    return _Step(centre, asked, digits, inputs, examples)


def _telling_inputs(shown: FloatArray, outputs: FloatArray) -> tuple[int, ...]:
    """The keypoint coordinates that go along with the outputs most, over the demonstrations."""
    a = shown - shown.mean(axis=0)
    b = outputs - outputs.mean(axis=0)
    scale = np.linalg.norm(a, axis=0) + MM * 0.01
    strength = np.linalg.norm((a / scale).T @ b, axis=1)
    return tuple(sorted(int(k) for k in np.argsort(-strength, kind="stable")[:INPUTS_PER_STEP]))


def _shown(inputs: FloatArray, chosen: Sequence[int]) -> str:
    return write_row(np.round(inputs[list(chosen)])) + ": "


def _sequence_input(keypoints: FloatArray) -> str:
    return write_row(millimetres(keypoints).ravel()) + "\n"


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
