"""The Panda of ManiSkill's tasks for motion planning."""

from pathlib import Path

import mani_skill
import mujoco
import numpy as np

from robust_instant_policy.geometry import FloatArray, GripperTriangle
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.kinematics import Kinematics

URDF_PATH = Path(mani_skill.__file__).parent / "assets" / "robots" / "panda" / "panda_v2.urdf"
TOOL_LINK = "panda_hand_tcp"
NUM_JOINTS = 7
HAND_M, OPENING_M = 0.1034, 0.08  # from the flange to the tool point; between the open fingers (the URDF)
FINGER_TRAVEL_M = OPENING_M / 2
FINGER_SPEED_M_S = 0.1
JOINT_SPEED_RAD_S, TOOL_SPEED_M_S = 2.0, 1.5  # below 2.175 rad/s and 1.7 m/s, the limits of the arm (its data sheet)
TURN_TOLERANCE_RAD = 0.05


def panda(base: FloatArray) -> Arm:
    """The arm with its base at ``base (4, 4)``; the environments draw its start pose anew in each scene."""
    spec = mujoco.MjSpec.from_file(str(URDF_PATH))
    spec.compiler.fusestatic = False  # the tool frame is a separate link
    for geom in list(spec.geoms):  # only the joints are needed
        spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    return Arm(
        name="panda",
        kinematics=Kinematics(spec.compile(), TOOL_LINK, "body", NUM_JOINTS, base),
        home=np.zeros(NUM_JOINTS),
        triangle=GripperTriangle(length=HAND_M, opening=OPENING_M),
        finger_travel=FINGER_TRAVEL_M,
        finger_speed=FINGER_SPEED_M_S,
        joint_speed=JOINT_SPEED_RAD_S,
        tool_speed=TOOL_SPEED_M_S,
        turn_tolerance=TURN_TOLERANCE_RAD,
    )
