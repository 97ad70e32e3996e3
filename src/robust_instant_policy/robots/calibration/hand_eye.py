"""Eye-to-hand calibration: a fixed camera sees a board that the hand holds at several poses.

With the hand's poses H_i (hand -> world, from the robot), the board's poses C_i (board -> camera, from the image), the
unknown camera X (camera -> world) and mounting Y (board -> hand):  H_i Y = X C_i.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from robust_instant_policy.errors import CalibrationError
from robust_instant_policy.geometry import FloatArray, fit_rigid, invert_pose, make_pose, transform_points

MIN_POSES = 6
MIN_TURN_RAD = np.radians(20.0)  # between two of the poses, about two different axes
MAX_SCALE_ERROR = 0.03  # of the hand's translations against the board's
OUTLIER_M = 0.003  # beyond it a gap counts by its length, not its square


@dataclass(frozen=True, eq=False)
class HandEye:
    """``camera (4, 4)`` camera -> world and ``mounting (4, 4)`` board -> hand.

    ``left_out_m (N,)``: root mean square distance of the board's corners at each pose, between the place that the hand
    gives and the one that the camera gives, calibrated without this pose.
    """

    camera: FloatArray
    mounting: FloatArray
    left_out_m: FloatArray


def calibrate_hand_eye(hands: FloatArray, boards: FloatArray, corners: FloatArray) -> HandEye:
    """Camera and mounting from hand poses ``(N, 4, 4)``, board poses ``(N, 4, 4)`` and the board's ``corners (M, 3)``.

    Park's closed form, then `refine`. Raises `CalibrationError` for poses that do not determine the camera, and for
    translations in another unit than the board's.
    """
    if len(hands) < MIN_POSES:
        raise CalibrationError(
            f"{len(hands)} poses of the board are too few; at least {MIN_POSES} are needed, better 12"
        )
    _check_turns(hands)
    _check_scale(hands, boards)

    def solve(kept: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        return refine(*park(hands[kept], boards[kept]), hands[kept], boards[kept], corners)

    left_out = []
    for index in range(len(hands)):
        camera, mounting = solve(np.arange(len(hands)) != index)
        gap = _gaps(camera, mounting, hands[index : index + 1], boards[index : index + 1], corners)
        left_out.append(np.sqrt(np.mean(np.sum(gap**2, axis=-1))))
    camera, mounting = solve(np.ones(len(hands), dtype=bool))
    return HandEye(camera, mounting, np.array(left_out))


def park(hands: FloatArray, boards: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Camera and mounting from all pairs of poses in closed form (Park and Martin 1994).

    For motions A = H_j H_i⁻¹ and B = C_j C_i⁻¹, A X = X B. The rotation vectors give α = R_X β (a fit of rotations),
    the translations (R_A - I) t_X = R_X t_B - t_A.
    """
    a, b, alpha, beta = _motions(hands, boards)
    rotation = Rotation.align_vectors(alpha, beta)[0].as_matrix()
    left = np.concatenate(a[:, :3, :3] - np.eye(3))
    right = (b[:, :3, 3] @ rotation.T - a[:, :3, 3]).ravel()
    camera = make_pose(rotation, np.linalg.lstsq(left, right, rcond=None)[0])
    held = np.stack([invert_pose(hand) @ camera @ board for hand, board in zip(hands, boards, strict=True)])
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    return camera, fit_rigid(corners, np.mean([transform_points(one, corners) for one in held], axis=0))


def refine(
    camera: FloatArray, mounting: FloatArray, hands: FloatArray, boards: FloatArray, corners: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Camera and mounting, from a first estimate, with the least gaps at the board's corners under Huber's loss.

    Gaps in metres, not pixels: an arm's positions err more (about 1 mm) than corners in an image do (0.1 px), and a
    fit of pixels would follow the arm's errors.
    """

    def moved(change: FloatArray) -> tuple[FloatArray, FloatArray]:
        return camera @ _pose(change[:6]), mounting @ _pose(change[6:])

    def gaps(change: FloatArray) -> FloatArray:
        return _gaps(*moved(change), hands, boards, corners).ravel()

    return moved(least_squares(gaps, np.zeros(12), loss="huber", f_scale=OUTLIER_M).x)


def _gaps(
    camera: FloatArray, mounting: FloatArray, hands: FloatArray, boards: FloatArray, corners: FloatArray
) -> FloatArray:
    """World positions of the corners by the hand minus those by the camera, ``(N, M, 3)``."""
    points = np.column_stack([corners, np.ones(len(corners))]).T
    return np.swapaxes((hands @ mounting @ points - camera @ boards @ points)[:, :3], 1, 2)


def _pose(change: FloatArray) -> FloatArray:
    return make_pose(Rotation.from_rotvec(change[:3]).as_matrix(), change[3:])


def _motions(hands: FloatArray, boards: FloatArray) -> tuple[FloatArray, ...]:
    """Motions A and B ``(N, 4, 4)`` between all pairs of poses, and their rotation vectors α and β ``(N, 3)``."""
    i, j = np.triu_indices(len(hands), 1)
    motions = [poses[j] @ np.linalg.inv(poses)[i] for poses in (hands, boards)]
    return *motions, *(Rotation.from_matrix(motion[:, :3, :3]).as_rotvec() for motion in motions)


def _check_turns(hands: FloatArray) -> None:
    """Raises `CalibrationError` unless the hand turned about two different axes."""
    i, j = np.triu_indices(len(hands), 1)
    turns = Rotation.from_matrix(hands[j, :3, :3] @ np.swapaxes(hands[i, :3, :3], 1, 2)).as_rotvec()
    spread = np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(turns))
    if spread[1] < MIN_TURN_RAD / 2:
        raise CalibrationError(
            f"the hand turned about one axis only (the second spread is {np.degrees(spread[1]):.1f} degrees): tilt the "
            "board towards the camera's sides, too, by 20 to 40 degrees each way"
        )


def _check_scale(hands: FloatArray, boards: FloatArray) -> None:
    """Raises `CalibrationError` where the hand's translations have another unit than the board's.

    The scale s and t_X solve (R_A - I) t_X - s R_X t_B = -t_A.
    """
    a, b, alpha, beta = _motions(hands, boards)
    angles = np.linalg.norm(alpha, axis=1) - np.linalg.norm(beta, axis=1)
    if np.median(np.abs(angles)) > np.radians(5.0):
        raise CalibrationError(
            f"the hand and the board turned by different angles (median {np.degrees(np.median(np.abs(angles))):.0f} "
            "degrees): the arm's angles are in degrees, joints are in another order, or the board slipped in the hand"
        )
    rotation = Rotation.align_vectors(alpha, beta)[0].as_matrix()
    left = np.concatenate([a[:, :3, :3] - np.eye(3), -(b[:, :3, 3] @ rotation.T)[..., None]], axis=2)
    solution = np.linalg.lstsq(left.reshape(-1, 4), -a[:, :3, 3].ravel(), rcond=None)[0]
    scale = float(solution[3])
    if abs(scale - 1) <= MAX_SCALE_ERROR:
        return
    if not 0.02 < scale < 50:
        unit = "the arm's positions are in millimetres" if scale > 1 else "the square's size is not in metres"
        raise CalibrationError(f"the hand moved {scale:.4g} times as far as the board did: {unit}")
    raise CalibrationError(
        f"the hand moved {scale:.3f} times as far as a board with these squares did: a square is {scale:.3f} times as "
        "large as stated (measure the print), or the arm's model is of another arm"
    )
