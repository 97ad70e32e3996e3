"""The robot as LeRobot measures and commands it, and its arms as `robust_instant_policy.motion` plans for them.

A state or an action of LeRobot is a vector ``(D,)``: for each arm its joints, then its gripper; or for an arm that is
commanded by pose ``x, y, z`` (metres) and a rotation vector ``wx, wy, wz`` (rad), then its gripper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from robust_instant_policy.errors import UsageError
from robust_instant_policy.geometry import FloatArray, GripperTriangle, invert_pose, make_pose
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.kinematics import ORIENTATION_COST, JointPath, Kinematics

POSE_AXES = ("ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz")
VIPERX_JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
UR5E_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
SIMULATED = {"viperx-left": VIPERX_JOINTS, "viperx-right": VIPERX_JOINTS, "ur5e-hande": UR5E_JOINTS}
DEGREES_OF_FREEDOM = 6  # of a pose
ORIENTATION_COST_FEW_JOINTS = 0.01  # metres per radian: an arm with fewer joints reaches positions first
MESHES = (".stl", ".obj", ".msh")  # that MuJoCo reads
MIN_MASS = 1e-3  # kg, and kg m², of a link without inertia in a file: kinematics needs none


@dataclass
class ArmConfig:
    """One arm.

    ``model`` is its URDF or MJCF file, or one of `SIMULATED`; empty for an arm that is commanded by pose. ``name`` goes
    before the names of its features where there are two arms. ``joints`` are the first joints of the model, in order.
    ``tool`` is the link that carries the gripper, and ``tool_offset (4, 4)`` within it, or within the frame of the
    commanded pose, the tool frame: z out of the gripper, y along the line on which the fingers open, origin between
    the fingertips. ``base (4, 4)`` is the pose of the arm's base in the world of the demonstrations. ``degrees`` is the
    unit of joints; ``gripper_open`` and ``gripper_closed`` are readings of the gripper.
    Limits: ``joint_speed`` rad/s, ``joint_acceleration`` rad/s², ``tool_speed`` and ``finger_speed`` m/s;
    ``turn_tolerance`` rad is the largest accepted orientation error, larger for arms with less than six joints.
    """

    model: str = ""
    name: str = ""
    joints: list[str] = field(default_factory=list)
    tool: str = ""
    tool_offset: list[list[float]] | None = None
    base: list[list[float]] | None = None
    degrees: bool = True
    gripper_open: float = 100.0
    gripper_closed: float = 0.0
    joint_speed: float = 1.0
    joint_acceleration: float = 15.0
    tool_speed: float = 0.25
    finger_speed: float = 0.05
    turn_tolerance: float = 0.05

    def axes(self) -> list[str]:
        """Names of the arm's part of a state or action."""
        names = list(self.joints or SIMULATED.get(self.model, ())) if self.model else list(POSE_AXES)
        prefix = f"{self.name}_" if self.name else ""
        return [f"{prefix}{name}.pos" for name in (*names, "gripper" if self.model else "ee.gripper")]


class PoseKinematics:
    """An arm that is commanded by pose: its ``joints (6,)`` are a position, m, and a rotation vector, rad."""

    num_joints = 6

    def __init__(self, base: FloatArray, tool_offset: FloatArray):
        self._base, self._tool_offset = base, tool_offset

    def tool_pose(self, joints: ArrayLike) -> FloatArray:
        """Tool pose ``(4, 4)`` in the world."""
        joints = np.asarray(joints, dtype=np.float64)
        return self._base @ make_pose(Rotation.from_rotvec(joints[3:]).as_matrix(), joints[:3]) @ self._tool_offset

    def follow(self, poses: ArrayLike, start: ArrayLike) -> JointPath:
        """Commands along tool ``poses (N, 4, 4)``; rotation vectors continue past 180 degrees without a jump."""
        local = invert_pose(self._base) @ np.asarray(poses, dtype=np.float64) @ invert_pose(self._tool_offset)
        joints = np.concatenate([local[:, :3, 3], Rotation.from_matrix(local[:, :3, :3]).as_rotvec()], axis=1)
        before = np.asarray(start, dtype=np.float64)[3:]
        for turn in joints[:, 3:]:
            angle = np.linalg.norm(turn)
            if angle > 0:
                turn *= 1 + 2 * np.pi / angle * np.round((before @ turn / angle - angle) / (2 * np.pi))
            before = turn.copy()
        exact = np.zeros(len(joints))
        return JointPath(joints, exact, exact)


class Embodiment:
    """The arms of a robot, with the grippers of the demonstrations: ``triplets (..., A, 3, 3)`` in metres."""

    def __init__(self, arms: Sequence[ArmConfig], triplets: FloatArray):
        if len(arms) != triplets.shape[-3]:
            raise UsageError(f"the demonstrations are of {triplets.shape[-3]} arms, the configuration has {len(arms)}")
        self._arms = [_make_arm(arm, triplets[..., index, :, :]) for index, arm in enumerate(arms)]
        self.axes = [axis for arm in arms for axis in arm.axes()]
        scale, offset = [], []
        for arm, config in zip(self._arms, arms, strict=True):
            joint = np.rad2deg(1.0) if config.model and config.degrees else 1.0
            scale += [joint] * arm.kinematics.num_joints
            scale.append((config.gripper_open - config.gripper_closed) / arm.finger_travel)
            offset += [0.0] * arm.kinematics.num_joints + [config.gripper_closed]
        self._scale, self._offset = np.array(scale), np.array(offset)

    @classmethod
    def simulated(cls, end_effectors: Sequence[str], triangles: Sequence[GripperTriangle]) -> Embodiment:
        """Of a simulated task."""
        arms = simulated_arms(end_effectors)
        return cls(arms, np.stack([triangle.triplets(np.eye(4)) for triangle in triangles]))

    def to_robot(self, commands: ArrayLike) -> FloatArray:
        """States or actions ``(..., D)`` of joint angles and finger travel ``(..., D)``, rad and m."""
        return np.asarray(commands, dtype=np.float64) * self._scale + self._offset

    def from_robot(self, values: ArrayLike) -> FloatArray:
        """The inverse of `to_robot`."""
        return (np.asarray(values, dtype=np.float64) - self._offset) / self._scale

    def arms_at(self, state: ArrayLike) -> list[Arm]:
        """The arms, at home where ``state`` measured them: its first D numbers."""
        state = np.asarray(state, dtype=np.float64)[: len(self.axes)]
        if state.shape != (len(self.axes),) or not np.isfinite(state).all():
            raise UsageError(f"the robot's state must begin with {', '.join(self.axes)}, got {state}")
        values, arms = self.from_robot(state), []
        for arm in self._arms:
            home, values = values[: arm.kinematics.num_joints], values[arm.kinematics.num_joints + 1 :]
            arms.append(replace(arm, home=home))
        return arms


def simulated_arms(end_effectors: Sequence[str]) -> list[ArmConfig]:
    """The arms of a simulated task."""
    models = {"hand-e": "ur5e-hande", "left": "viperx-left", "right": "viperx-right"}
    several = len(end_effectors) > 1
    return [ArmConfig(models[name], name if several else "") for name in end_effectors]


def _make_arm(config: ArmConfig, triplets: FloatArray) -> Arm:
    triangle = GripperTriangle.from_triplets(triplets)
    if config.model in SIMULATED:
        return replace(_simulated_arm(config.model), triangle=triangle)
    base, offset = (np.eye(4) if pose is None else np.array(pose) for pose in (config.base, config.tool_offset))
    return Arm(
        name=config.name or "gripper",
        kinematics=_load_kinematics(config, base, offset) if config.model else PoseKinematics(base, offset),
        home=np.zeros(len(config.joints) if config.model else PoseKinematics.num_joints),
        triangle=triangle,
        finger_travel=triangle.opening / 2,
        finger_speed=config.finger_speed,
        joint_speed=config.joint_speed,
        tool_speed=config.tool_speed,
        turn_tolerance=config.turn_tolerance,
        joint_acceleration=config.joint_acceleration,
    )


def _simulated_arm(model: str) -> Arm:
    if model == "ur5e-hande":
        from robust_instant_policy.tasks.maniskill.arm import ur5e_hande

        return ur5e_hande()
    from robust_instant_policy.tasks.aloha.robot import viperx

    return viperx(model.removeprefix("viperx-"))


def _load_kinematics(config: ArmConfig, base: FloatArray, offset: FloatArray) -> Kinematics:
    """Kinematics of a URDF or MJCF file. Links have no shape where MuJoCo cannot read their mesh."""
    try:
        spec = mujoco.MjSpec.from_file(config.model)
        spec.compiler.fusestatic = False  # the tool may be a link without a joint
        spec.compiler.boundmass = spec.compiler.boundinertia = MIN_MASS
        folder = Path(config.model).parent / spec.compiler.meshdir
        for mesh in spec.meshes:
            if Path(mesh.file).suffix.lower() not in MESHES or not (folder / mesh.file).exists():
                for geom in [geom for geom in spec.geoms if geom.meshname == mesh.name]:
                    spec.delete(geom)
                spec.delete(mesh)
        links = {body.name: body for body in spec.bodies}
        if config.tool not in links:
            raise UsageError(f"{config.model} has no link {config.tool!r}; it has {', '.join(links)}")
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, offset[:3, :3].ravel())
        links[config.tool].add_site(name="rip-tool", pos=offset[:3, 3], quat=quaternion)
        model = spec.compile()
    except (ValueError, OSError) as error:
        raise UsageError(f"{config.model} is no usable robot model: {error}") from None
    names = [model.joint(index).name for index in range(model.njnt)]
    if not config.joints or names[: len(config.joints)] != list(config.joints):
        raise UsageError(f"joints must be the first joints of {config.model}: {', '.join(names)}; got {config.joints}")
    cost = ORIENTATION_COST if len(config.joints) >= DEGREES_OF_FREEDOM else ORIENTATION_COST_FEW_JOINTS
    return Kinematics(model, "rip-tool", "site", len(config.joints), base, orientation_cost=cost)
