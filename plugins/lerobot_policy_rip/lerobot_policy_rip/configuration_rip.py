from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig

from .embodiment import ArmConfig

DEADLINE_S = 600.0


@PreTrainedConfig.register_subclass("rip")
@dataclass
class RipConfig(PreTrainedConfig):
    """What a plan depends on, beside the scene.

    ``demonstrations`` is a folder of rip, or the id of a dataset on the Hub that is one. ``arms`` is the robot,
    ``camera`` the name of its depth camera, whose depth is ``CAMERA_depth`` in steps of ``depth_unit_m``;
    ``intrinsics (3, 3)`` and ``camera_pose (4, 4)``, camera to world, are those of the demonstrations unless given.
    ``llm`` is a language model as ``rip --llm`` takes it, ``configuration`` "adaptive" or "paper"; ``workspace (2,
    3)`` bounds what is recognised and where a real arm moves, metres. Plans with a confidence below
    ``min_confidence`` are not executed. ``rate_hz`` must be the rate at which LeRobot runs the robot;
    ``waypoint_hz`` sets the speed.
    """

    device: str | None = "cpu"  # nothing of it runs elsewhere
    demonstrations: str = ""
    arms: list[ArmConfig] = field(default_factory=list)
    camera: str = "top"
    depth_unit_m: float = 0.001
    intrinsics: list[list[float]] | None = None
    camera_pose: list[list[float]] | None = None
    llm: str = "embedded"
    configuration: str = "adaptive"
    num_queries: int = 5
    seed: int = 0
    deadline_s: float = DEADLINE_S
    workspace: list[list[float]] | None = None
    min_confidence: float = 0.9
    rate_hz: float = 30.0
    waypoint_hz: float = 1.0

    @property
    def action_feature_names(self) -> list[str]:
        """LeRobot compares these with the robot's."""
        return [axis for arm in self.arms for axis in arm.axes()]

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> None:
        return None

    @property
    def reward_delta_indices(self) -> None:
        return None

    def get_optimizer_preset(self) -> None:  # type: ignore[override]
        return None

    def get_scheduler_preset(self) -> None:
        return None

    def validate_features(self) -> None:
        """The policy checks its input when it plans."""
