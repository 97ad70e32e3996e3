"""From one observation of a robot to the actions of a whole episode, without LeRobot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import UsageError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.guard import check_motion, check_waypoints, retimed
from robust_instant_policy.motion.kinematics import Kinematics
from robust_instant_policy.motion.limits import Limits
from robust_instant_policy.motion.waypoints import plan_waypoints
from robust_instant_policy.policies import Policy
from robust_instant_policy.serving.planner import require_confidence

from .embodiment import Embodiment

SAME_CAMERA = 1e-6  # by which intrinsics, pixels, and camera poses, metres, of one camera may differ


@dataclass(frozen=True, eq=False)
class Calibration:
    """Of the camera: ``intrinsics (3, 3)`` pixels, ``pose (4, 4)`` camera to world, OpenCV axes."""

    intrinsics: FloatArray
    pose: FloatArray

    @classmethod
    def of(
        cls, demonstrations: Sequence[Demonstration], intrinsics: ArrayLike | None, pose: ArrayLike | None
    ) -> Calibration:
        """What is given, and what the demonstrations say of the rest if their cameras are all alike."""
        seen = [shown.observation for shown in demonstrations]
        if intrinsics is None:
            intrinsics = _common("intrinsics", [one.intrinsics for one in seen])
        if pose is None:
            pose = _common("camera_pose", [one.camera_pose for one in seen])
        return cls(np.asarray(intrinsics, dtype=np.float64), np.asarray(pose, dtype=np.float64))


def _common(name: str, values: Sequence[FloatArray]) -> FloatArray:
    if max(np.abs(value - values[0]).max() for value in values) > SAME_CAMERA:
        raise UsageError(f"the demonstrations' cameras differ; give the present one's {name}")
    return values[0]


class Planner:
    """Plans with a fitted ``policy`` for the robot ``embodiment``, at ``rate_hz`` actions and ``waypoint_hz`` waypoints
    per second; plans with a confidence below ``min_confidence`` are refused.

    With ``limits`` the motion passes every check of a real arm; None leaves those of the simulated tasks.
    """

    def __init__(
        self,
        policy: Policy,
        embodiment: Embodiment,
        camera: Calibration,
        min_confidence: float,
        rate_hz: float,
        waypoint_hz: float,
        limits: Limits | None = None,
    ):
        self._policy, self._camera, self._min_confidence = policy, camera, min_confidence
        self._rate_hz, self._waypoint_hz = rate_hz, waypoint_hz
        self._limits = limits
        self.embodiment = embodiment

    def plan(self, rgb: NDArray[np.uint8], depth: FloatArray, state: ArrayLike) -> FloatArray:
        """Actions ``(N, D)`` from the measured ``state (S >= D,)`` on, for an image ``rgb (H, W, 3)`` and its aligned
        ``depth (H, W)``, metres, 0 where there is no reading.

        Raises a `RipError` in one line for what must not be executed: no plan, a confidence below the limit, a
        trajectory that the arms cannot follow.
        """
        arms = self.embodiment.arms_at(state)
        plan = self._policy.plan(Observation(rgb, depth, self._camera.intrinsics, self._camera.pose))
        require_confidence(plan, self._min_confidence)
        motion = plan_waypoints(plan.trajectory, arms, self._waypoint_hz, self._rate_hz)
        if self._limits is not None:
            check_waypoints(plan.trajectory, arms, self._limits)
            motion = retimed(motion, arms, self._rate_hz)
            if all(isinstance(arm.kinematics, Kinematics) for arm in arms):  # links are known
                check_motion(motion, arms, self._limits, self._rate_hz)
        return self.embodiment.to_robot(motion.commands)
