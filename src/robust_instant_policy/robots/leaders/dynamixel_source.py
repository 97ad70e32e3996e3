"""Leader arms of Dynamixel servos, moved by a person with the torque off."""

from collections.abc import Sequence

import numpy as np

from robust_instant_policy.errors import RobotError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.robots import dynamixel as dxl
from robust_instant_policy.robots.dynamixel import TIMEOUT_MS
from robust_instant_policy.robots.leaders.joint_map import JointMap

# ALOHA's leader, a WidowX 250: as its follower, joint by joint; the second servos of shoulder and elbow are not read.
ALOHA_SERVOS = (1, 2, 4, 6, 7, 8, 9)
ALOHA_GRIPPER_OPEN_RAD, ALOHA_GRIPPER_CLOSED_RAD = 0.3083, -0.6842
GELLO_SERVOS = (1, 2, 3, 4, 5, 6, 7)


class DynamixelSource:
    """See `JointSource`; the ``servos`` in the order of the channels."""

    def __init__(self, name: str, port: str, baud: int, servos: Sequence[int], timeout_ms: float = TIMEOUT_MS):
        self.name, self._servos = name, tuple(servos)
        names = {servo: f"{name}, channel {index}" for index, servo in enumerate(servos)}
        self._bus = dxl.Bus(port, baud, names, timeout_ms)

    def connect(self) -> None:
        self._bus.open()
        try:
            missing = [str(servo) for servo in self._servos if self._bus.ping(servo) is None]
            if missing:
                raise RobotError(
                    f"{self._bus.port}: no answer from servo {', '.join(missing)} of {self.name}; check power, cables, "
                    "and the baud rate"
                )
            for servo in self._servos:
                self._bus.write(servo, dxl.TORQUE, 0)
        except RobotError:
            self._bus.close()
            raise

    def angles(self) -> FloatArray:
        return dxl.to_angle(self._bus.sync_read(self._servos, dxl.PRESENT_POSITION)[:, 0])

    def disconnect(self) -> None:
        self._bus.close()


def aloha_map() -> JointMap:
    """ALOHA's leader as Interbotix assembles it: no offsets."""
    joints = len(ALOHA_SERVOS) - 1
    return JointMap(
        np.arange(joints),
        np.ones(joints),
        np.zeros(joints),
        joints,
        ALOHA_GRIPPER_OPEN_RAD,
        ALOHA_GRIPPER_CLOSED_RAD,
    )
