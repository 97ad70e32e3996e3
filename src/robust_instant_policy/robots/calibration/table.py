"""A fixed camera from a board that lies at several places on the level table.

Its first place is known. The others need not be: that the board lies in the same plane determines the camera's tilt,
which one small board seen from above does not (0.1 px at a corner is half a degree).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from robust_instant_policy.errors import CalibrationError
from robust_instant_policy.geometry import (
    FloatArray,
    fit_rigid,
    fit_upright,
    invert_pose,
    lift,
    make_pose,
    project,
    rotations_about_vertical,
    transform_points,
)
from robust_instant_policy.robots.calibration.board import Board, BoardView

MIN_PLACES = 4  # of the board, the known one among them
MIN_SPREAD = 0.35  # of the image's width and height that the board's places must cover
TOUCH_TOLERANCE_M = 0.008  # of touched corners from the board's, root mean square
TOUCH_SCALE_TOLERANCE = 0.05  # of their distances
FACE_UP = 0.9  # least vertical part of the board's normal, where it lies on the table
OUTLIER_PX = 1.0  # beyond it a corner counts by its distance, not its square


@dataclass(frozen=True, eq=False)
class BoardPlace:
    """``pose (4, 4)`` board -> world, upright, how it is known, and the error at each touched corner without it."""

    pose: FloatArray
    method: str
    left_out_mm: tuple[float, ...] = ()


def touched_place(touched: FloatArray, board: Board) -> BoardPlace:
    """Place of a board that lies face up on the level table, from its corners A, B, C, D as touched, ``(4, 3)`` metres.

    A tilt in the touches is an error of theirs. Raises `CalibrationError` that names the mistake: other units, a wrong
    size of the squares, a wrong order.
    """
    corners = board.outer_corners
    spread = [np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))) for points in (touched, corners)]
    scale = spread[0] / spread[1]
    if not 0.02 < scale < 50:
        unit = "the arm's positions are in millimetres" if scale > 1 else "the square's size is not in metres"
        raise CalibrationError(f"the touched corners are {scale:.4g} times as far apart as the board's: {unit}")
    pose = fit_rigid(corners, touched)
    gap = np.sqrt(np.mean(np.sum((transform_points(pose, corners) - touched) ** 2, axis=1)))
    if abs(scale - 1) > TOUCH_SCALE_TOLERANCE:
        raise CalibrationError(
            f"the touched corners are {scale:.3f} times as far apart as those of a board with squares of "
            f"{board.square_m * 1e3:g} mm; measure the print: {board.square_m * scale * 1e3:.1f} mm would agree"
        )
    if gap > TOUCH_TOLERANCE_M:
        raise CalibrationError(
            f"the touched corners are {gap * 1e3:.0f} mm off the board's rectangle: touch A, B, C, D in this order, "
            "the corners of the pattern and not of the paper"
        )
    if pose[2, 2] < -FACE_UP:
        raise CalibrationError(
            "the corners were touched in mirrored order: seen from above, A, B, C, D run counterclockwise"
        )
    if pose[2, 2] < FACE_UP:
        raise CalibrationError("the touched corners do not lie in a horizontal plane; the board must lie on the table")
    left_out = []
    for index in range(len(corners)):
        without = fit_upright(np.delete(corners, index, axis=0), np.delete(touched, index, axis=0), np.ones(3))
        left_out.append(float(np.linalg.norm(transform_points(without, corners[index]) - touched[index]) * 1e3))
    return BoardPlace(fit_upright(corners, touched, np.ones(4)), f"{len(touched)} corners touched", tuple(left_out))


def calibrate_on_table(
    views: Sequence[BoardView], boards: FloatArray, place: BoardPlace, intrinsics: FloatArray, size: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Camera -> world ``(4, 4)``, and the error in metres at each view but the first, calibrated without it.

    ``boards (N, 4, 4)`` are the poses board -> camera of the ``views`` in an image of ``size`` (width, height), the
    first one at ``place``. The error is that of the corners where their rays meet the table. Raises `CalibrationError`
    for too few places or ones that lie close together.
    """
    if len(views) < MIN_PLACES:
        raise CalibrationError(f"{len(views)} places of the board are too few: {MIN_PLACES} are needed, 6 are better")
    covered = np.ptp(np.concatenate([view.pixels for view in views]), axis=0) / size
    if covered.min() < MIN_SPREAD:
        raise CalibrationError(
            f"the board's places cover {100 * covered[0]:.0f}% of the image's width and {100 * covered[1]:.0f}% of its "
            f"height: lay it towards the corners of the image, so that they cover {100 * MIN_SPREAD:.0f}% or more"
        )
    left_out = []
    for index in range(1, len(views)):
        kept = [other for other in range(len(views)) if other != index]
        camera = _fit([views[other] for other in kept], boards[kept], place, intrinsics)
        met = _on_plane(views[index], camera, place.pose[2, 3], intrinsics)
        points = views[index].points
        off = transform_points(fit_upright(points, met, np.ones(len(points))), points) - met
        left_out.append(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    return _fit(views, boards, place, intrinsics), np.array(left_out)


def _fit(views: Sequence[BoardView], boards: FloatArray, place: BoardPlace, intrinsics: FloatArray) -> FloatArray:
    """Camera -> world with the least reprojection error, with Huber's loss; the other places are fitted with it."""
    start = place.pose @ invert_pose(boards[0])
    guessed = start @ boards[1:]
    yaw = np.arctan2(guessed[:, 1, 0], guessed[:, 0, 0])
    first = np.concatenate([np.zeros(6), np.column_stack([guessed[:, :2, 3], yaw]).ravel()])

    def camera(values: FloatArray) -> FloatArray:
        return start @ make_pose(Rotation.from_rotvec(values[:3]).as_matrix(), values[3:6])

    def misses(values: FloatArray) -> FloatArray:
        places = [place.pose]
        for x, y, angle in values[6:].reshape(-1, 3):
            places.append(make_pose(rotations_about_vertical(angle), [x, y, place.pose[2, 3]]))
        pose = camera(values)
        pairs = zip(places, views, strict=True)
        seen = [project(transform_points(one, view.points), intrinsics, pose) - view.pixels for one, view in pairs]
        return np.concatenate(seen).ravel()

    return camera(least_squares(misses, first, loss="huber", f_scale=OUTLIER_PX, x_scale="jac").x)


def _on_plane(view: BoardView, camera: FloatArray, height: float, intrinsics: FloatArray) -> FloatArray:
    """Where the rays of a view's pixels meet the horizontal plane at ``height``, ``(N, 3)`` world, metres."""
    ahead = lift(view.pixels, np.ones(len(view.pixels)), intrinsics, camera) - camera[:3, 3]
    return camera[:3, 3] + ahead * ((height - camera[2, 3]) / ahead[:, 2])[:, None]
