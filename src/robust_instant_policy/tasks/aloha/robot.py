"""The two ViperX 300 arms of ALOHA, from the models that come with the `gym-aloha` package.

Shapes, masses and joint ranges are the package's. Its drives are stiffer than any servo and its collision shapes are
the fingers' convex hulls; both are replaced here: position drives with the torques that Robotis publishes for the
servos (Trossen Robotics lists the servo of each joint), and flat pads at the contact areas of the fingers.
"""

from pathlib import Path

import gym_aloha
import mujoco
import numpy as np

from robust_instant_policy.geometry import GripperTriangle
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.kinematics import Kinematics

MODEL_PATH = Path(gym_aloha.__file__).parent / "assets" / "bimanual_viperx_transfer_cube.xml"

ARMS = {"left": "vx300s_left", "right": "vx300s_right"}  # names in tasks and in the model
BASE_X_M = 0.469  # of the bases, to the left and right of the world's origin (gym-aloha)

ARM_JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
FINGERS = ("left_finger", "right_finger")
GRIPPER_LINK = "gripper_link"
TOOL = "tool"

TOOL_LENGTH_M = 0.1537  # from the wrist joint to the fingertips
CLOSED_M = 0.0224  # reading of a finger's joint at which the pads touch
FINGER_TRAVEL_M = 0.057 - CLOSED_M
FINGER_SPEED_M_S = 0.10
GRIP_FORCE_N = 25.0  # of each finger: ALOHA limits the gripper servo's current
PAD_FRICTION = 1.2  # grip tape
PAD_TORSION_M, PAD_ROLLING_M = 0.01, 1e-3

SERVO_TORQUE_NM = (10.6, 21.2, 21.2, 10.6, 10.6, 4.1)  # XM540-W270, two of them at shoulder and elbow, XM430-W350
JOINT_SPEED_LIMIT_RAD_S = 0.8 * np.pi  # XM540-W270: 30 rev/min without load
TOOL_SPEED_LIMIT_M_S = 0.6
TURN_TOLERANCE_RAD = 0.15  # needed where gripper and forearm align, in the middle of this arm's range
RELUCTANCE_M, ORIENTATION_COST_M = 0.008, 0.05
STIFFNESS = (300.0, 500.0, 400.0, 60.0, 60.0, 30.0)  # N m/rad: 5 mm into the table gives about 10 N
LAG_S = 0.03
ARMATURE = 0.02  # kg m², the rotors' inertia after the gears
FINGER_STIFFNESS = 8e3  # N/m: objects thicker than a few millimetres are held with the full force

HOME_JOINTS = (-1.4, -0.43, 0.434, 0.0, 1.567, 0.0)  # gripper down, beside the arm, outside the camera's view
PARKED_JOINTS = (0.0, -1.8, 1.6, 0.0, 0.3, 0.0)

TRIANGLE = GripperTriangle(length=TOOL_LENGTH_M, opening=2 * FINGER_TRAVEL_M)

BLACK = (0.16, 0.16, 0.17, 1.0)
GREY = (0.30, 0.30, 0.32, 1.0)


def two_arms() -> mujoco.MjSpec:
    """A model of the two arms alone, facing each other along x, the origin midway on the table."""
    spec = mujoco.MjSpec.from_file(str(MODEL_PATH))
    spec.modelname = "aloha"
    for things in (spec.keys, spec.actuators, spec.cameras, spec.lights, spec.textures, spec.materials):
        for thing in list(things):
            spec.delete(thing)
    for body in list(spec.worldbody.bodies):
        if body.name not in ARMS.values():
            spec.delete(body)
    spec.compiler.inertiagrouprange = [0, 5]
    for arm, side in zip(ARMS.values(), (-1, 1), strict=True):
        spec.body(arm).pos = [side * BASE_X_M, 0.0, 0.0]
        _refit(spec, arm)
    return spec


def _refit(spec: mujoco.MjSpec, arm: str) -> None:
    """Give an arm its tool frame, pads, colours and drives."""
    gripper_link = spec.body(f"{arm}/{GRIPPER_LINK}")
    # The tool's z is the gripper link's x; its y is minus the link's y, so that the tool points straight down with
    # yaw 0 where the arm reaches forward without rotating its wrist.
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.array([0.0, 0, 1, 0, -1, 0, 1, 0, 0]))
    gripper_link.add_site(name=f"{arm}/{TOOL}", pos=[TOOL_LENGTH_M, 0, 0], quat=quaternion, rgba=[0, 0, 0, 0])

    for geom in spec.geoms:
        if geom.name.startswith(arm):
            is_finger = "finger" in geom.name
            geom.rgba = GREY if is_finger else BLACK
            solid = not is_finger and "base" not in geom.name
            geom.contype, geom.conaffinity = _touches(arm) if solid else (0, 0)
    for finger, side in zip(FINGERS, (1, -1), strict=True):
        body = spec.body(f"{arm}/{finger}_link")
        inner = -side * CLOSED_M  # the pad's face, in the finger's frame
        _pad(body, (0.0585, inner + side * 0.0025, 0.0), (0.0265, 0.0025, 0.0055), _touches(arm))
        _pad(body, (0.0150, inner + side * 0.0050, 0.0), (0.0170, 0.0050, 0.0250), _touches(arm))

    for joint, stiffness, torque in zip(ARM_JOINTS, STIFFNESS, SERVO_TORQUE_NM, strict=True):
        _servo(spec, f"{arm}/{joint}", stiffness, LAG_S * stiffness, torque, ARMATURE)
    for finger in FINGERS:
        joint = spec.joint(f"{arm}/{finger}")
        joint.frictionloss, joint.armature = 0.0, 0.05
    _servo(spec, f"{arm}/{FINGERS[0]}", FINGER_STIFFNESS, 0.05 * FINGER_STIFFNESS, 2 * GRIP_FORCE_N, 0.05)
    geared = spec.add_equality(name=f"{arm}/gear", type=mujoco.mjtEq.mjEQ_JOINT)
    geared.name1, geared.name2 = f"{arm}/{FINGERS[1]}", f"{arm}/{FINGERS[0]}"
    geared.data[:5] = [0.0, -1.0, 0.0, 0.0, 0.0]

    for body in spec.bodies:
        if body.name.startswith(arm):
            body.gravcomp = 1.0


def _touches(arm: str) -> tuple[int, int]:
    """MuJoCo's contype and conaffinity of the parts of ``arm``: they touch objects and the other arm's parts."""
    bits = {name: 2 << index for index, name in enumerate(ARMS.values())}
    return 1 | bits[arm], sum(bits.values()) - bits[arm]


def _pad(
    finger, position: tuple[float, float, float], size: tuple[float, float, float], touches: tuple[int, int]
) -> None:
    finger.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=position,
        size=size,
        rgba=[0, 0, 0, 0],
        mass=0.0,
        condim=6,
        priority=1,
        friction=[PAD_FRICTION, PAD_TORSION_M, PAD_ROLLING_M],
        contype=touches[0],
        conaffinity=touches[1],
    )


def _servo(spec: mujoco.MjSpec, name: str, stiffness: float, damping: float, force: float, armature: float) -> None:
    joint = spec.joint(name)
    joint.frictionloss, joint.armature = 0.0, armature
    servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=stiffness, kv=damping)
    servo.forcelimited = True
    servo.forcerange = [-force, force]


def viperx(side: str) -> Arm:
    """The arm on the ``side`` "left" or "right", for motion planning."""
    spec = two_arms()
    for name in list(spec.actuators) + list(spec.equalities):
        spec.delete(name)
    for name, body in ARMS.items():
        if name != side:
            spec.delete(spec.body(body))
    kinematics = Kinematics(
        spec.compile(), f"{ARMS[side]}/{TOOL}", "site", len(ARM_JOINTS), np.eye(4), RELUCTANCE_M, ORIENTATION_COST_M
    )
    return Arm(
        name=side,
        kinematics=kinematics,
        home=np.array(HOME_JOINTS),
        triangle=TRIANGLE,
        finger_travel=FINGER_TRAVEL_M,
        finger_speed=FINGER_SPEED_M_S,
        joint_speed=JOINT_SPEED_LIMIT_RAD_S,
        tool_speed=TOOL_SPEED_LIMIT_M_S,
        turn_tolerance=TURN_TOLERANCE_RAD,
    )
