"""Any robot that LeRobot knows (SO-100, SO-101 and others), through its ``Robot`` class or an object of that shape."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from robust_instant_policy.errors import RobotError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.state import ArmState, Command
from robust_instant_policy.robots.cameras import made_by
from robust_instant_policy.robots.cell import Section
from robust_instant_policy.robots.device import answered, numbers

GRIPPER_OPEN = 100.0  # of LeRobot's grippers, in percent
TORQUE_OFF = "disable_torque_on_disconnect"  # key of LeRobot's configurations, True by default


class LeRobotShape(Protocol):
    """What is used of LeRobot's ``Robot``."""

    def connect(self) -> None: ...
    def get_observation(self) -> Mapping[str, Any]: ...
    def send_action(self, action: dict[str, float]) -> Any: ...
    def disconnect(self) -> None: ...


def make(arm: Arm, section: Section, rate_hz: float) -> LeRobotFollower:
    """Options: ``factory`` "module:function" that makes the robot; ``keys`` of its joints in the order of the URDF,
    separated by spaces; ``gripper`` its key; ``signs`` and ``offsets`` (degrees) from LeRobot's angles to the URDF's:
    q = sign · (value - offset)."""
    keys = section.text("keys").split()
    count = len(arm.home)
    if len(keys) != count:
        raise section.error("keys", f"must name {count} joints, as many as park has angles")
    gripper = section.text("gripper", "gripper.pos")
    if len({*keys, gripper}) <= count:
        raise section.error("keys", "must name each joint once, and not the gripper")
    device = made_by(section.text("factory"), f"driver of {arm.name}")
    signs, offsets = (
        section.array(key, (count,), [value] * count) for key, value in (("signs", 1.0), ("offsets", 0.0))
    )
    if not np.isin(signs, (-1.0, 1.0)).all():
        raise section.error("signs", "must be 1 or -1 for each joint")
    return LeRobotFollower(arm.name, device, keys, gripper, signs, offsets, arm.finger_travel)


class LeRobotFollower:
    """See `robots.follower.Follower`. Angles are in degrees, as with ``use_degrees`` of LeRobot's robots.

    These robots have no clock of their own, so that a frozen reading is noticed by the following error only.
    """

    def __init__(
        self,
        name: str,
        device: LeRobotShape,
        keys: Sequence[str],
        gripper: str,
        signs: FloatArray,
        offsets: FloatArray,
        finger_travel: float,
    ):
        self.name, self._device, self._keys, self._gripper = name, device, tuple(keys), gripper
        self._signs, self._offsets, self._travel = signs, offsets, finger_travel
        self._before: tuple[float, FloatArray] | None = None

    def connect(self) -> None:
        config = getattr(self._device, "config", None)
        if getattr(config, TORQUE_OFF, False):
            setattr(config, TORQUE_OFF, False)  # the arm must not fall when the run ends
        self._answer(self._device.connect)
        self.state()

    def state(self) -> ArmState:
        seen = self._answer(self._device.get_observation)
        *values, opening = numbers(self.name, seen, (*self._keys, self._gripper))
        now = time.monotonic()
        joints = np.radians(self._signs * (np.array(values) - self._offsets))
        speeds = np.zeros_like(joints)
        if self._before is not None and now > self._before[0]:
            speeds = (joints - self._before[1]) / (now - self._before[0])
        self._before = now, joints
        return ArmState(joints, speeds, opening / GRIPPER_OPEN * self._travel, 0.0, now)

    def command(self, command: Command) -> None:
        values = self._signs * np.degrees(command.joints) + self._offsets
        action = dict(zip(self._keys, values.tolist(), strict=True))
        action[self._gripper] = command.finger_travel / self._travel * GRIPPER_OPEN
        self._answer(lambda: self._device.send_action(action))

    def stop(self) -> None:
        """The servos hold their last goal, which is one control step ahead."""

    def disconnect(self) -> None:
        with contextlib.suppress(RobotError):
            self._answer(self._device.disconnect)

    def _answer(self, call: Callable[[], Any]) -> Any:
        return answered(self.name, call, "; check its cable and its LeRobot calibration")
