"""Simulated cells in LeRobot, ``--robot.type=rip_twin --teleop.type=rip_twin_leader``, and a depth camera for any arm,
``type: rip_realsense``."""

from .camera import RipRealSense
from .config_rip import RipRealSenseConfig, RipTwinConfig, RipTwinLeaderConfig
from .leader import RipTwinLeader
from .twin import RipTwin

__all__ = ["RipRealSense", "RipRealSenseConfig", "RipTwin", "RipTwinConfig", "RipTwinLeader", "RipTwinLeaderConfig"]
