"""Steps of a demonstration that is recorded, and its editing: pauses are cut, small vibrations smoothed."""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from robust_instant_policy.geometry import FloatArray

SMOOTH_S = 0.08  # standard deviation of the smoothing
STILL_M_S, STILL_RAD_S = 0.004, 0.04  # slower than both is a pause
LONGEST_PAUSE_S = 0.2
FINGERS_S = 0.5  # kept after the gripper opens or closes, however still the arm is


class Step(NamedTuple):
    """A control step: its command ``(A·(J + 1),)``, tool poses ``(A, 4, 4)`` and gripper states ``(A,)`` bool."""

    command: FloatArray
    poses: FloatArray
    closed: np.ndarray


def edited(poses: FloatArray, closed: np.ndarray, rate_hz: float) -> tuple[FloatArray, np.ndarray]:
    """Tool ``poses (N, A, 4, 4)`` and states ``closed (N, A)`` at ``rate_hz`` without long pauses and vibrations.

    A pause is shortened to `LONGEST_PAUSE_S`. Positions and rotations between two gripper changes are smoothed with a
    Gaussian of `SMOOTH_S`; the poses at which a gripper changes stay where they are.
    """
    kept = _without_pauses(poses, closed, rate_hz)
    poses, closed = poses[kept].copy(), closed[kept]
    changes = np.flatnonzero((closed[1:] != closed[:-1]).any(axis=1)) + 1
    for start, stop in zip([0, *changes], [*changes, len(poses)], strict=True):
        for arm in range(poses.shape[1]):
            poses[start:stop, arm] = _smooth(poses[start:stop, arm], SMOOTH_S * rate_hz)
    return poses, closed


def _without_pauses(poses: FloatArray, closed: np.ndarray, rate_hz: float) -> np.ndarray:
    moved = np.linalg.norm(np.diff(poses[..., :3, 3], axis=0), axis=-1).max(axis=1) * rate_hz > STILL_M_S
    turns = Rotation.from_matrix(
        (poses[1:, :, :3, :3] @ np.swapaxes(poses[:-1, :, :3, :3], -1, -2)).reshape(-1, 3, 3)
    ).magnitude()
    moved |= turns.reshape(len(poses) - 1, -1).max(axis=1) * rate_hz > STILL_RAD_S
    changed = (closed[1:] != closed[:-1]).any(axis=1)
    kept, still, since_change = [0], 0, np.inf
    for step, (moves, changes) in enumerate(zip(moved, changed, strict=True), start=1):
        still = 0 if moves or changes else still + 1
        since_change = 0 if changes else since_change + 1
        if still <= LONGEST_PAUSE_S * rate_hz or since_change <= FINGERS_S * rate_hz:
            kept.append(step)
    return np.array(kept)


def _smooth(poses: FloatArray, deviation: float) -> FloatArray:
    """``poses (N, 4, 4)`` filtered by a Gaussian of ``deviation`` steps; the first and the last stay."""
    if len(poses) < 3:
        return poses
    smooth = poses.copy()
    start = poses[0, :3, :3]
    turns = Rotation.from_matrix(start.T @ poses[:, :3, :3]).as_quat()
    turns *= np.where(turns[:, 3:] < 0, -1, 1)  # a demonstration turns a gripper by less than half a turn
    columns = np.concatenate([poses[:, :3, 3], turns], axis=1)
    line = np.linspace(0, 1, len(poses))[:, None]
    ends = columns[0] + line * (columns[-1] - columns[0])
    away = columns - ends  # 0 at both ends, and so is its smoothed odd extension
    extended = np.concatenate([-away[:0:-1], away, -away[-2::-1]])
    columns = ends + gaussian_filter1d(extended, deviation, axis=0)[len(poses) - 1 : 2 * len(poses) - 1]
    smooth[:, :3, 3] = columns[:, :3]
    smooth[:, :3, :3] = start @ Rotation.from_quat(columns[:, 3:]).as_matrix()
    return smooth
