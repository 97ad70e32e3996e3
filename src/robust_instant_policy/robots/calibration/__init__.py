"""Calibration of cameras and grippers: pure functions of what was measured, and the files that hold the results."""

from robust_instant_policy.robots.calibration.board import Board
from robust_instant_policy.robots.calibration.camera import CameraCalibration, check_camera, in_hand, on_table
from robust_instant_policy.robots.calibration.table import BoardPlace, touched_place
from robust_instant_policy.robots.calibration.tool import ToolCalibration, calibrate_tool, pivot

__all__ = [
    "Board", "BoardPlace", "CameraCalibration", "ToolCalibration",
    "calibrate_tool", "check_camera", "in_hand", "on_table", "pivot", "touched_place",
]  # fmt: skip
