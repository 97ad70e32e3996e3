"""LeRobot v3 datasets whose frames carry end-effector poses, or joint positions and a URDF.

The format does not store the camera's intrinsics and pose or the meaning of gripper values, so the user supplies them.
Where the names of a vector's columns say what they are, see `layouts`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from robust_instant_policy.datasets import coded_depth, layout
from robust_instant_policy.datasets.folder import Folder, open_folder
from robust_instant_policy.datasets.images import decode_image
from robust_instant_policy.datasets.importers.depth import PIXEL_FORMAT, dequantised, is_depth, unit_of
from robust_instant_policy.datasets.importers.hdf5 import choose_camera
from robust_instant_policy.datasets.importers.joints import JointModel
from robust_instant_policy.datasets.importers.layouts import (
    ARMS,
    NO_POSE,
    POSITION,
    ROTATIONS,
    Columns,
    arm_of,
    axis_names,
    gripper_columns,
    is_gripper,
    pose_columns,
    poses_of,
    unnamed_columns,
    words_of,
)
from robust_instant_policy.datasets.importers.source import Rig, SourceEpisode
from robust_instant_policy.datasets.importers.timing import even_steps, held, resampled, seconds_of
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.files import excerpt
from robust_instant_policy.geometry import FloatArray, as_numbers

UNNAMED_POSES = {"cartesian_position": "rpy", "ee_pose": None, "eef_pose": None, "tcp_pose": None}  # and their rotation
# A position and its rotation in two features: the word before, and the last words of their names, with the rotation
# that so many numbers are ("" is a quaternion in an unknown order).
GRIPPERS = ("ee", "eef", "effector", "tcp", "gripper", "tool", "hand")
POSITION_ENDINGS = ("pos", "position", "xyz", "translation")
ROTATION_ENDINGS: dict[tuple[str, ...], dict[int, str]] = {
    **{(word,): {4: ""} for word in ("quat", "quaternion", "rot", "rotation", "ori", "orientation")},
    **{(word,): {3: "rpy"} for word in ("rpy", "euler")},
    **{words: {3: "rotvec", 4: "axis_angle"} for words in (("axis", "angle"), ("axisangle",))},
    ("rotvec",): {3: "rotvec"},
}
ADVICE = (
    "A LeRobot dataset names the axes of a pose ee.x, ee.y, ee.z and a rotation (ee.wx …, rx …, roll …, qx … qw), or "
    "the rig says where it is (pose_key, rotation) or how to compute it (joints: urdf, link), and which feature holds "
    "the depth (depth_key, depth_unit_m)"
)


def read_lerobot(path: Path, rig: Rig) -> Iterator[SourceEpisode]:
    """The episodes of a LeRobot v3 dataset."""
    folder = open_folder(path)
    if (path / layout.RIP_PATH).exists():
        raise DatasetError(f"{path} is already a demonstrations folder of rip; read it with load_demonstrations")
    features = folder.info["features"]
    for key in (rig.depth_key, rig.pose_key):
        if key is not None and key not in features:
            raise DatasetError(f"{path} has no feature {key!r}; it has: {excerpt(', '.join(features))}")
    images = [key for key, feature in features.items() if feature["dtype"] in ("video", "image")]
    cameras = [key for key in images if key != rig.depth_key and not is_depth(features[key])]
    camera = choose_camera(path, cameras, rig.camera)
    depth_key = rig.depth_key or _depth_stream(features, camera)
    for episode in range(len(folder.episodes)):
        poses, gripper = _poses(folder, episode, rig), _gripper(folder, episode, rig)
        rgb = None if camera is None else _first_image(folder, episode, camera)
        depth = None if depth_key is None else _first_depth(folder, episode, depth_key, rig.depth_unit_m)
        name = f"{path} (episode {episode})"
        frames = np.arange(folder.episodes[episode]["length"])
        seconds = None if rig.rate_hz is not None else _seconds(folder, episode, name)
        if seconds is not None:
            times = even_steps(seconds, folder.rate_hz)
            frames = held(seconds, times)
            poses = None if poses is None else resampled(poses, seconds, times)
            gripper = None if gripper is None else gripper[frames]
        yield SourceEpisode(
            name=name,
            rgb=rgb,
            depth=depth,
            poses=poses,
            gripper_values=gripper,
            rate_hz=folder.rate_hz,
            images=partial(_images, folder, episode, camera, frames) if camera in folder.video_keys else None,
            info={
                "source": path.name,
                "episode": episode,
                "description": _description(folder.episodes[episode].get("tasks")),
            },
            advice=ADVICE if poses is None or depth is None else "",
        )


def _description(tasks: object) -> str:
    return "; ".join(str(task) for task in tasks) if isinstance(tasks, list) else ""


def _seconds(folder: Folder, episode: int, name: str) -> FloatArray | None:
    if "timestamp" not in folder.info["features"]:
        return None
    stamps = folder.matrix(episode, "timestamp")[:, 0]
    if folder.info["features"]["timestamp"]["dtype"] == "float32" and len(stamps) > 1:
        step = np.spacing(np.abs(stamps).max().astype(np.float32))
        if step > 0.5 * np.ptp(stamps) / (len(stamps) - 1):  # as for times of day: too coarse for frames
            return None
    return seconds_of(name, stamps, folder.rate_hz)


def _vectors(folder: Folder) -> list[str]:
    """Features that may hold a pose or a gripper: measured ones first, then commanded ones."""
    keys = [key for key, feature in folder.info["features"].items() if feature["dtype"].startswith(("float", "int"))]
    groups = (layout.STATE_KEY, "observation.", layout.ACTION_KEY)
    return [key for group in groups for key in keys if next((g for g in groups if key.startswith(g)), "") == group]


def _poses(folder: Folder, episode: int, rig: Rig) -> FloatArray | None:
    """Poses ``(T, A, 4, 4)``; None where no feature is known to hold them."""
    where, name = [rig.pose_key] if rig.pose_key else _vectors(folder), f"{folder.root} (episode {episode})"
    if rig.joints is not None:
        models = {"": rig.joints} if isinstance(rig.joints, JointModel) else dict(zip(ARMS, rig.joints, strict=True))
        for key in where:
            names = axis_names(folder.info["features"][key])
            if names:
                values = _matrix(folder, episode, key, names)
                return np.stack([model.poses(names, values, arm) for arm, model in models.items()], axis=1)
    arms: dict[str, FloatArray] = {}
    for key in where:
        names = axis_names(folder.info["features"][key])
        for columns in pose_columns(names, rig.rotation) or _unnamed(folder, key, names, rig):
            arm = columns.arm or arm_of(key)
            if arm not in arms and (arm or not arms):  # an arm that has no name is the only one
                values = _matrix(folder, episode, key, names)
                arms[arm] = poses_of(name, values, columns, rig.position_unit_m, rig.rotation_unit_rad, rig.tool)
        pair = _rotation_for(folder, key, rig)
        if pair is not None and arm_of(key) not in arms and (arm_of(key) or not arms):
            other, order, columns = pair
            values = np.concatenate([folder.matrix(episode, key)[:, order], folder.matrix(episode, other)], axis=1)
            of_both = f"{name}, {key} with {other}"
            arms[arm_of(key)] = poses_of(of_both, values, columns, rig.position_unit_m, rig.rotation_unit_rad, rig.tool)
        if {"left", "right"} <= arms.keys() or "" in arms:
            break
    for key in where:
        if arms and "" not in arms and arm_of(key) not in arms and _is_gripper_position(folder, key):
            raise DatasetError(f"{name}: {key} has no rotation of the same name beside it, such as …_quat")
    chosen = [arms[arm] for arm in ARMS if arm in arms] or list(arms.values())
    return np.stack(chosen, axis=1) if chosen else None


def _rotation_for(folder: Folder, key: str, rig: Rig) -> tuple[str, list[int], Columns] | None:
    """The feature with the rotation where ``key`` holds the position of a gripper, such as ``ee_quat`` for ``ee_pos``.

    With it come the columns of x, y, z in ``key``, and where x, y, z and then the columns of the other feature are.
    None where there is no such pair, or names or widths that are not understood.
    """
    features = folder.info["features"]
    words, order = _words(key), _order(axis_names(features[key]))
    if not _is_gripper_position(folder, key) or order is None:
        return None
    for other, (ending, kinds) in product(_vectors(folder), ROTATION_ENDINGS.items()):
        if _words(other) != [*words[:-1], *ending] or arm_of(other) != arm_of(key):
            continue
        width, names = _width(features[other]), [name.lower() for name in axis_names(features[other])]
        kind = rig.rotation or kinds.get(width)
        if kind is None or (kind and ROTATIONS[kind] != width):
            continue
        if sorted(names) == ["w", "x", "y", "z"]:
            names = [f"q{name}" for name in names]
        found = pose_columns([*POSITION, *names], kind or None)
        if not found and names in ([], list(POSITION)):
            columns = unnamed_columns(len(POSITION) + width, kind or None)
            found = [] if columns is None else [columns]
        if found:
            return other, order, found[0]
    return None


def _is_gripper_position(folder: Folder, key: str) -> bool:
    words = _words(key)
    named = len(words) > 1 and words[-1] in POSITION_ENDINGS and words[-2] in GRIPPERS and not NO_POSE & set(words)
    return named and _width(folder.info["features"][key]) == len(POSITION)


def _words(key: str) -> list[str]:
    return [word for word in words_of(key) if word not in ARMS]


def _width(feature: Mapping[str, Any]) -> int:
    return int(np.prod(feature["shape"]))


def _order(names: list[str]) -> list[int] | None:
    """The columns of x, y and z; in this order where there are no names, None where the names are others."""
    last = [words[-1] if (words := words_of(name)) else "" for name in names]
    if not last:
        return [0, 1, 2]
    return [last.index(axis) for axis in POSITION] if sorted(last) == list(POSITION) else None


def _unnamed(folder: Folder, key: str, names: list[str], rig: Rig) -> list[Columns]:
    """The pose in a feature that does not name its columns."""
    told = "_".join(word for word in words_of(key) if word not in ARMS)
    usual = next((name for name in UNNAMED_POSES if told.endswith(name)), None)
    if key != rig.pose_key and usual is None:
        return []
    size = _width(folder.info["features"][key])
    if len({*map(str.lower, names)} & {"x", "y", "z"}) == 3:  # named, in a way that is not understood
        return []
    columns = unnamed_columns(size, rig.rotation or UNNAMED_POSES.get(usual or ""))
    return [] if columns is None else [columns]


def _gripper(folder: Folder, episode: int, rig: Rig) -> FloatArray | None:
    """Values of the grippers ``(T, A)``; None where no feature holds them."""
    found: dict[str, FloatArray] = {}
    for key in _vectors(folder):
        names, (size, *more) = axis_names(folder.info["features"][key]), folder.info["features"][key]["shape"] or [1]
        columns = gripper_columns(names)
        if not columns and is_gripper(key) and size == 1 and not more:
            columns, names = {arm_of(key): 0}, []
        for pose in () if columns else _unnamed(folder, key, names, rig):
            if size == len(pose.position) + len(pose.turns) + 1:  # one number more than those of the pose
                columns = {arm_of(key): size - 1}
        for arm, column in columns.items():
            if arm not in found:
                found[arm] = _matrix(folder, episode, key, names)[:, column]
        if {"left", "right"} <= found.keys() or "" in found:
            break
    chosen = [found[arm] for arm in ARMS if arm in found] or list(found.values())
    return np.stack(chosen, axis=1) if chosen else None


def _matrix(folder: Folder, episode: int, key: str, names: list[str]) -> FloatArray:
    values = folder.matrix(episode, key)
    if names and values.shape[1] != len(names):
        raise DatasetError(f"{folder.root}: {key} has {values.shape[1]} numbers a frame and {len(names)} names")
    return values


def _images(folder: Folder, episode: int, key: str, frames: NDArray[np.intp]) -> NDArray[np.uint8]:
    return np.stack(list(folder.frames(episode, key)))[frames]


def _depth_stream(features: Mapping[str, Any], camera: str | None) -> str | None:
    """The depth stream of ``camera``, or the only one."""
    streams = [key for key, feature in features.items() if is_depth(feature)]
    own = [key for key in streams if key == f"{camera}_depth"]
    return (own or streams)[0] if len(own or streams) == 1 else None


def _first_depth(folder: Folder, episode: int, key: str, unit_m: float | None) -> NDArray[np.float32]:
    """Depth ``(H, W)``, or ``(H·W,)`` where it is stored so, metres, of the first frame."""
    feature = folder.info["features"][key]
    if key in folder.video_keys and is_depth(feature):
        codes = next(folder.frames(episode, key, PIXEL_FORMAT))
        return dequantised(codes, feature, f"{folder.root}: {key}")
    image = _first_image(folder, episode, key)
    if image.ndim == 3 and image.shape[2] == 3:
        coded = coded_depth.decode(image)
        if coded is None:
            raise DatasetError(
                f"{folder.root}: {key} is a colour image, which holds no depth; record depth as a depth stream of "
                "lerobot 0.6, as a feature with one number a pixel, or coded as rip_twin does with --robot.depth=coded"
            )
        return coded
    unit = unit_m or unit_of(feature)
    if unit is None:
        raise DatasetError(
            f"{folder.root} does not say the unit of {key!r}; give depth_unit_m, metres per step, in the rig"
        )
    depth = image.astype(np.float32) * np.float32(unit)
    return depth[..., 0] if depth.ndim == 3 and depth.shape[2] == 1 else depth


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
