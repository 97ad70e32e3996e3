"""The simulated tasks as LeRobot environments, ``--env.type=rip --env.task=push-cube``."""

from .configuration_env_rip import RipEnvConfig
from .env import RipEnv

__all__ = ["RipEnv", "RipEnvConfig"]
