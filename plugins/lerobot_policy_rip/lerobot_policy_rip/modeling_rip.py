from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch
from huggingface_hub import snapshot_download
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor

from robust_instant_policy import RobustInstantPolicy, connect, load_demonstrations
from robust_instant_policy.errors import RipError, UsageError
from robust_instant_policy.motion.limits import Limits
from robust_instant_policy.policies import Settings

from .configuration_rip import RipConfig
from .embodiment import SIMULATED, Embodiment
from .planner import Calibration, Planner

logger = logging.getLogger(__name__)


class RipPolicy(PreTrainedPolicy):
    """Open loop: the first `select_action` after `reset` plans, the following ones return the plan's actions.

    LeRobot's loop waits for the plan, so the robot holds its position. The last action is repeated; without a plan
    that may be executed, the measured state is, which holds the robot where it is.
    """

    config_class = RipConfig
    name = "rip"

    def __init__(self, config: RipConfig, **_: Any):
        super().__init__(config)
        self.unused = torch.nn.Parameter(torch.zeros(1))  # LeRobot stores and loads a policy's weights
        self._planner = _make_planner(config)
        size = len(self._planner.embodiment.axes)
        config.output_features = {"action": PolicyFeature(FeatureType.ACTION, (size,))}
        self._image, self._depth = (f"observation.images.{config.camera}{suffix}" for suffix in ("", "_depth"))
        self.reset()

    def get_optim_params(self) -> Any:
        return self.parameters()

    def reset(self) -> None:
        self._chunk: Tensor | None = None
        self._step = 0

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict | None]:
        raise UsageError(
            "rip is not trained; make its folder with: python -m lerobot_policy_rip --demonstrations=DIR --out=DIR"
        )

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """The next action ``(B, D)``."""
        if self._chunk is None:
            self._chunk = self.predict_action_chunk(batch)
        last = self._chunk.shape[1] - 1
        action = self._chunk[:, min(self._step, last)]
        if self._step == last:
            logger.info("the motion has ended, the robot holds its position")
        self._step += 1
        return action

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **_: Any) -> Tensor:
        """The actions of whole episodes ``(B, N, D)``, each from its present image on."""
        missing = [key for key in (self._image, self._depth, "observation.state") if key not in batch]
        if missing:
            raise UsageError(f"the policy needs {', '.join(missing)}; the robot sends {', '.join(sorted(batch))}")
        images, depths, states = (batch[key].cpu() for key in (self._image, self._depth, "observation.state"))
        chunks = [self._plan(*parts) for parts in zip(images, depths, states, strict=True)]
        longest = max(len(chunk) for chunk in chunks)
        padded = [np.concatenate([chunk, np.repeat(chunk[-1:], longest - len(chunk), axis=0)]) for chunk in chunks]
        return torch.from_numpy(np.stack(padded).astype(np.float32)).to(self.unused.device)

    def _plan(self, image: Tensor, depth: Tensor, state: Tensor) -> np.ndarray:
        measured = state.numpy().astype(np.float64)
        try:
            rgb = (image.numpy() * 255).round().astype(np.uint8).transpose(1, 2, 0)
            metres = depth.numpy().astype(np.float32).reshape(rgb.shape[:2]) * np.float32(self.config.depth_unit_m)
            return self._planner.plan(rgb, metres, measured)
        except RipError as error:
            logger.error("no motion, the robot holds its position: %s", error)
            return measured[None, : len(self._planner.embodiment.axes)]


def _make_planner(config: RipConfig) -> Planner:
    demonstrations = load_demonstrations(_folder(config))
    settings = Settings.of(config.configuration).changed(
        num_queries=config.num_queries, seed=config.seed, workspace=config.workspace
    )
    policy = RobustInstantPolicy(connect(config.llm), settings, deadline_s=config.deadline_s).fit(demonstrations)
    triplets = np.concatenate([shown.trajectory.triplets for shown in demonstrations])
    camera = Calibration.of(demonstrations, config.intrinsics, config.camera_pose)
    embodiment = Embodiment(config.arms, triplets)
    limits = None
    if not all(arm.model in SIMULATED for arm in config.arms):
        if config.workspace is None:
            raise UsageError("a real arm needs workspace=[[x, y, z], [x, y, z]], lower and upper corner in metres")
        limits = Limits(np.array(config.workspace))
    return Planner(policy, embodiment, camera, config.min_confidence, config.rate_hz, config.waypoint_hz, limits)


def _folder(config: RipConfig) -> Path:
    """The folder of demonstrations: beside the policy's ``config.json``, as given, or downloaded from the Hub."""
    given = Path(config.demonstrations)
    for folder in (Path(config.pretrained_path or ".") / given, given):
        if folder.is_dir():
            return folder
    if config.demonstrations.count("/") == 1 and not given.is_absolute():
        return Path(snapshot_download(config.demonstrations, repo_type="dataset"))
    raise UsageError(f"there is no folder {config.demonstrations!r} with demonstrations")
