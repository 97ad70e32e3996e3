"""Checks of numbers from the caller; errors in one line."""

import math
import reprlib
import sys
from collections.abc import Collection
from numbers import Integral, Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robust_instant_policy.errors import InvalidValueError, UnknownNameError
from robust_instant_policy.geometry import as_numbers


def checked_positive(name: str, value: object, infinite: bool = False) -> float:
    """``value`` as a float > 0; ``infinite`` allows infinity. Text, booleans and NaN raise `InvalidValueError`."""
    if _is_number(value, Real) and value > 0 and (is_finite(value) or (infinite and value == math.inf)):  # type: ignore[operator]
        return float(value)  # type: ignore[arg-type]
    raise InvalidValueError(
        f"{name} must be a positive {'number or inf' if infinite else 'finite number'}, {_got(value)}"
    )


def checked_whole(name: str, value: object, least: int = 0) -> int:
    """``value`` as an int of at least ``least``. Text, booleans and fractions raise `InvalidValueError`."""
    if _is_number(value, Integral) and value >= least:  # type: ignore[operator]
        return int(value)  # type: ignore[call-overload]
    raise InvalidValueError(f"{name} must be a whole number of at least {least}, {_got(value)}")


def check_name(kind: str, name: str, known: Collection[str]) -> None:
    """Raise `UnknownNameError` unless ``name`` is one of the ``known``."""
    if name not in known:
        raise UnknownNameError(kind, name, known)


def checked_array(name: str, values: ArrayLike, shape: str) -> NDArray[np.float64]:
    """``values`` as finite float64 of a ``shape`` such as "(T, D)", or "(T, 3)" where the last must be 3.

    Text, booleans, complex numbers, NaN and infinity raise `InvalidValueError`.
    """
    array = as_numbers(f"{name} {shape}", values)
    if np.asarray(values).dtype == bool:
        raise InvalidValueError(f"{name} {shape} must be an array of numbers, got elements of type bool")
    sizes = [size.strip() for size in shape.strip("()").removesuffix(",").split(",")]
    if array.ndim != len(sizes) or any(a.isdigit() and int(a) != b for a, b in zip(sizes, array.shape, strict=True)):
        raise InvalidValueError(f"{name} must be {shape}, got shape {array.shape}")
    if not np.isfinite(array).all():
        first = tuple(int(index) for index in np.argwhere(~np.isfinite(array))[0])
        raise InvalidValueError(f"{name} of shape {array.shape} holds values that are not finite (first at {first})")
    return array


def checked_pose(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """``values`` as a rigid pose ``(4, 4)`` float64; anything else raises `InvalidValueError`."""
    pose = checked_array(name, values, "(4, 4)")
    rotation = pose[:3, :3]
    if np.abs(rotation).max() > 1.1 or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise InvalidValueError(f"{name} (4, 4) must hold a proper rotation")
    if np.linalg.det(rotation) < 0:
        raise InvalidValueError(f"{name} (4, 4) must hold a proper rotation, not a reflection")
    if not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-6):
        raise InvalidValueError(f"the last row of {name} (4, 4) must be 0 0 0 1; is it transposed?")
    return pose


def is_finite(value: object) -> bool:
    """Whether ``value`` is a number that a float can hold; `math.isfinite` raises for larger integers."""
    return _is_number(value, Real) and abs(value) <= sys.float_info.max  # type: ignore[arg-type]


def _is_number(value: object, kind: type) -> bool:
    return isinstance(value, kind) and not isinstance(value, bool | np.bool_)


def _got(value: object) -> str:
    return f"got {reprlib.repr(value)} ({type(value).__name__})"


def is_trusted(confidence: float | None, least: float) -> bool:
    """Whether a plan may be executed: it has a ``confidence`` above 0 of at least ``least``."""
    return confidence is not None and confidence > 0 and confidence >= least
