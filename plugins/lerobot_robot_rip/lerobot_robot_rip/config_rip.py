from __future__ import annotations

from dataclasses import dataclass

from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig
from lerobot.teleoperators import TeleoperatorConfig


@RobotConfig.register_subclass("rip_twin")
@dataclass
class RipTwinConfig(RobotConfig):
    """The cell of ``task``, with the scene of ``seed``.

    Each action takes ``1 / fps`` seconds of simulated time, so ``fps`` must be LeRobot's. ``depth`` is "native" (uint16
    millimetres ``(H, W, 1)``, LeRobot 0.6), "coded" (`datasets.coded_depth`, for the video of older ones) or "none".
    """

    task: str = "aloha-pick-banana"
    seed: int = 0
    fps: int = 5
    depth: str = "native"


@TeleoperatorConfig.register_subclass("rip_twin_leader")
@dataclass
class RipTwinLeaderConfig(TeleoperatorConfig):
    """The demonstrator of the twin's task; it waits ``pause_s`` seconds before and after a demonstration."""

    pause_s: float = 2.0


@CameraConfig.register_subclass("rip_realsense")
@dataclass(kw_only=True)
class RipRealSenseConfig(CameraConfig):
    """A RealSense camera by its ``serial`` number; empty takes the only one connected."""

    serial: str = ""
    fps: int = 30
    width: int = 640
    height: int = 480
