"""A `Rig` in a JSON file, for the command line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from robust_instant_policy.datasets.importers.joints import JointModel
from robust_instant_policy.datasets.importers.source import GripperCommand, Rig
from robust_instant_policy.errors import DatasetError, InvalidValueError
from robust_instant_policy.files import excerpt, read_json
from robust_instant_policy.geometry import GripperTriangle, as_numbers

OBJECTS = {"triangle": GripperTriangle, "gripper": GripperCommand, "joints": JointModel}
MATRICES = {"intrinsics": (3, 3), "camera_pose": (4, 4), "tool": (4, 4)}
TEXTS = ("camera", "depth_key", "pose_key", "rotation")


def read_rig(path: Path) -> Rig:
    """The rig in a JSON file whose keys are the fields of `Rig`; a path in it is relative to the file.

    Raises `DatasetError` in one line for what is missing, unknown or wrong.
    """
    content = read_json(path, "a description of a rig")
    known = [field.name for field in fields(Rig)]
    unknown = [key for key in content if key not in known]
    if unknown or "triangle" not in content:
        what = (
            f"has no {excerpt(unknown[0])!r}" if unknown else 'needs "triangle": {"length": metres, "opening": metres}'
        )
        raise DatasetError(f"{path}: a rig {what}; its keys are {', '.join(known)}")
    try:
        return Rig(**{key: _value(key, value, path.parent) for key, value in content.items()})
    except (InvalidValueError, TypeError, ValueError) as error:
        raise DatasetError(f"{path} is not a description of a rig: {excerpt(error)}") from None


def _value(key: str, value: Any, folder: Path) -> Any:
    if key in OBJECTS:
        if not isinstance(value, Mapping):
            raise ValueError(f"{key} must be an object")
        given = {name: tuple(inner) if isinstance(inner, list) else inner for name, inner in value.items()}
        if key == "joints":
            given["urdf"] = folder / str(given.get("urdf"))
        return OBJECTS[key](**given)
    if key in MATRICES:
        matrix = as_numbers(key, value)
        if matrix.shape != MATRICES[key]:
            raise ValueError(f"{key} must be {MATRICES[key]}, got {matrix.shape}")
        return matrix
    if not isinstance(value, str if key in TEXTS else int | float) or isinstance(value, bool):
        raise ValueError(f"{key} must be {'text' if key in TEXTS else 'a number'}, got {excerpt(repr(value))}")
    return value
