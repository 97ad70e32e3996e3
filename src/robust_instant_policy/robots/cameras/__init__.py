"""RGB-D cameras, each behind the protocol of `robots.camera`."""

from pathlib import Path
from typing import Any

from robust_instant_policy.errors import CellError
from robust_instant_policy.plugins import own_module
from robust_instant_policy.robots.camera import VideoCamera
from robust_instant_policy.robots.cameras.lerobot import LeRobotCamera
from robust_instant_policy.robots.cameras.realsense import RealSenseCamera
from robust_instant_policy.robots.cameras.recorded import RecordedCamera
from robust_instant_policy.robots.cell import DeviceConfig
from robust_instant_policy.robots.emulation.client import EmulatedCamera

__all__ = ["LeRobotCamera", "RealSenseCamera", "RecordedCamera", "make_camera"]

KINDS = ("realsense", "lerobot", "folder", "emulated")


def make_camera(config: DeviceConfig, relative_to: Path) -> VideoCamera:
    """The camera that a cell's file describes, not connected; its paths are ``relative_to`` a folder.

    Raises `CellError` for an unknown kind or key. docs/calibration.md lists the keys of each kind.
    """
    section = config.section()
    camera: VideoCamera
    if config.kind == "realsense":
        camera = RealSenseCamera(
            section.text("serial", ""),
            section.whole("width", 640, least=1),
            section.whole("height", 480, least=1),
            section.whole("rate_hz", 30, least=1),
        )
    elif config.kind == "emulated":
        camera = EmulatedCamera(section.text("url"))
    elif config.kind == "folder":
        camera = RecordedCamera(relative_to / section.text("path"))
    elif config.kind == "lerobot":
        device = made_by(section.text("factory"), config.where)
        camera = LeRobotCamera(
            section.text("name", "lerobot"),
            device,
            section.array("intrinsics", (3, 3)),
            section.flag("aligned", False),
        )
    else:
        raise CellError(f"{config.where}: kind must be one of {', '.join(KINDS)}, not {config.kind!r}")
    section.finish()
    return camera


def made_by(factory: str, where: str) -> Any:
    """Call ``factory``, "module:function" of an installed module or of one in the working directory.

    Raises `CellError` if it does not exist or raises an error.
    """
    module, _, attribute = factory.partition(":")
    try:
        make = getattr(own_module(module), attribute)
    except (ImportError, AttributeError, ValueError, SyntaxError) as error:
        raise CellError(
            f"{where}: factory must be module:function of a module that is installed or lies in {Path.cwd()}: {error}"
        ) from None
    try:
        return make()
    except Exception as error:
        words = " ".join(str(error).split())
        raise CellError(f"{where}: the factory {factory} fails: {type(error).__name__}: {words}") from error
