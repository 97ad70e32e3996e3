"""Calibration of a fixed camera, from a board on the table or in the hand, and its file."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robust_instant_policy.errors import RobotError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.robots.calibration.board import Board, BoardView
from robust_instant_policy.robots.calibration.board_pose import (
    board_pose,
    check_depth_scale,
    depth_scale,
    reprojection_px,
)
from robust_instant_policy.robots.calibration.hand_eye import calibrate_hand_eye
from robust_instant_policy.robots.calibration.table import BoardPlace, calibrate_on_table
from robust_instant_policy.robots.calibration.toml import now, save_calibration
from robust_instant_policy.robots.camera import Frame
from robust_instant_policy.robots.cell import read_section

HEADER = """# Calibration of a camera, written by `rip calibrate camera`. Lengths in metres, or as a key names.
# pose: camera -> world, row by row; axes of the camera: x right, y down, z forward (OpenCV).
"""


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """``pose (4, 4)`` camera -> world, with the camera and image that it holds for and its errors.

    ``reprojection_px`` is the root mean square over all corners. ``left_out_mm`` are the errors at each pose or place
    of the board but the known one, calibrated without it, ``touched_mm`` those at each touched corner. ``depth_scale``
    is measured depth over the board's distance, None without depth.
    """

    camera: str
    pose: FloatArray
    intrinsics: FloatArray
    image_size: tuple[int, int]
    method: str
    reprojection_px: float
    left_out_mm: tuple[float, ...]
    touched_mm: tuple[float, ...]
    depth_scale: float | None
    board: Board
    date: str

    def save(self, path: Path) -> None:
        """Write a TOML file, of which `check_camera` and `read_camera_pose` read a part."""
        facts: dict[str, Any] = {
            "camera": self.camera,
            "date": self.date,
            "method": self.method,
            "pose": self.pose.tolist(),
            "intrinsics": self.intrinsics.tolist(),
            "image_size": list(self.image_size),
            "reprojection_px": round(self.reprojection_px, 4),
            "left_out_mm": [round(error, 3) for error in self.left_out_mm],
            "touched_mm": [round(error, 3) for error in self.touched_mm],
        }
        if self.depth_scale is not None:
            facts["depth_scale"] = round(self.depth_scale, 5)
        save_calibration(path, HEADER, facts, board=asdict(self.board))


def check_camera(file: Path, camera: str, frame: Frame) -> None:
    """Raises `RobotError` where ``frame`` of the device ``camera`` is not of the camera and lens that ``file`` is of.

    A file with a pose alone, written by hand, is accepted.
    """
    section = read_section(file)
    if "camera" not in section:
        return
    if camera != (known := section.text("camera")):
        raise RobotError(f"{known} was calibrated, but {camera} is connected; run rip calibrate camera")
    size = section.array("image_size", (2,))
    expected = section.array("intrinsics", (3, 3))[:2] / size[:, None]
    height, width = frame.depth.shape
    if not np.allclose(frame.intrinsics[:2] / np.array([[width], [height]]), expected, rtol=0.02, atol=0.01):
        raise RobotError(
            f"the intrinsics of {camera} at {width} x {height} are not those of its calibration at "
            f"{size[0]:g} x {size[1]:g}: another crop of the image; run rip calibrate camera"
        )


@dataclass(frozen=True, eq=False)
class _Seen:
    view: BoardView
    pose: FloatArray
    scale: float | None
    error_px: float


def on_table(camera: str, frames: Sequence[Frame], board: Board, place: BoardPlace) -> CameraCalibration:
    """Calibration from ``frames`` of a board on the level table: first at a known ``place``, then elsewhere."""
    seen = [_locate(board.find(frame.rgb), frame, board) for frame in frames]
    facts = _facts(seen, frames[-1], board)
    pose, left_out = calibrate_on_table(
        [one.view for one in seen],
        np.stack([one.pose for one in seen]),
        place,
        frames[-1].intrinsics,
        facts["image_size"],
    )
    return CameraCalibration(
        camera=camera,
        pose=pose,
        method=f"board at {len(frames)} places of the table, the first by {place.method}",
        left_out_mm=tuple((left_out * 1e3).tolist()),
        touched_mm=place.left_out_mm,
        **facts,
    )


def in_hand(camera: str, frames: Sequence[Frame], hands: FloatArray, board: Board) -> CameraCalibration:
    """Calibration from ``frames`` of a board that the hand holds at the poses ``hands (N, 4, 4)``, hand -> world."""
    seen = [_locate(board.find(frame.rgb), frame, board) for frame in frames]
    result = calibrate_hand_eye(hands, np.stack([one.pose for one in seen]), board.outer_corners)
    return CameraCalibration(
        camera=camera,
        pose=result.camera,
        method=f"board in the hand at {len(hands)} poses",
        left_out_mm=tuple((result.left_out_m * 1e3).tolist()),
        touched_mm=(),
        **_facts(seen, frames[-1], board),
    )


def _locate(view: BoardView, frame: Frame, board: Board) -> _Seen:
    pose = board_pose(view, frame.intrinsics)
    scale = depth_scale(view, pose, frame.depth)
    check_depth_scale(scale, board.square_m)
    return _Seen(view, pose, scale, reprojection_px(view, pose, frame.intrinsics))


def _facts(seen: Sequence[_Seen], frame: Frame, board: Board) -> dict[str, Any]:
    scales = [one.scale for one in seen if one.scale is not None]
    return {
        "intrinsics": frame.intrinsics,
        "image_size": (frame.depth.shape[1], frame.depth.shape[0]),
        "reprojection_px": float(np.sqrt(np.mean([one.error_px**2 for one in seen]))),
        "depth_scale": float(np.median(scales)) if scales else None,
        "board": board,
        "date": now(),
    }
