"""The policy: one plan for the first observation of a trial, executed in open loop."""

from __future__ import annotations

import numpy as np
from inspect_robots.policy import PolicyBase, PolicyConfig, PolicyInfo
from inspect_robots.scene import Scene
from inspect_robots.spaces import CameraSpec, ObservationSpace
from inspect_robots.types import Action, ActionChunk, Observation

import robust_instant_policy as rip
from inspect_robots_rip.actions import action_space, to_actions
from robust_instant_policy.policies import KeypointPolicy, Neighbours
from robust_instant_policy.serving.planner import require_confidence

DEPTH_KEYS = ("depth", "intrinsics", "camera_pose")  # in Observation.extra


class RipPolicy(PolicyBase):
    """Plans from the demonstrations in the folder ``demos``, with the language model ``llm``.

    ``method`` is "rip" or "neighbours" (no language model). ``camera`` names the image, whose ``depth (H, W)`` in
    metres, ``intrinsics (3, 3)`` and ``camera_pose (4, 4)`` (camera to world, OpenCV axes) are in the observation's
    ``extra``. A plan with a confidence below ``min_confidence`` raises `RefusedPlanError`, which fails the trial before
    the robot moves. After the last waypoint the robot holds it.
    """

    def __init__(
        self,
        demos: str,
        llm: str = "embedded",
        method: str = "rip",
        camera: str = "top",
        min_confidence: float = 0.9,
    ):
        demonstrations = rip.load_demonstrations(demos)
        first = demonstrations[0]
        self._planner: KeypointPolicy = (
            Neighbours() if method == "neighbours" else rip.RobustInstantPolicy(llm=rip.connect(llm))
        )
        self._planner.fit(demonstrations)
        self._triangle = rip.GripperTriangle.from_triplets(first.trajectory.triplets)
        self._camera, self._min_confidence = camera, float(min_confidence)
        self._rest: Action | None = None
        height, width = first.observation.depth.shape
        self.info = PolicyInfo(
            name=f"robust-instant-policy ({method})",
            action_space=action_space(first.trajectory.num_arms),
            observation_space=ObservationSpace((CameraSpec(camera, height, width),)),
        )
        self.config = PolicyConfig(action_horizon=self._planner.settings.num_steps)

    def reset(self, scene: Scene) -> None:
        """Forget the plan of the last trial."""
        self._rest = None

    def act(self, observation: Observation) -> ActionChunk:
        """All waypoints of the plan; their ``meta`` says which is the last one."""
        if self._rest is not None:
            return ActionChunk([self._rest])
        missing = [key for key in DEPTH_KEYS if key not in observation.extra]
        if missing:
            raise ValueError(
                f"Observation.extra lacks {', '.join(missing)}; an RGB-D camera with a calibration is needed"
            )
        calibrated = {key: np.asarray(observation.extra[key]) for key in DEPTH_KEYS}
        plan = self._planner.plan(rip.Observation(rgb=observation.images[self._camera], **calibrated))
        require_confidence(plan, self._min_confidence)
        rows = to_actions(plan.trajectory, self._triangle)
        self._rest = Action(rows[-1], {"is_last": True})
        meta = {"confidence": plan.confidence, "notes": list(plan.notes)}
        return ActionChunk([*map(Action, rows[:-1]), self._rest], inference_latency_s=plan.usage.seconds, meta=meta)
