"""The UR5e with a Robotiq Hand-E as a ManiSkill agent.

``ur5e_hande.urdf`` cites the sources of all published values. The drives are stiff, like the position
controller of the real arm: they lag the command by about `DRIVE_LAG_S` and saturate at the joints' torque limits.
"""

from pathlib import Path
from typing import ClassVar

import numpy as np
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.controllers import PDJointPosControllerConfig, PDJointPosMimicControllerConfig
from mani_skill.agents.registration import register_agent
from mani_skill.utils import sapien_utils
from mani_skill.utils.building.articulation_builder import ArticulationBuilder
from mani_skill.utils.structs.actor import Actor
from mani_skill.utils.structs.link import Link

from robust_instant_policy import motion
from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.geometry import FloatArray, GripperTriangle

URDF_PATH = Path(motion.__file__).with_name("urdf") / "ur5e_hande.urdf"

ARM_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
FINGER_JOINTS = ("left_finger", "right_finger")
TOOL_LINK = "tool"

TOOL_LENGTH_M = 0.157  # flange to tool point, with coupling (Hand-E manual)
STROKE_M = 0.050  # distance between the open fingertips (Hand-E manual)
FINGER_TRAVEL_M = STROKE_M / 2
FINGER_SPEED_M_S = 0.075  # half of the closing speed of 150 mm/s (Hand-E manual)
GRIP_FORCE_N = 130.0  # (Hand-E manual)

ARM_TORQUE_NM = (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)  # "Max. joint torques", Universal Robots
DRIVE_LAG_S = 0.03
ARM_STIFFNESS = (6e3, 6e3, 4e3, 6e2, 6e2, 4e2)  # N m / rad: 5 mm into the table press with 70 to 210 N
FINGER_STIFFNESS = 3e3  # N / m: low enough not to saturate, so the two fingers stay centred as with a gear
FINGER_DAMPING = 1.5e2  # N s / m
FINGER_FRICTION = 1.2  # rubber pads on plastic or wood

GRIPPER_TRIANGLE = GripperTriangle(length=TOOL_LENGTH_M, opening=STROKE_M)


@register_agent()
class UR5eHandE(BaseAgent):
    """``ur5e_hande``: actions are six joint angles (rad) and the travel of each finger (m, 0 closed)."""

    uid = "ur5e_hande"
    urdf_path = str(URDF_PATH)
    urdf_config: ClassVar[dict] = dict(
        _materials=dict(
            pads=dict(static_friction=FINGER_FRICTION, dynamic_friction=FINGER_FRICTION, restitution=0.0),
        ),
        link=dict(
            left_finger_link=dict(material="pads", patch_radius=0.01, min_patch_radius=0.01),
            right_finger_link=dict(material="pads", patch_radius=0.01, min_patch_radius=0.01),
        ),
    )
    disable_self_collisions = True
    _description: ClassVar[ArticulationBuilder | None] = None

    @property
    def _controller_configs(self):
        arm = PDJointPosControllerConfig(
            list(ARM_JOINTS),
            lower=None,
            upper=None,
            stiffness=list(ARM_STIFFNESS),
            damping=[DRIVE_LAG_S * stiffness for stiffness in ARM_STIFFNESS],
            force_limit=list(ARM_TORQUE_NM),
            normalize_action=False,
        )
        hand = PDJointPosMimicControllerConfig(
            list(FINGER_JOINTS),
            lower=0.0,
            upper=FINGER_TRAVEL_M,
            stiffness=FINGER_STIFFNESS,
            damping=FINGER_DAMPING,
            force_limit=GRIP_FORCE_N,
            normalize_action=False,
            mimic={"right_finger": {"joint": "left_finger"}},
        )
        return dict(pd_joint_pos=dict(arm=arm, hand=hand))

    def _load_articulation(self, initial_pose: sapien.Pose | None = None) -> None:
        # As in the base class, but the description is read once per process, not per scene.
        builder = UR5eHandE._description = UR5eHandE._description or self._described()
        builder.set_scene(self.scene)
        builder.set_scene_idxs(None)
        builder.initial_pose = initial_pose
        self.robot = builder.build()
        self.robot_link_names = [link.name for link in self.robot.get_links()]

    def _described(self) -> ArticulationBuilder:
        """The URDF file as a builder for any scene."""
        loader = self.scene.create_urdf_loader()
        loader.name, loader.disable_self_collisions = self.uid, self.disable_self_collisions
        sapien_utils.apply_urdf_config(loader, sapien_utils.parse_urdf_config(self.urdf_config))
        (builder,) = loader.parse(self.urdf_path)["articulation_builders"]
        return builder

    def _after_init(self) -> None:
        links = self.robot.get_links()
        self.left_finger: Link = sapien_utils.get_obj_by_name(links, "left_finger_link")
        self.right_finger: Link = sapien_utils.get_obj_by_name(links, "right_finger_link")
        self.tcp: Link = sapien_utils.get_obj_by_name(links, TOOL_LINK)
        joints = self.robot.active_joints_map
        self._drives = [joints[name]._objs[0] for name in (*ARM_JOINTS, *FINGER_JOINTS)]

    def drive(self, command: FloatArray) -> None:
        """Command joint angles and finger travel ``(7,)``, as the control mode ``pd_joint_pos`` does in one scene.

        The controller's own method takes longer than the physics.
        """
        if not np.isfinite(command).all():
            raise InvalidValueError(f"joints cannot be commanded to {command}")
        for drive, target in zip(self._drives, (*command, command[-1]), strict=True):
            drive.set_drive_target(target)

    def is_grasping(self, object: Actor | Link, min_force: float = 0.5, max_angle: float = 85.0) -> torch.Tensor:
        """Whether both fingers press on ``object`` with ``min_force`` N or more, about along the closing direction."""
        pressed = []
        for finger, outward in ((self.left_finger, 1.0), (self.right_finger, -1.0)):
            force = self.scene.get_pairwise_contact_forces(finger, object)
            direction = outward * finger.pose.to_transformation_matrix()[..., :3, 1]
            strength = torch.linalg.norm(force, dim=1)
            along = (force * direction).sum(dim=1)
            pressed.append((strength >= min_force) & (along >= np.cos(np.deg2rad(max_angle)) * strength))
        return pressed[0] & pressed[1]
