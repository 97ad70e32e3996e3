"""Whole trajectories in one prompt, as Keypoint Action Tokens writes them (Di Palo and Johns 2024)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robust_instant_policy.context.codec import MM, millimetres, read_rows, rows_grammar, rows_pattern, write_row
from robust_instant_policy.context.prompt import INSTRUCTION, REACH_MM, Prompt
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.query import Query
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX, Trajectory

TOKENS_PER_NUMBER = 6  # upper bound for a number with its separator


@dataclass(frozen=True, eq=False)
class SequencePrompt(Prompt):
    """One query: for each demonstration a line of keypoints and a line for each step, then the new keypoints.

    Steps are `StepFrames` numbers, or with ``raw`` the actions themselves in whole millimetres, as in the paper.
    ``lengths`` are the fewest and the most steps of a demonstration.
    """

    examples: tuple[str, ...]
    lengths: tuple[int, int]
    raw: bool

    @property
    def curvature(self) -> FloatArray:
        curvature = super().curvature
        return np.full_like(curvature, curvature.max()) if self.raw else curvature  # raw steps are not aligned

    def queries(self, keypoints: FloatArray) -> list[Query]:
        keypoints = self.checked(keypoints)
        columns = ACTION_DIM * self.frames.num_arms
        form = (*self.lengths, columns, range(STATE_INDEX, columns, ACTION_DIM))
        return [
            Query(
                "".join(self.examples) + _input(keypoints),
                max_tokens=self.lengths[1] * columns * TOKENS_PER_NUMBER,
                grammar=rows_grammar(*form),
                pattern=rows_pattern(*form),
                stop=("\n\n",),
                instruction=INSTRUCTION,
            )
        ]

    def read(self, query_index: int, text: str) -> FloatArray | None:
        """Rows ``(T, 10·A)``; the last one may be missing, as where an answer was cut off."""
        rows = read_rows(text, ACTION_DIM * self.frames.num_arms)
        if rows is None or np.abs(rows).max() > REACH_MM or len(rows) < self.lengths[0] - 1:
            return None
        if not np.isin(rows[:, STATE_INDEX::ACTION_DIM], (0, 1)).all():
            return None
        return rows[: self.lengths[1]]

    def trajectory(self, answers: Sequence[FloatArray], keypoints: FloatArray) -> Trajectory:
        keypoints, (rows,) = self.checked(keypoints), answers
        if self.raw:
            actions = rows / MM
            actions[:, STATE_INDEX::ACTION_DIM] = rows[:, STATE_INDEX::ACTION_DIM]
            return Trajectory.from_actions(actions)
        return Trajectory(self.frames.decode(keypoints, rows), np.linspace(0, 1, self.lengths[0])[: len(rows)])


def raw_rows(trajectory: Trajectory) -> np.ndarray:
    """Actions ``(T, 10·A)`` in whole millimetres, gripper states 0 or 1."""
    rows = millimetres(trajectory.actions)
    rows[:, STATE_INDEX::ACTION_DIM] = np.round(trajectory.gripper_state)
    return rows


def sequence_example(keypoints: FloatArray, rows: np.ndarray) -> str:
    """A demonstration: its ``keypoints (K, 3)``, metres, then its ``rows (T, 10·A)`` and an empty line."""
    return _input(keypoints) + "".join(write_row(row) + "\n" for row in rows) + "\n"


def _input(keypoints: FloatArray) -> str:
    return write_row(millimetres(keypoints).ravel()) + "\n"
