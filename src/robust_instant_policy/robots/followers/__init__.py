"""Arms that execute commands, one file a kind."""

from collections.abc import Callable
from importlib import import_module

from robust_instant_policy.errors import CellError
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.robots.cell import DeviceConfig
from robust_instant_policy.robots.follower import Follower

KINDS = {"viperx": "viperx", "ur5e": "ur", "lerobot": "lerobot"}


def make_follower(arm: Arm, device: DeviceConfig, rate_hz: float) -> Follower:
    """The driver of ``arm``, not yet connected. Raises `CellError` for an unknown kind, `MissingExtraError` where its
    library is not installed."""
    if device.kind not in KINDS:
        raise CellError(f"{device.where}: kind must be one of {', '.join(KINDS)}, not {device.kind!r}")
    make: Callable[..., Follower] = import_module(f"{__name__}.{KINDS[device.kind]}").make
    section = device.section()
    follower = make(arm, section, rate_hz)
    section.finish()
    return follower
