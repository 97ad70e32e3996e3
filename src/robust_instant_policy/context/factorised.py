"""A query for each block of neighbouring steps, with only those numbers on which demonstrations differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from robust_instant_policy.context.codec import read_rows, row_grammar, row_pattern, write_row
from robust_instant_policy.context.frames import Frame
from robust_instant_policy.context.prompt import INSTRUCTION, REACH_MM, Prompt
from robust_instant_policy.context.step_frames import StepFrames
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.query import Query
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX, Trajectory

AGREE_MM = 1.0  # a number on which all demonstrations agree this closely is not asked for
MIN_DEMOS_TO_AGREE = 3
INPUTS_PER_QUERY = 2  # keypoint coordinates shown with each example
NOISE_MM = 5.0  # variation of a keypoint coordinate that carries no information
STEPS_PER_QUERY = 4  # neighbouring steps asked for together: they share the examples' inputs


@dataclass(frozen=True, eq=False)
class Question:
    """One query: the numbers ``asked`` (step, dimension) of an arm's neighbouring steps.

    ``digits`` bounds the length of each, ``inputs`` are the keypoint coordinates shown with it (in the frame of the
    ``arm`` at ``step``), and ``examples`` has two lines for each demonstration.
    """

    arm: int
    step: int
    asked: tuple[tuple[int, int], ...]
    digits: tuple[int, ...]
    inputs: tuple[int, ...]
    examples: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class FactorisedPrompt(Prompt):
    """``numbers (I, T, 10·A)`` of the aligned demonstrations, see `StepFrames`; queries ask for differences from their
    ``median (T, 10·A)``, which is in whole millimetres."""

    numbers: FloatArray
    median: FloatArray
    questions: tuple[Question, ...]

    def queries(self, keypoints: FloatArray) -> list[Query]:
        keypoints = self.checked(keypoints)
        inputs = self.frames.inputs(keypoints)
        return [
            Query(
                self.ordered(question.examples, keypoints)
                + _input(inputs[question.step, question.arm], question.inputs),
                max_tokens=sum(question.digits) + 2 * len(question.digits) + 1,
                grammar=row_grammar(question.digits),
                pattern=row_pattern(question.digits),
                stop=("\n",),
                instruction=INSTRUCTION,
            )
            for question in self.questions
        ]

    def read(self, query_index: int, text: str) -> FloatArray | None:
        """Differences from the median ``(D,)``, one for each number that is asked."""
        asked = self.questions[query_index].asked
        rows = read_rows(text, len(asked))
        if rows is None or np.abs(rows).max() > REACH_MM:
            return None
        for (step, dim), number in zip(asked, rows[0], strict=True):
            if dim % ACTION_DIM == STATE_INDEX and number + self.median[step, dim] not in (0, 1):
                return None
        return rows[0]

    def trajectory(self, answers: Sequence[FloatArray], keypoints: FloatArray) -> Trajectory:
        numbers = self.median.copy()
        for question, offsets in zip(self.questions, answers, strict=True):
            for (step, dim), offset in zip(question.asked, offsets, strict=True):
                numbers[step, dim] += offset
        return Trajectory.from_actions(self.frames.decode(self.checked(keypoints), numbers))

    def median_trajectory(self, keypoints: FloatArray) -> Trajectory:
        """The demonstrations' median in each step's frame, without a model: a reference to measure models against."""
        return Trajectory.from_actions(self.frames.decode(self.checked(keypoints), self.median))

    def carried_over(self, keypoints: FloatArray, count: int) -> tuple[Trajectory, ...]:
        """The ``count`` demonstrations nearest to the scene of ``keypoints (K, 3)``, nearest first, each transferred to
        it: its numbers stay the same in each step's frame, and the frames move with the keypoints."""
        keypoints = self.checked(keypoints)
        nearest = self.by_distance(keypoints)[::-1][:count]
        return tuple(Trajectory.from_actions(self.frames.decode(keypoints, self.numbers[demo])) for demo in nearest)


def make_questions(
    frames: StepFrames, keypoints: FloatArray, numbers: FloatArray, median: FloatArray
) -> tuple[Question, ...]:
    """What to ask of demonstrations with ``keypoints (I, K, 3)`` and ``numbers (I, T, 10·A)`` in ``frames``."""
    shown = np.stack([frames.inputs(points) for points in keypoints])
    questions = (
        _question(arm, steps, numbers - median, shown)
        for arm, own in enumerate(frames.arms)
        for steps in _blocks(own, STEPS_PER_QUERY)
    )
    return tuple(question for question in questions if question is not None)


def _blocks(frames: Sequence[Frame], most: int) -> list[tuple[int, ...]]:
    """Runs of at most ``most`` steps whose frames continue each other, of nearly equal length."""
    changes = [step for step in range(1, len(frames)) if not frames[step].continues(frames[step - 1])]
    blocks = []
    for start, stop in pairwise([0, *changes, len(frames)]):
        for part in np.array_split(np.arange(start, stop), -(-(stop - start) // most)):
            blocks.append(tuple(int(step) for step in part))
    return blocks


def _question(arm: int, steps: Sequence[int], offsets: FloatArray, shown: FloatArray) -> Question | None:
    """The question about ``steps`` of ``arm``, from the demonstrations' ``offsets (I, T, 10·A)`` from their median and
    the ``shown (I, T, A, 3·K)`` keypoints, all in millimetres; None where all demonstrations agree."""
    whole = np.round(offsets).astype(int)
    largest = np.abs(whole).max(axis=0)
    is_state = np.arange(offsets.shape[2]) % ACTION_DIM == STATE_INDEX
    if len(offsets) >= MIN_DEMOS_TO_AGREE:
        varies = np.where(is_state, largest > 0, np.abs(offsets).max(axis=0) > AGREE_MM)
    else:
        varies = np.broadcast_to(~is_state, largest.shape)
    own = range(ACTION_DIM * arm, ACTION_DIM * (arm + 1))
    asked = tuple((step, dim) for step in steps for dim in own if varies[step, dim])
    if not asked:
        return None
    rows = np.stack([whole[:, step, dim] for step, dim in asked], axis=1)
    digits = tuple(max(1, len(str(round(1.5 * largest[step, dim])))) for step, dim in asked)
    seen = shown[:, steps[0], arm]
    inputs = _informative_inputs(seen, rows)
    examples = tuple(_input(points, inputs) + write_row(row) + "\n" for points, row in zip(seen, rows, strict=True))
    return Question(arm, steps[0], asked, digits, inputs, examples)


def _informative_inputs(shown: FloatArray, outputs: FloatArray) -> tuple[int, ...]:
    """The `INPUTS_PER_QUERY` of ``shown (I, 3·K)`` keypoint coordinates that explain most of ``outputs (I, D)``, by
    orthogonal matching pursuit."""
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


def _input(inputs: FloatArray, chosen: Sequence[int]) -> str:
    # On a line of its own: after a space, a minus would be tokenised otherwise than in the examples.
    return write_row(np.round(inputs[list(chosen)])) + "\n"
