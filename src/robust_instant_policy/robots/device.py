"""What all devices have in common."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

from robust_instant_policy.errors import RobotError


class Device(Protocol):
    """The methods raise `RobotError` when the device does not answer."""

    name: str

    def connect(self) -> None: ...
    def disconnect(self) -> None: ...


D = TypeVar("D", bound=Device)
T = TypeVar("T")


@contextmanager
def connected(device: D) -> Iterator[D]:
    """``device``, connected while the context lasts."""
    device.connect()
    try:
        yield device
    finally:
        device.disconnect()


def answered(name: str, call: Callable[[], T], advice: str = "") -> T:
    """What ``call`` to a device of LeRobot returns; raises `RobotError` in place of what LeRobot raises."""
    try:
        return call()
    except (OSError, RuntimeError, ValueError) as error:  # `TimeoutError` is an `OSError`
        raise RobotError(f"{name} does not answer: {error}{advice}") from error


def numbers(name: str, values: Mapping[str, Any], keys: Sequence[str]) -> list[float]:
    """Those of ``keys`` in the ``values`` of a device of LeRobot; raises `RobotError` for missing ones."""
    missing = [key for key in keys if key not in values]
    if missing:
        raise RobotError(f"{name} has no {', '.join(missing)}; it has {', '.join(sorted(map(str, values)))}")
    return [float(values[key]) for key in keys]
