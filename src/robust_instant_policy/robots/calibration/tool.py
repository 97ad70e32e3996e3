"""Pivot calibration: the fingertips in the frame of a hand, from touching one fixed point from several directions.

The hand's frame is the tool frame of the arm's model, which the measured one corrects.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from robust_instant_policy.errors import CalibrationError
from robust_instant_policy.geometry import FloatArray, make_pose
from robust_instant_policy.robots.calibration.toml import now, save_calibration

MIN_TOUCHES = 4
MIN_SPREAD_RAD = np.radians(10.0)  # of the directions from which the point is touched
MAX_TIP_M = 0.6  # from the hand's frame; longer, it is not in metres
OPENING_M = (0.005, 0.4)  # between open fingertips
ALONG_Y = 0.7  # least part of the direction between the fingertips along y of the model
MIN_TRAVEL_SHARE = 0.3  # of the opening that the fingers' own readings must show


HEADER = """# Calibration of a gripper, written by `rip calibrate tool`. Lengths in metres, or as a key names.
# length: gripper point to fingertips along the approach. opening: between the open fingertips. tool: measured tool ->
# tool of the arm's model, row by row; origin midway between the open fingertips, z along the approach, y to finger 1.
"""


@dataclass(frozen=True, eq=False)
class Pivot:
    """A point of the tool: ``tip (3,)`` in the hand's frame, ``touched (3,)`` in the world, metres.

    ``left_out_m (N,)``: distance of each touch from the point, where tip and point are fitted to the others.
    """

    tip: FloatArray
    touched: FloatArray
    left_out_m: FloatArray


def pivot(hands: FloatArray) -> Pivot:
    """The point of the tool that stayed at one place of the world at all hand poses ``(N, 4, 4)``.

    Least squares of R_i p + t_i = w. Raises `CalibrationError` for too few or too similar directions, or other units.
    """
    if len(hands) < MIN_TOUCHES + 1:
        raise CalibrationError(f"{len(hands)} touches are too few; touch the point from {MIN_TOUCHES + 1} directions")
    turns = Rotation.from_matrix(hands[:, :3, :3])
    spread = np.linalg.svd((turns.mean().inv() * turns).as_rotvec(), compute_uv=False) / np.sqrt(len(hands))
    if spread[1] < MIN_SPREAD_RAD:
        raise CalibrationError(
            f"the directions differ by {np.degrees(spread[1]):.0f} degrees about their second axis; tilt the gripper "
            "by 30 degrees or more to all sides between the touches"
        )
    tip, touched = _solve(hands)
    if np.linalg.norm(tip) > MAX_TIP_M:
        raise CalibrationError(
            f"the fingertip is {np.linalg.norm(tip):.3g} m from the hand: the arm's positions are in millimetres, or "
            "the tip did not stay at one point"
        )
    left_out = []
    for index, hand in enumerate(hands):
        tip_without, touched_without = _solve(np.delete(hands, index, axis=0))
        left_out.append(np.linalg.norm(hand[:3, :3] @ tip_without + hand[:3, 3] - touched_without))
    return Pivot(tip, touched, np.array(left_out))


def _solve(hands: FloatArray) -> tuple[FloatArray, FloatArray]:
    left = np.concatenate([hands[:, :3, :3], np.tile(-np.eye(3), (len(hands), 1, 1))], axis=2)
    solution = np.linalg.lstsq(left.reshape(-1, 6), -hands[:, :3, 3].ravel(), rcond=None)[0]
    return solution[:3], solution[3:]


def tool_frame(first: FloatArray, second: FloatArray) -> tuple[FloatArray, float]:
    """Measured tool -> model's tool ``(4, 4)`` and opening (metres) from two open fingertips ``(3,)`` in the model's.

    The tool frame is that of `geometry`: origin midway between the fingertips, y to the first one, z along the model's
    approach as far as it is orthogonal to y.
    """
    opening = float(np.linalg.norm(first - second))
    if not OPENING_M[0] < opening < OPENING_M[1]:
        raise CalibrationError(
            f"the fingertips are {opening * 1e3:.1f} mm apart; open the gripper, and touch the point first with one "
            "finger and then with the other"
        )
    y = (first - second) / opening
    if y[1] < ALONG_Y:
        raise CalibrationError(
            f"the line between the fingertips is ({y[0]:.2f}, {y[1]:.2f}, {y[2]:.2f}) in the tool frame of the arm's "
            "model, where it should be (0, 1, 0): touch first with the finger on the side of y, and see that the model "
            "has this gripper"
        )
    z = np.array([0.0, 0.0, 1.0]) - y[2] * y
    z /= np.linalg.norm(z)
    return make_pose(np.stack([np.cross(y, z), y, z], axis=1), (first + second) / 2), opening


@dataclass(frozen=True, eq=False)
class ToolCalibration:
    """``tool (4, 4)`` measured tool -> that of the arm's model, ``length`` and ``opening`` in metres, ``left_out_mm``
    the error at each touch, ``closed_travel`` and ``open_travel`` of each finger as the gripper reads them, metres."""

    arm: str
    tool: FloatArray
    length: float
    opening: float
    left_out_mm: tuple[float, ...]
    closed_travel: float
    open_travel: float
    date: str

    def save(self, path: Path) -> None:
        """Write the TOML file that a cell's arm names as its ``gripper``."""
        facts = {
            "arm": self.arm,
            "date": self.date,
            "length": round(self.length, 6),
            "opening": round(self.opening, 6),
            "tool": self.tool.tolist(),
            "closed_travel": round(self.closed_travel, 6),
            "open_travel": round(self.open_travel, 6),
            "left_out_mm": [round(error, 3) for error in self.left_out_mm],
        }
        save_calibration(path, HEADER, facts)


def calibrate_tool(
    arm: str, first: Pivot, second: Pivot, model_length: float, closed_travel: float, open_travel: float
) -> ToolCalibration:
    """From touches of one point with the first and then with the second finger, the gripper open, in the frame of the
    model's tool, whose length is ``model_length`` metres.

    Raises `CalibrationError` where the gripper's readings contradict the touches.
    """
    pose, opening = tool_frame(first.tip, second.tip)
    length = model_length + float(pose[2, 3])
    apart = 2 * (open_travel - closed_travel)
    if abs(apart) < MIN_TRAVEL_SHARE * opening:
        raise CalibrationError(
            f"the fingers read {closed_travel:.4f} m closed and {open_travel:.4f} m open, but stand {opening:.4f} m "
            " gripper did not move, or its reading is not in metres"
        )
    errors = np.concatenate([first.left_out_m, second.left_out_m]) * 1e3
    return ToolCalibration(arm, pose, length, opening, tuple(errors.tolist()), closed_travel, open_travel, now())
