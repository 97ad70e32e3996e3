"""Pose of a board in the camera's frame, and the scale that a depth image gives to it."""

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.errors import CalibrationError
from robust_instant_policy.geometry import FloatArray, make_pose, project, transform_points
from robust_instant_policy.robots.calibration.board import BoardView, opencv

MAX_REPROJECTION_PX = 1.0  # root mean square; a sharp image of a flat board has 0.1 to 0.3
SCALE_TOLERANCE = 0.03  # of depth against the board: stereo depth errs by up to 2% within its range
MIN_DEPTH_READINGS = 6  # at a board's corners


def board_pose(view: BoardView, intrinsics: FloatArray) -> FloatArray:
    """Pose board -> camera ``(4, 4)``: infinitesimal plane-based pose (Collins and Bartoli 2014), then refined.

    Raises `CalibrationError` for a reprojection error above `MAX_REPROJECTION_PX`.
    """
    cv2 = opencv()
    # The two solutions of a plane's pose are refined both; near each other they may change places.
    _, turns, shifts, _ = cv2.solvePnPGeneric(view.points, view.pixels, intrinsics, None, flags=cv2.SOLVEPNP_IPPE)
    poses = []
    for turn, shift in zip(turns, shifts, strict=True):
        turn, shift = cv2.solvePnPRefineLM(view.points, view.pixels, intrinsics, None, turn, shift)
        poses.append(make_pose(cv2.Rodrigues(turn)[0], shift.ravel()))
    pose = min(poses, key=lambda one: reprojection_px(view, one, intrinsics))
    error = reprojection_px(view, pose, intrinsics)
    if error > MAX_REPROJECTION_PX:
        raise CalibrationError(
            f"the board's corners are {error:.2f} px off (limit {MAX_REPROJECTION_PX:g} px): the intrinsics are of "
            "another resolution, the image is distorted, or the board is not flat"
        )
    return pose


def reprojection_px(view: BoardView, pose: FloatArray, intrinsics: FloatArray) -> float:
    """Root mean square distance, in pixels, of the corners from their projections with ``pose`` board -> camera."""
    projected = project(transform_points(pose, view.points), intrinsics, np.eye(4))
    return float(np.sqrt(np.mean(np.sum((projected - view.pixels) ** 2, axis=1))))


def depth_scale(view: BoardView, pose: FloatArray, depth: NDArray[np.float32]) -> float | None:
    """Median ratio of the measured ``depth (H, W)`` to the board's distance with ``pose``; None with few readings."""
    column, row = np.round(view.pixels).astype(int).T
    inside = (column >= 0) & (column < depth.shape[1]) & (row >= 0) & (row < depth.shape[0])
    measured = depth[row[inside], column[inside]].astype(np.float64)
    expected = transform_points(pose, view.points[inside])[:, 2]
    sound = np.isfinite(measured) & (measured > 0)
    return float(np.median(measured[sound] / expected[sound])) if sound.sum() >= MIN_DEPTH_READINGS else None


def check_depth_scale(scale: float | None, square_m: float) -> None:
    """Raises `CalibrationError` where depth and board disagree on lengths; ``scale`` as of `depth_scale`."""
    if scale is None or abs(scale - 1) <= SCALE_TOLERANCE:
        return
    if not 0.02 < scale < 50:
        unit = "millimetres" if scale > 1 else "kilometres; is its unit applied twice?"
        raise CalibrationError(
            f"the depth image is {scale:.4g} times the distance of the board: it is in {unit}, not in metres"
        )
    raise CalibrationError(
        f"the depth image says {scale:.3f} times the distance that a board with squares of {square_m * 1e3:g} mm has: "
        f"measure a square of the print; with {square_m * scale * 1e3:.1f} mm both would agree"
    )
