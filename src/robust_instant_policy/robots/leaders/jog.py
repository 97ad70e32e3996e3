"""Leaders that move the tool by steps: a keyboard, a gamepad or a SpaceMouse."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.state import ArmState, Command, is_gripping
from robust_instant_policy.robots.device import Device

LEAD_M, LEAD_RAD = 0.03, 0.3  # by which the wanted tool pose may be ahead of the measured one
JOG_SPEEDS = np.array([0.12] * 3 + [0.8] * 3)  # m/s and rad/s of axes that are pushed fully
REACHED_M = 0.003  # a pose that the arm misses by more is not commanded


class JogSource(Device, Protocol):
    """A device that a person pushes or presses."""

    def start(self) -> None:
        """Forget what the person did before the arm follows."""
        ...

    def step(self) -> tuple[FloatArray, bool]:
        """Since the last call: the wanted motion ``(6,)``, metres and rotation vector (rad) along the world's axes, and
        whether the gripper was told to open or close."""
        ...


class JogLeader:
    """See `robots.leader.Leader`: the tool of ``arm`` moves from where it is."""

    def __init__(self, source: JogSource, arm: Arm):
        self.name, self._source, self._arm = source.name, source, arm
        self._told: Command | None = None

    def connect(self) -> None:
        self._source.connect()

    def start(self) -> None:
        self._source.start()
        self._told = None

    def read(self, follower: ArmState) -> Command:
        arm = self._arm
        told = self._told or Command(follower.joints, self._first_travel(follower))
        motion, toggled = self._source.step()
        travel = told.finger_travel if not toggled else arm.finger_travel - told.finger_travel
        pose = arm.kinematics.tool_pose(told.joints)
        pose[:3, 3] += motion[:3]
        pose[:3, :3] = Rotation.from_rotvec(motion[3:]).as_matrix() @ pose[:3, :3]
        measured = arm.kinematics.tool_pose(follower.joints)
        ahead = np.linalg.norm(pose[:3, 3] - measured[:3, 3])
        turned = Rotation.from_matrix(measured[:3, :3].T @ pose[:3, :3]).magnitude()
        joints = told.joints
        if motion.any() and ahead < LEAD_M and turned < LEAD_RAD:
            path = arm.kinematics.follow(pose[None], told.joints)
            if path.position_error[0] < REACHED_M:
                joints = path.joints[0]
        self._told = Command(joints, travel)
        return self._told

    def _first_travel(self, follower: ArmState) -> float:
        """A closed gripper, or one that holds something, stays closed until it is told to open."""
        full = self._arm.finger_travel
        return full if follower.finger_travel > full / 2 and not is_gripping(follower, full) else 0.0

    def disconnect(self) -> None:
        self._source.disconnect()


# Key -> index of the motion and direction; the remaining letters are those of the recording.
KEYS = {
    "i": (0, 1), "k": (0, -1), "j": (1, 1), "l": (1, -1), "u": (2, 1), "m": (2, -1),
    "1": (3, 1), "2": (3, -1), "3": (4, 1), "4": (4, -1), "5": (5, 1), "6": (5, -1),
}  # fmt: skip
KEY_STEP_M, KEY_STEP_RAD = 0.004, 0.03  # a key that is held repeats about 30 times a second
GRIPPER_KEY = " "
ALL_KEYS = "".join(KEYS) + GRIPPER_KEY


class KeyboardSource:
    """Keys i k: along x, j l: along y, u m: along z, 1 to 6: about x, y, z; space opens or closes the gripper.

    ``pressed(keys)`` returns those of ``keys`` that were pressed since its last call.
    """

    name = "keyboard"

    def __init__(self, pressed: Callable[[str], str]):
        self._pressed = pressed

    def connect(self) -> None:
        self.start()

    def start(self) -> None:
        self._pressed(ALL_KEYS)

    def step(self) -> tuple[FloatArray, bool]:
        keys, motion = self._pressed(ALL_KEYS), np.zeros(6)
        for key in keys:
            if key in KEYS:
                index, direction = KEYS[key]
                motion[index] += direction * (KEY_STEP_M if index < 3 else KEY_STEP_RAD)
        return motion, keys.count(GRIPPER_KEY) % 2 == 1

    def disconnect(self) -> None:
        """Nothing to close."""
