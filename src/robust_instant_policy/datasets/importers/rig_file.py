"""A `Rig` in a JSON file, for the command line."""

from collections.abc import Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from robust_instant_policy.datasets.importers.joints import JointModel
from robust_instant_policy.datasets.importers.source import GripperCommand, Rig
from robust_instant_policy.errors import DatasetError, InvalidValueError
from robust_instant_policy.files import excerpt, read_json
from robust_instant_policy.geometry import GripperTriangle, as_numbers

OBJECTS = {kind.__name__: kind for kind in (Rig, GripperTriangle, GripperCommand, JointModel)}


def read_rig(path: Path) -> Rig:
    """The rig in a JSON file whose keys are the fields of `Rig`; a path in it is relative to the file.

    Raises `DatasetError` in one line for what is missing, unknown or wrong.
    """
    content = read_json(path, "a description of a rig")
    try:
        return _value("a rig", "Rig", content, path.parent)
    except InvalidValueError as error:
        raise DatasetError(f"{path} is not a description of a rig: {excerpt(error)}") from None


def _value(key: str, kind: str, value: Any, folder: Path) -> Any:
    """``value`` as the type that the annotation ``kind`` of the field ``key`` names. Raises `InvalidValueError`."""
    kind, *others = kind.removesuffix(" | None").split(" | ")
    if others and isinstance(value, list):  # of objects
        return tuple(_value(key, kind, inner, folder) for inner in value)
    if kind in OBJECTS:
        return _object(key, OBJECTS[kind], value, folder)
    if kind == "FloatArray":
        return as_numbers(key, value)
    if kind == "tuple[str, ...]":
        if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
            raise InvalidValueError(f"{key} must be a list of text, got {excerpt(repr(value))}")
        return tuple(value)
    if kind == "float" and isinstance(value, int | float) and not isinstance(value, bool):
        return value
    if kind == "float" or not isinstance(value, str):
        wanted = "a number" if kind == "float" else "text"
        raise InvalidValueError(f"{key} must be {wanted}, got {excerpt(repr(value))}")
    return folder / value if kind == "Path" else value


def _object(key: str, kind: type, value: Any, folder: Path) -> Any:
    if not isinstance(value, Mapping):
        raise InvalidValueError(f"{key} must be an object, got {excerpt(repr(value))}")
    known = {field.name: field for field in fields(kind)}
    unknown = [name for name in value if name not in known]
    lacking = [name for name, field in known.items() if field.default is MISSING and name not in value]
    if unknown or lacking:
        what = f"has no {excerpt(repr(unknown[0]))}" if unknown else f"needs {', '.join(lacking)}"
        raise InvalidValueError(f"{key} {what}; its keys are {', '.join(known)}")
    return kind(**{name: _value(name, str(known[name].type), inner, folder) for name, inner in value.items()})
