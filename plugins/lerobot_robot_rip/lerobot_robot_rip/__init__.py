"""A simulated cell as a LeRobot robot and its leader: ``--robot.type=rip_twin --teleop.type=rip_twin_leader``."""

from .config_rip import RipTwinConfig, RipTwinLeaderConfig
from .leader import RipTwinLeader
from .twin import RipTwin

__all__ = ["RipTwin", "RipTwinConfig", "RipTwinLeader", "RipTwinLeaderConfig"]
