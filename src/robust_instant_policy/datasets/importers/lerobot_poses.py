"""Which features of a LeRobot v3 dataset hold the poses and the states of grippers; see `layouts` for their columns."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import chain, product
from typing import Any

import numpy as np

from robust_instant_policy.datasets import layout
from robust_instant_policy.datasets.folder import Folder
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
from robust_instant_policy.datasets.importers.source import Rig
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.geometry import FloatArray

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
Source = tuple[tuple[str, ...], Columns]  # one feature or two, and the columns of a pose in their numbers side by side


def poses_in(folder: Folder, episode: int, rig: Rig) -> FloatArray | None:
    """Poses ``(T, A, 4, 4)``; None where no feature is known to hold them."""
    where, name = [rig.pose_key] if rig.pose_key else _vectors(folder), f"{folder.root} (episode {episode})"
    if rig.joints is not None:
        models = {"": rig.joints} if isinstance(rig.joints, JointModel) else dict(zip(ARMS, rig.joints, strict=True))
        for key in where:
            names = axis_names(folder.info["features"][key])
            if names:
                values = _matrix(folder, episode, key)
                return np.stack([model.poses(names, values, arm) for arm, model in models.items()], axis=1)
    arms: dict[str, FloatArray] = {}
    for keys, columns in chain.from_iterable(_sources(folder, key, rig) for key in where):
        arm = columns.arm or arm_of(keys[0])
        if arm not in arms and (arm or not arms):  # an arm that has no name is the only one
            values = np.concatenate([_matrix(folder, episode, key) for key in keys], axis=1)
            said = name if len(keys) == 1 else f"{name}, {' with '.join(keys)}"
            arms[arm] = poses_of(said, values, columns, rig.position_unit_m, rig.rotation_unit_rad, rig.tool)
        if {"left", "right"} <= arms.keys() or "" in arms:
            break
    missing = {*ARMS} - arms.keys()
    alone = (key for key in where if arm_of(key) in missing and _is_gripper_position(folder, key))
    if arms and "" not in arms and (lone := next(alone, None)):
        raise DatasetError(f"{name}: {lone} has no rotation of the same name beside it, such as …_quat")
    return _side_by_side(arms)


def grippers_in(folder: Folder, episode: int, rig: Rig) -> FloatArray | None:
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
                found[arm] = _matrix(folder, episode, key)[:, column]
        if {"left", "right"} <= found.keys() or "" in found:
            break
    return _side_by_side(found)


def _side_by_side(arms: Mapping[str, FloatArray]) -> FloatArray | None:
    """What there is of each arm, ``(T, …)``, as ``(T, A, …)``: the left arm first; None where there is none."""
    chosen = [arms[arm] for arm in ARMS if arm in arms] or list(arms.values())
    return np.stack(chosen, axis=1) if chosen else None


def _matrix(folder: Folder, episode: int, key: str) -> FloatArray:
    values, names = folder.matrix(episode, key), axis_names(folder.info["features"][key])
    if names and values.shape[1] != len(names):
        raise DatasetError(f"{folder.root}: {key} has {values.shape[1]} numbers a frame and {len(names)} names")
    return values


def _vectors(folder: Folder) -> list[str]:
    """Features that may hold a pose or a gripper: measured ones first, then commanded ones."""
    keys = [key for key, feature in folder.info["features"].items() if feature["dtype"].startswith(("float", "int"))]
    groups = (layout.STATE_KEY, "observation.", layout.ACTION_KEY)
    return [key for group in groups for key in keys if next((g for g in groups if key.startswith(g)), "") == group]


def _sources(folder: Folder, key: str, rig: Rig) -> Iterator[Source]:
    """Poses in the feature ``key``, and one whose position it is and whose rotation another feature is."""
    names = axis_names(folder.info["features"][key])
    for columns in pose_columns(names, rig.rotation) or _unnamed(folder, key, names, rig):
        yield (key,), columns
    order = _order(names)
    if order is not None and _is_gripper_position(folder, key):
        for other, ending in product(_vectors(folder), ROTATION_ENDINGS):
            if _words(other) == [*_words(key)[:-1], *ending] and arm_of(other) == arm_of(key):
                for columns in _turns(folder.info["features"][other], ROTATION_ENDINGS[ending], rig.rotation):
                    yield (key, other), replace(columns, position=order)


def _turns(feature: Mapping[str, Any], kinds: Mapping[int, str], told: str | None) -> list[Columns]:
    """The columns of a rotation behind those of a position; none for names or widths that are not understood."""
    width, names = _width(feature), [name.lower() for name in axis_names(feature)]
    kind = told or kinds.get(width)
    if kind is None or (kind and ROTATIONS[kind] != width):
        return []
    if sorted(names) == ["w", "x", "y", "z"]:
        names = [f"q{name}" for name in names]
    found = pose_columns([*POSITION, *names], kind or None)
    if found or names not in ([], list(POSITION)):
        return found
    columns = unnamed_columns(len(POSITION) + width, kind or None)
    return [] if columns is None else [columns]


def _is_gripper_position(folder: Folder, key: str) -> bool:
    words = _words(key)
    named = len(words) > 1 and words[-1] in POSITION_ENDINGS and words[-2] in GRIPPERS and not NO_POSE & set(words)
    return named and _width(folder.info["features"][key]) == len(POSITION)


def _words(key: str) -> list[str]:
    return [word for word in words_of(key) if word not in ARMS]


def _width(feature: Mapping[str, Any]) -> int:
    return int(np.prod(feature["shape"]))


def _order(names: list[str]) -> tuple[int, ...] | None:
    """The columns of x, y and z; in this order where there are no names, None where the names are others."""
    last = [words[-1] if (words := words_of(name)) else "" for name in names]
    if not last:
        return (0, 1, 2)
    return tuple(last.index(axis) for axis in POSITION) if sorted(last) == list(POSITION) else None


def _unnamed(folder: Folder, key: str, names: list[str], rig: Rig) -> list[Columns]:
    """The pose in a feature that does not name its columns."""
    told = "_".join(_words(key))
    usual = next((name for name in UNNAMED_POSES if told.endswith(name)), None)
    if key != rig.pose_key and usual is None:
        return []
    size = _width(folder.info["features"][key])
    if len({*map(str.lower, names)} & {"x", "y", "z"}) == 3:  # named, in a way that is not understood
        return []
    columns = unnamed_columns(size, rig.rotation or UNNAMED_POSES.get(usual or ""))
    return [] if columns is None else [columns]
