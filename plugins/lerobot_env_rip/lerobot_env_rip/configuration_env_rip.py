from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

from robust_instant_policy.errors import UnknownNameError, UsageError
from robust_instant_policy.tasks import TASK_NAMES

from .env import RipEnv

IMAGE_SIZES = {"aloha": (480, 640)}
IMAGE_SIZE = (256, 256)


@EnvConfig.register_subclass("rip")
@dataclass
class RipEnvConfig(EnvConfig):
    """One of the simulated tasks, by the name that ``rip eval --tasks`` takes.

    With ``live_images=false`` observations hold the image of the start of the episode, which is much faster, and all
    that a policy in open loop looks at. ``fps`` is the rate of the cell's control; 0 takes it. ``max_seconds`` bounds
    an episode; it ends earlier when the commands stay the same for `env.HOLD_SECONDS`.
    """

    task: str | None = "push-cube"
    fps: int = 0
    live_images: bool = True
    max_seconds: float = 120.0
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.task not in TASK_NAMES:
            raise UnknownNameError("task", str(self.task), TASK_NAMES)
        aloha = self.task.startswith("aloha")
        rate = 50 if aloha else 55
        if self.fps not in (0, rate):
            raise UsageError(f"{self.task} is controlled at {rate} Hz: leave out env.fps, or give {rate}")
        self.fps = rate
        size = IMAGE_SIZES["aloha"] if aloha else IMAGE_SIZE
        dimensions = 14 if self.task == "aloha-sweep" else 7
        self.features = {
            "action": PolicyFeature(FeatureType.ACTION, (dimensions,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (dimensions,)),
            "pixels/top": PolicyFeature(FeatureType.VISUAL, (*size, 3)),
            "images.top_depth": PolicyFeature(FeatureType.VISUAL, (*size, 1)),
        }
        self.features_map = {
            "action": "action",
            "agent_pos": "observation.state",
            "pixels/top": "observation.images.top",
            "images.top_depth": "observation.images.top_depth",
        }

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {"task": self.task, "live_images": self.live_images, "max_seconds": self.max_seconds}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        make = [partial(RipEnv, **self.gym_kwargs)] * n_envs
        envs: VectorEnv
        if use_async_envs and n_envs > 1:
            envs = AsyncVectorEnv(make, autoreset_mode=AutoresetMode.SAME_STEP, context="forkserver")
        else:
            envs = SyncVectorEnv(make, autoreset_mode=AutoresetMode.SAME_STEP)
        return {"rip": {0: envs}}
