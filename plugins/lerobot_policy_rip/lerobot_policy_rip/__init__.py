"""Robust Instant Policy as a LeRobot policy, ``--policy.type=rip``."""

from .configuration_rip import RipConfig
from .modeling_rip import RipPolicy
from .processor_rip import make_rip_pre_post_processors

__all__ = ["RipConfig", "RipPolicy", "make_rip_pre_post_processors"]
