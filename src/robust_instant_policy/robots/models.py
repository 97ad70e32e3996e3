"""Models of known arms: kinematics from a URDF, gripper and limits from data sheets."""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from robust_instant_policy import motion
from robust_instant_policy.errors import CellError
from robust_instant_policy.geometry import FloatArray, GripperTriangle, make_pose
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.kinematics import ORIENTATION_COST, Kinematics
from robust_instant_policy.robots.cell import SPEEDS, ArmConfig

URDF_FOLDER = Path(motion.__file__).with_name("urdf")
TOOL = "tool"  # the frame between the fingertips, z along the approach, y along the opening


@dataclass(frozen=True)
class ArmModel:
    """An arm with its gripper; see `Arm` for the units.

    ``driver`` is the kind of its own driver. A user's own URDF must hold a link called `TOOL`; as many of its first
    joints as ``park`` has angles are the arm's, a jaw after them is not.
    """

    urdf: Path
    driver: str
    triangle: GripperTriangle
    finger_speed: float
    joint_speed: float
    joint_acceleration: float
    tool_speed: float
    turn_tolerance: float
    posture_cost: float = 0.0
    orientation_cost: float = ORIENTATION_COST


KNOWN = {
    # Joint speed: XM540-W270 at 30 rev/min without load, with a margin. Its wrist has a singular pose in the middle of
    # the range, hence the posture cost and the tolerance (see `tasks.aloha.robot`).
    "viperx-300": ArmModel(
        URDF_FOLDER / "viperx_300.urdf",
        "viperx",
        GripperTriangle(length=0.1537, opening=0.0692),
        finger_speed=0.10,
        joint_speed=0.8 * np.pi,
        joint_acceleration=25.0,
        tool_speed=0.6,
        turn_tolerance=0.15,
        posture_cost=0.008,
        orientation_cost=0.05,
    ),
    # 180 degrees/s and a typical tool speed of 1 m/s from the UR5e data sheet; stroke of the Hand-E from its manual.
    "ur5e-hand-e": ArmModel(
        URDF_FOLDER / "ur5e_hande.urdf",
        "ur5e",
        GripperTriangle(length=0.157, opening=0.050),
        finger_speed=0.075,
        joint_speed=0.8 * np.pi,
        joint_acceleration=25.0,
        tool_speed=1.0,
        turn_tolerance=0.05,
    ),
}
# Limits of an arm that is not in the table: a slow desktop arm.
OTHER = {"finger_speed": 0.05, "joint_speed": 1.5, "joint_acceleration": 15.0, "tool_speed": 0.3, "turn_tolerance": 0.3}


def arm_of(config: ArmConfig, folder: Path = Path()) -> Arm:
    """The arm for motion planning; ``folder`` holds the cell's file. Raises `CellError` for an unknown model."""
    model = KNOWN.get(config.model)
    if model is None:
        path = folder / config.model
        if path.suffix != ".urdf" or not path.exists():
            raise CellError(f"{config.name}: no model {config.model!r}; known: {', '.join(KNOWN)}, or a .urdf file")
        if config.gripper is None:
            raise CellError(f"{config.name}: gripper is missing; an arm of your own needs its length and opening")
        model = ArmModel(path, config.driver.kind, config.gripper, **OTHER)
    else:
        _check_known(config, model)
    try:
        spec = mujoco.MjSpec.from_file(str(model.urdf))
        spec.compiler.fusestatic = False  # the tool frame is a separate link
        if config.tool is not None:
            _move_tool(spec.body(TOOL), config.tool)
        compiled = spec.compile()
        compiled.body(TOOL)
    except (ValueError, KeyError, AttributeError) as error:
        words = " ".join(str(error).split())
        raise CellError(f"{model.urdf} cannot be used: {words}; it needs a link called {TOOL}") from None
    if not compiled.ngeom:
        raise CellError(f"{model.urdf} has no collision shapes, without which links cannot be kept apart; add them")
    count = len(config.park)
    revolute = int(np.cumprod(compiled.jnt_type == mujoco.mjtJoint.mjJNT_HINGE).sum())
    if count == 0 or count > revolute or (config.model in KNOWN and count != revolute):
        raise CellError(f"{config.name}: park must hold {revolute} angles, one for each joint, not {count}")
    triangle = config.gripper or model.triangle
    kinematics = Kinematics(compiled, TOOL, "body", count, config.base, model.posture_cost, model.orientation_cost)
    for joint, (angle, (low, high)) in enumerate(zip(config.park, kinematics.joint_range, strict=True)):
        if not low <= angle <= high:
            raise CellError(
                f"{config.name}: park turns joint {joint + 1} to {angle:g} rad, its range is {low:.2f} to {high:.2f}"
            )
    return Arm(
        name=config.name,
        kinematics=kinematics,
        home=np.array(config.park),
        triangle=triangle,
        finger_travel=triangle.opening / 2,
        finger_speed=model.finger_speed,
        joint_speed=config.joint_speed or model.joint_speed,
        tool_speed=config.tool_speed or model.tool_speed,
        turn_tolerance=model.turn_tolerance,
        joint_acceleration=config.joint_acceleration or model.joint_acceleration,
    )


def _check_known(config: ArmConfig, model: ArmModel) -> None:
    """Raises `CellError` for another arm's driver, and for speeds above those that the model is known to keep."""
    if config.driver.kind not in (model.driver, "lerobot"):
        raise CellError(
            f"{config.driver.where}: kind must be {model.driver} or lerobot for a {config.model}, not "
            f"{config.driver.kind!r}"
        )
    for key in SPEEDS:
        wanted, most = getattr(config, key), getattr(model, key)
        if wanted is not None and wanted > most:
            raise CellError(f"{config.name}: {key} is {wanted:g}, a {config.model} has at most {most:.3g}; lower it")


def _move_tool(link: mujoco.MjsBody, tool: FloatArray) -> None:
    """Correct the tool's link by ``tool (4, 4)``, measured -> model's."""
    pose = make_pose(Rotation.from_quat(np.asarray(link.quat)[[1, 2, 3, 0]]).as_matrix(), link.pos) @ tool
    link.pos, link.quat = pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]
