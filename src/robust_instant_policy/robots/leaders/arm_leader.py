"""A leader with the joints of its follower: GELLO, ALOHA's leader arms, any `Teleoperator` of LeRobot."""

from typing import Protocol

import numpy as np

from robust_instant_policy.errors import RobotError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.state import ArmState, Command
from robust_instant_policy.robots.device import Device
from robust_instant_policy.robots.leaders.joint_map import JointMap

MAX_STEP_RAD = 1.0  # between two readings; a servo that restarted jumps by more


class JointSource(Device, Protocol):
    """A device with S angles."""

    def angles(self) -> FloatArray:
        """Readings ``(S,)`` rad."""
        ...


class ArmLeader:
    """See `robots.leader.Leader`; ``finger_travel`` is the follower's, metres.

    Servos count turns from the angle at power-on. So at the first reading after `start`, the number of whole turns that
    is nearest to the follower's joints is chosen; later readings are unwrapped from there.
    """

    def __init__(self, source: JointSource, joints: JointMap, finger_travel: float):
        self.name, self._source, self._map, self._travel = source.name, source, joints, finger_travel
        self._last: FloatArray | None = None

    def connect(self) -> None:
        self._source.connect()
        count, most = len(self._source.angles()), max(*self._map.channels.tolist(), self._map.gripper_channel)
        if most >= count:
            raise RobotError(
                f"{self.name} has {count} channels, 0 to {count - 1}; its calibration reads channel {most}: run "
                "rip calibrate leader"
            )

    def start(self) -> None:
        self._last = None

    def read(self, follower: ArmState) -> Command:
        readings = self._source.angles()
        if not np.isfinite(readings).all():
            raise RobotError(f"{self.name} reads angles that are not numbers; check its cables")
        angles = self._map.joints(readings)
        near = follower.joints if self._last is None else self._last
        angles = angles - 2 * np.pi * np.round((angles - near) / (2 * np.pi))
        if self._last is not None and np.abs(angles - self._last).max() > MAX_STEP_RAD:
            joint = int(np.abs(angles - self._last).argmax())
            raise RobotError(
                f"{self.name}: joint {joint + 1} jumped by {np.degrees(angles[joint] - self._last[joint]):.0f} degrees "
                "between two readings; its servo restarted or slipped: check the power supply, and begin again"
            )
        self._last = angles
        return Command(angles, self._map.opening(readings) * self._travel)

    def disconnect(self) -> None:
        self._source.disconnect()
