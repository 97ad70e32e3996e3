"""A query for each block of neighbouring steps, with only those numbers on which demonstrations differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import interp1d
from scipy.spatial.transform import Rotation

from robust_instant_policy.context.candidates import NOISE_M
from robust_instant_policy.context.codec import MM, read_rows, row_grammar, row_pattern, write_row
from robust_instant_policy.context.frames import Frame, runs
from robust_instant_policy.context.prompt import INSTRUCTION, REACH_MM, Prompt
from robust_instant_policy.context.step_frames import StepFrames
from robust_instant_policy.context.things import WORLD
from robust_instant_policy.context.ways import Split
from robust_instant_policy.geometry import FloatArray, fit_rigid
from robust_instant_policy.query import Query
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX, Trajectory

MIN_DEMOS_TO_AGREE = 3
RIDGE_MM = 20.0  # standard deviation of an input below which it explains little
INPUTS_PER_QUERY = 2  # keypoint coordinates shown with each example
NOISE_MM = 5.0  # variation of a keypoint coordinate that carries no information
INTERPOLATED_MM = 5.0  # a step whose numbers follow from its neighbours this closely is not asked for
LEVER_MM = 100.0  # distance at which turns are written as lengths
ANSWER_MARGIN = 1.5  # an answer may have as many digits as this many times the largest demonstrated number
HAND_DIM, HAND_STATE = 7, 6  # numbers of a hand: point, turn, state
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
    """``numbers (I, T, 7·A)`` of the aligned demonstrations, see `as_turns`; queries ask for differences from their
    ``median (T, 7·A)``, which is in whole millimetres.

    Where demonstrations do different things, ``parts`` are the prompts of their ways, between which ``split`` decides.
    """

    numbers: FloatArray
    median: FloatArray
    reference: FloatArray
    questions: tuple[Question, ...]
    split: Split | None = None
    parts: tuple[FactorisedPrompt, ...] = ()

    @property
    def ways(self) -> tuple[FactorisedPrompt, ...]:
        return self.parts or (self,)

    def decide(self, keypoints: FloatArray) -> tuple[int, float]:
        if self.split is None:
            return super().decide(keypoints)
        return self.split.decide(self.frames.named(self.checked(keypoints)[None])[0])

    def notes(self) -> tuple[str, ...]:
        split = () if self.split is None else (str(self.split),)
        return (*split, *super().notes())

    def queries(self, keypoints: FloatArray) -> list[Query]:
        keypoints = self.checked(keypoints)[None]
        (inputs,) = self.frames.inputs(self.frames.poses(keypoints), keypoints)
        return [
            Query(
                "".join(question.examples) + _input(inputs[question.step, question.arm], question.inputs),
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
            if dim % HAND_DIM == HAND_STATE and number + self.median[step, dim] not in (0, 1):
                return None
        return rows[0]

    def trajectory(self, answers: Sequence[FloatArray], keypoints: FloatArray) -> Trajectory:
        offsets = np.zeros_like(self.median)
        for question, answer in zip(self.questions, answers, strict=True):
            for (step, dim), offset in zip(question.asked, answer, strict=True):
                offsets[step, dim] = offset
            for dim in {dim for _, dim in question.asked}:
                steps = [step for step, own in question.asked if own == dim]
                between = np.arange(steps[0], steps[-1] + 1)
                offsets[between, dim] = np.interp(between, steps, offsets[steps, dim])
        hands = self.median + offsets
        hands[:, HAND_STATE::HAND_DIM] = np.clip(np.round(hands[:, HAND_STATE::HAND_DIM]), 0, 1)
        return self._decoded(keypoints, hands)

    def _decoded(self, keypoints: FloatArray, hands: FloatArray) -> Trajectory:
        numbers = from_turns(hands, self.reference)
        return Trajectory.from_actions(self.frames.decode(self.checked(keypoints), numbers))

    def median_trajectory(self, keypoints: FloatArray) -> Trajectory:
        """The demonstrations' median in each step's frame, without a model: a reference to measure models against."""
        return self._decoded(keypoints, self.median)

    def carried_over(self, keypoints: FloatArray, count: int) -> tuple[Trajectory, ...]:
        """The ``count`` demonstrations nearest to the scene of ``keypoints (K, 3)``, nearest first, each transferred to
        it: its numbers stay the same in each step's frame, and the frames move with the keypoints."""
        new = self.frames.named(self.checked(keypoints)[None])
        distances = np.linalg.norm(self.frames.named(self.keypoints) - new, axis=-1).mean(axis=-1)
        nearest = np.argsort(distances, kind="stable")[:count]
        return tuple(self._decoded(keypoints, self.numbers[demo]) for demo in nearest)


def as_turns(numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Hands ``(I, T, 7·A)``, and the ``reference (T, A, 3, 3)`` from which they turn, of ``numbers (I, T, 10·A)``.

    For each arm the point between the fingertips, millimetres; the rotation vector from the reference, in millimetres
    at `LEVER_MM`; the gripper state. The reference are the gripper's points about that point in the most typical
    demonstration.
    """
    rows = numbers.reshape(*numbers.shape[:2], -1, ACTION_DIM)
    points = rows[..., 3:STATE_INDEX].reshape(*rows.shape[:-1], 2, 3)
    points = np.concatenate([points, -points[..., 1:, :]], axis=-2)  # gripper point, fingertips
    apart = np.linalg.norm(points[:, None] - points, axis=-1).sum(axis=(1, -1))  # (I, T, A), of all others
    typical = np.argmin(apart, axis=0)
    reference = np.take_along_axis(points, typical[None, ..., None, None], axis=0)[0]
    rotation = fit_rigid(np.broadcast_to(reference, points.shape), points)[..., :3, :3]
    turns = LEVER_MM * Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec().reshape(rows[..., :3].shape)
    hands = np.concatenate([rows[..., :3], turns, rows[..., STATE_INDEX:]], axis=-1)
    return hands.reshape(*numbers.shape[:2], -1), reference


def from_turns(hands: FloatArray, reference: FloatArray) -> FloatArray:
    """``numbers (T, 10·A)`` of ``hands (T, 7·A)``; the inverse of `as_turns`."""
    rows = hands.reshape(len(hands), -1, HAND_DIM)
    rotation = Rotation.from_rotvec(rows[..., 3:6].reshape(-1, 3) / LEVER_MM).as_matrix().reshape(*rows.shape[:2], 3, 3)
    points = reference @ np.swapaxes(rotation, -1, -2)
    shape = points[..., :2, :].reshape(*rows.shape[:2], 6)
    return np.concatenate([rows[..., :3], shape, rows[..., HAND_STATE:]], axis=-1).reshape(len(hands), -1)


def make_questions(
    frames: StepFrames, inputs: FloatArray, offsets: FloatArray, key_steps: Sequence[int]
) -> tuple[Question, ...]:
    """What to ask of demonstrations with keypoints ``inputs (I, T, A, 3·K)`` and ``offsets (I, T, 7·A)`` from their
    median in ``frames``: the numbers that vary, and, where frames follow things, that inputs predict better than the
    median does."""
    varies = _varies(offsets)
    if len(offsets) >= MIN_DEMOS_TO_AGREE and any(frame.things != (WORLD,) for frame in frames.used):
        for arm in range(frames.num_arms):
            own = [HAND_DIM * arm + dim for dim in range(HAND_STATE)]
            for step in np.flatnonzero(varies[:, own].any(axis=1)):
                varies[step, own] &= predictable(inputs[:, step, arm], offsets[:, step, own])
    offsets = np.where(varies, offsets, 0.0)
    questions = (
        _question(arm, steps, offsets, inputs)
        for arm, own in enumerate(frames.arms)
        for steps in _blocks(own, key_steps, offsets[..., HAND_DIM * arm : HAND_DIM * (arm + 1)])
    )
    return tuple(question for question in questions if question is not None)


def _varies(offsets: FloatArray) -> NDArray[np.bool_]:
    """On which numbers ``(T, 7·A)`` demonstrations with ``offsets (I, T, 7·A)`` differ."""
    is_state = np.arange(offsets.shape[2]) % HAND_DIM == HAND_STATE
    if len(offsets) < MIN_DEMOS_TO_AGREE:
        return np.broadcast_to(~is_state, offsets.shape[1:])
    return np.where(is_state, offsets.any(axis=0), np.sqrt((offsets**2).mean(axis=0)) > MM * NOISE_M)


def predictable(inputs: FloatArray, outputs: FloatArray) -> NDArray[np.bool_]:
    """Which of the numbers ``outputs (I, D)`` the keypoint coordinates ``inputs (I, 3·K)`` predict better than the mean
    of the demonstrations does, all in millimetres.

    Each demonstration is predicted from the others alone, by ridge regression on those of the inputs that a query would
    show. The rest is noise, which a model would only imitate.
    """
    missed = np.zeros((2, *outputs.shape))
    for demo in range(len(outputs)):
        others = np.arange(len(outputs)) != demo
        chosen = list(informative_inputs(inputs[others], outputs[others]))
        mean = outputs[others].mean(axis=0)
        x = inputs[:, chosen] - inputs[others][:, chosen].mean(axis=0)
        gram = x[others].T @ x[others] + others.sum() * RIDGE_MM**2 * np.eye(len(chosen))
        slope = np.linalg.solve(gram, x[others].T @ (outputs[others] - mean))
        missed[:, demo] = outputs[demo] - mean, outputs[demo] - mean - x[demo] @ slope
    usual, own = (missed**2).sum(axis=1)
    return np.asarray(own < usual)


def _blocks(frames: Sequence[Frame], key_steps: Sequence[int], offsets: FloatArray) -> list[list[int]]:
    """Steps to ask for together, at most `STEPS_PER_QUERY`.

    Of each run of frames that continue each other, the key steps, and as many others as give the demonstrations'
    ``offsets (I, T, 7)`` by interpolation.
    """
    blocks = []
    for start, stop in runs(frames):
        asked = sorted({start, stop - 1, *(key for key in key_steps if start <= key < stop)})
        while True:
            if len(asked) == stop - start:
                break
            between = interp1d(asked, offsets[:, asked], axis=1)(np.arange(start, stop))
            missed = np.abs(between - offsets[:, start:stop]).max(axis=(0, 2))
            if missed.max() <= INTERPOLATED_MM:
                break
            asked = sorted([*asked, start + int(np.argmax(missed))])
        blocks += [list(map(int, part)) for part in np.array_split(asked, -(-len(asked) // STEPS_PER_QUERY))]
    return blocks


def _question(arm: int, steps: Sequence[int], offsets: FloatArray, shown: FloatArray) -> Question | None:
    """The question about ``steps`` of ``arm``, from the demonstrations' ``offsets (I, T, 7·A)`` from their median and
    the ``shown (I, T, A, 3·K)`` keypoints, all in millimetres; None where nothing is to ask."""
    whole = np.round(offsets).astype(int)
    largest = np.abs(whole).max(axis=0)
    own = range(HAND_DIM * arm, HAND_DIM * (arm + 1))
    asked = tuple((step, dim) for step in steps for dim in own if offsets[:, step, dim].any())
    if not asked:
        return None
    rows = np.stack([whole[:, step, dim] for step, dim in asked], axis=1)
    digits = tuple(max(1, len(str(round(ANSWER_MARGIN * largest[step, dim])))) for step, dim in asked)
    seen = shown[:, steps[0], arm]
    inputs = informative_inputs(seen, rows)
    examples = tuple(_input(points, inputs) + write_row(row) + "\n" for points, row in zip(seen, rows, strict=True))
    return Question(arm, steps[0], asked, digits, inputs, examples)


def informative_inputs(shown: FloatArray, outputs: FloatArray) -> tuple[int, ...]:
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
