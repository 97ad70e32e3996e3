"""LeRobot v3 datasets whose frames carry end-effector poses.

The format does not store the camera's intrinsics and pose, the unit of depth or the meaning of gripper values,
so the user supplies them. A pose is three axes x, y, z and either wx, wy, wz (a rotation vector, as lerobot's own
kinematics write it: ``ee.x … ee.wz, ee.gripper_pos``) or qx, qy, qz, qw, with any prefix.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from robust_instant_policy.datasets import layout
from robust_instant_policy.datasets.folder import Folder, open_folder
from robust_instant_policy.datasets.images import decode_image
from robust_instant_policy.datasets.importers.hdf5 import choose_camera
from robust_instant_policy.datasets.importers.source import SourceEpisode, poses_of
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.files import excerpt
from robust_instant_policy.geometry import FloatArray, as_numbers

AXIS = re.compile(r"(?:.*[._ ])?(x|y|z|wx|wy|wz|qx|qy|qz|qw)$")
POSITION, ROTATION_VECTOR, QUATERNION = ("x", "y", "z"), ("wx", "wy", "wz"), ("qx", "qy", "qz", "qw")
POSE_FEATURES = (
    layout.STATE_KEY,
    layout.ACTION_KEY,
)  # features with poses; measured ones first, then commanded ones
ADVICE = (
    "A LeRobot dataset names the axes of a pose ee.x, ee.y, ee.z and ee.wx, ee.wy, ee.wz (rotation vector) or "
    "ee.qx … ee.qw; depth is a feature with one number a pixel, named by depth_key= with its depth_unit_m="
)


def read_lerobot(
    path: Path, camera: str | None, depth_key: str | None, depth_unit_m: float | None
) -> Iterator[SourceEpisode]:
    """The episodes of a LeRobot v3 dataset."""
    folder = open_folder(path)
    if (path / layout.RIP_PATH).exists():
        raise DatasetError(f"{path} is already a demonstrations folder of rip; read it with load_demonstrations")
    features = folder.info["features"]
    cameras = [key for key, feature in features.items() if feature["dtype"] in ("video", "image") and key != depth_key]
    chosen = choose_camera(path, cameras, camera)
    if depth_key is not None and depth_key not in features:
        raise DatasetError(f"{path} has no feature {depth_key!r}; it has: {excerpt(', '.join(features))}")
    if depth_key is not None and depth_unit_m is None:
        raise DatasetError(f"{path} does not say the unit of {depth_key!r}; give depth_unit_m=, metres a step")
    for episode in range(len(folder.episodes)):
        poses, gripper = _poses_and_gripper(folder, episode)
        depth = None
        if depth_key is not None and depth_unit_m is not None:
            depth = _first_image(folder, episode, depth_key).astype(np.float32) * np.float32(depth_unit_m)
            depth = depth[..., 0] if depth.ndim == 3 and depth.shape[2] == 1 else depth
        yield SourceEpisode(
            name=f"{path} (episode {episode})",
            rgb=None if chosen is None else _first_image(folder, episode, chosen),
            depth=depth,
            poses=poses,
            gripper_values=gripper,
            rate_hz=folder.rate_hz,
            images=partial(_all_images, folder, episode, chosen) if chosen in folder.video_keys else None,
            info={
                "source": path.name,
                "episode": episode,
                "description": _description(folder.episodes[episode].get("tasks")),
            },
            advice=ADVICE if poses is None or depth is None else "",
        )


def _description(tasks: object) -> str:
    return "; ".join(str(task) for task in tasks) if isinstance(tasks, list) else ""


def _poses_and_gripper(folder: Folder, episode: int) -> tuple[FloatArray | None, FloatArray | None]:
    poses = gripper = None
    for key in POSE_FEATURES:
        if key not in folder.info["features"]:
            continue
        names = _axis_names(folder.info["features"][key])
        axes = _pose_axes(names)
        grippers = [column for column, name in enumerate(names) if "gripper" in name.lower()]
        values = folder.matrix(episode, key)
        if names and values.shape[1] != len(names):
            raise DatasetError(f"{folder.root}: {key} has {values.shape[1]} numbers a frame and {len(names)} names")
        if poses is None and axes is not None:
            name = f"{folder.root} (episode {episode})"
            poses = poses_of(name, values[:, axes], range(3, len(axes)))
        if gripper is None and len(grippers) == 1:
            gripper = values[:, grippers[0]]
    return poses, gripper


def _axis_names(feature: Mapping[str, Any]) -> list[str]:
    """Names of a vector's axes; datasets have a list, or lists by kind of motor."""
    names = feature.get("names") or []
    if isinstance(names, Mapping):
        names = [name for group in names.values() if isinstance(group, list) for name in group]
    return [name for name in names if isinstance(name, str)] if isinstance(names, list) else []


def _pose_axes(names: Sequence[str]) -> list[int] | None:
    """Columns of x, y, z and the rotation; None if there is no pose or more than one."""
    columns: dict[str, list[int]] = {}
    for column, name in enumerate(names):
        match = AXIS.match(name)
        if match:
            columns.setdefault(match[1], []).append(column)
    for rotation in (ROTATION_VECTOR, QUATERNION):
        if all(len(columns.get(axis, [])) == 1 for axis in (*POSITION, *rotation)):
            return [columns[axis][0] for axis in (*POSITION, *rotation)]
    return None


def _all_images(folder: Folder, episode: int, key: str) -> NDArray[np.uint8]:
    return np.stack(list(folder.frames(episode, key)))


def _first_image(folder: Folder, episode: int, key: str) -> NDArray:
    """The first frame of an image feature: from a video, from stored image files, or from numbers."""
    if key in folder.video_keys:
        return next(folder.frames(episode, key))
    try:
        value = folder.columns(episode, [key])[key][0].as_py()
        if not isinstance(value, Mapping):
            return as_numbers(key, value, np.float32)
        if not isinstance(value.get("bytes"), bytes):
            raise ValueError("its images are not stored in the table")
        return np.asarray(decode_image(value["bytes"], ("PNG", "JPEG", "TIFF")))
    except (ValueError, OverflowError, pa.ArrowException) as error:
        raise DatasetError(
            f"{folder.root}: episode {episode} has no readable image {excerpt(key)!r} ({excerpt(error)})"
        ) from error
