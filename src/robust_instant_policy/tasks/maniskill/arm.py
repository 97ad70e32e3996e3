"""The UR5e with the Hand-E gripper for motion planning."""

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.geometry import make_pose
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.kinematics import Kinematics
from robust_instant_policy.tasks.maniskill.cell import BASE_POSITION_M, HOME_JOINTS
from robust_instant_policy.tasks.maniskill.robot import (
    ARM_JOINTS,
    FINGER_SPEED_M_S,
    FINGER_TRAVEL_M,
    GRIPPER_TRIANGLE,
    TOOL_LINK,
    URDF_PATH,
)

EXECUTE_HZ = 5.5  # "5.5 Hz during the test phase" (Oh et al. 2025, Sec. V-A.1)
JOINT_SPEED_LIMIT_RAD_S = 0.8 * np.pi  # the joints' 180 degrees/s, with a margin for tracking
TOOL_SPEED_LIMIT_M_S = 1.0  # "typical TCP speed 1 m/s" (UR5e data sheet)

TURN_TOLERANCE_RAD = 0.05


def ur5e_kinematics(base_position: ArrayLike) -> Kinematics:
    """The arm with its base at ``base_position (3,)`` metres, not rotated."""
    spec = mujoco.MjSpec.from_file(str(URDF_PATH))
    spec.compiler.fusestatic = False  # the tool frame is a separate link
    return Kinematics(spec.compile(), TOOL_LINK, "body", len(ARM_JOINTS), make_pose(np.eye(3), base_position))


def ur5e_hande() -> Arm:
    """The arm of the cell."""
    return Arm(
        name="hand-e",
        kinematics=ur5e_kinematics(BASE_POSITION_M),
        home=np.array(HOME_JOINTS),
        triangle=GRIPPER_TRIANGLE,
        finger_travel=FINGER_TRAVEL_M,
        finger_speed=FINGER_SPEED_M_S,
        joint_speed=JOINT_SPEED_LIMIT_RAD_S,
        tool_speed=TOOL_SPEED_LIMIT_M_S,
        turn_tolerance=TURN_TOLERANCE_RAD,
    )
