"""Depth streams of LeRobot 0.6: 12-bit codes in a video, or images in millimetres or metres.

A code q of a video stands for the depth d, with the parameters that the feature's ``info`` holds (metres):

    linear (use_log false)   d = d_min + q / 4095 · (d_max - d_min)
    logarithmic              log(d + s) = log(d_min + s) + q / 4095 · (log(d_max + s) - log(d_min + s))

The code 0 is what a missing reading becomes, so it is none here.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.errors import DatasetError

LARGEST_CODE = 4095
PIXEL_FORMAT = "gray12le"
UNITS_M = {"mm": 1e-3, "m": 1.0}
DEFAULTS = {"depth_min": 0.01, "depth_max": 10.0, "shift": 3.5, "use_log": True}  # of LeRobot 0.6


def is_depth(feature: Mapping[str, Any]) -> bool:
    """Whether a feature is a depth stream."""
    info = _info(feature)
    return bool(info.get("is_depth_map") or info.get("video.is_depth_map"))


def unit_of(feature: Mapping[str, Any]) -> float | None:
    """Metres per step of depth images; None where the feature does not say."""
    return UNITS_M.get(str(_info(feature).get("depth_unit")))


def dequantised(codes: NDArray, feature: Mapping[str, Any], where: str) -> NDArray[np.float32]:
    """Depth in metres of ``codes (H, W)``, NaN where there is no reading. Raises `DatasetError`."""
    info = _info(feature)
    given = {name: info.get(f"video.{name}", default) for name, default in DEFAULTS.items()}
    near, far, shift = (given[name] for name in ("depth_min", "depth_max", "shift"))
    use_log = given["use_log"]
    numbers = all(isinstance(value, int | float) and np.isfinite(value) for value in (near, far, shift))
    if not numbers or not isinstance(use_log, bool) or not near < far or (use_log and near + shift <= 0):
        raise DatasetError(f"{where} has impossible depth parameters: {given}; restore its info.json")
    share = codes.astype(np.float64) / LARGEST_CODE
    with np.errstate(over="ignore", invalid="ignore"):  # of parameters beyond any camera
        depth = near + share * (far - near)
        if use_log:
            low, high = np.log(near + shift), np.log(far + shift)
            depth = np.exp(low + share * (high - low)) - shift
        return np.where(codes == 0, np.nan, depth).astype(np.float32)


def _info(feature: Mapping[str, Any]) -> Mapping[str, Any]:
    for name in ("info", "video_info"):
        if isinstance(feature.get(name), Mapping):
            return feature[name]
    return {}
