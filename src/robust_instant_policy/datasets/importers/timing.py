"""Frames at uneven times, or with the time of day: resampled to the rate of a demonstration."""

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from robust_instant_policy.errors import DatasetError
from robust_instant_policy.geometry import FloatArray

UNEVEN = 0.25  # of a frame, from the even time; more is resampled
UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)  # of clocks; the one that fits the rate best


def seconds_of(name: str, stamps: FloatArray, rate_hz: float) -> FloatArray | None:
    """Times ``(T,)`` in seconds from the first frame on, of ``stamps`` in any unit of `UNITS_S`; None where they are
    those of even frames at ``rate_hz``, or all equal. Raises `DatasetError` for times that go back."""
    if len(stamps) < 2 or not np.ptp(stamps):
        return None
    gaps = np.diff(stamps)
    if not np.isfinite(stamps).all() or (gaps < 0).any():
        raise DatasetError(f"{name}: its timestamps go back; restore it, or record the episode again")
    stamps = stamps - stamps[0]
    unit = min(UNITS_S, key=lambda unit: abs(np.log(np.median(gaps[gaps > 0]) * unit * rate_hz)))
    seconds = stamps * unit
    even = np.arange(len(stamps)) / rate_hz
    return None if np.abs(seconds - even).max() <= UNEVEN / rate_hz else seconds


def even_steps(seconds: FloatArray, rate_hz: float) -> FloatArray:
    """Times ``(M,)`` at ``rate_hz`` within those of an episode."""
    return np.arange(int(np.floor(seconds[-1] * rate_hz + 1e-6)) + 1) / rate_hz


def resampled(poses: FloatArray, seconds: FloatArray, times: FloatArray) -> FloatArray:
    """``poses (T, A, 4, 4)`` at other ``times (M,)``: positions linear in time, rotations on the shortest way. Of
    frames at the same time the first one counts.
    """
    seconds, first = np.unique(seconds, return_index=True)
    poses = poses[first]
    result = np.tile(np.eye(4), (len(times), poses.shape[1], 1, 1))
    for arm in range(poses.shape[1]):
        for axis in range(3):
            result[:, arm, axis, 3] = np.interp(times, seconds, poses[:, arm, axis, 3])
        result[:, arm, :3, :3] = Slerp(seconds, Rotation.from_matrix(poses[:, arm, :3, :3]))(times).as_matrix()
    return result


def held(seconds: FloatArray, times: FloatArray) -> np.ndarray:
    """Index ``(M,)`` of the frame that is the last one at each of ``times``."""
    return np.clip(np.searchsorted(seconds, times + 1e-9, side="right") - 1, 0, len(seconds) - 1)
