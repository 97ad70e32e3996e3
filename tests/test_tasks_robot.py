"""The arm against the manufacturers' figures, and its kinematics against themselves."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robust_instant_policy.geometry import make_pose
from robust_instant_policy.tasks.maniskill.arm import ur5e_kinematics
from robust_instant_policy.tasks.maniskill.cell import BASE_POSITION_M, HOME_JOINTS
from robust_instant_policy.tasks.maniskill.robot import ARM_JOINTS, FINGER_JOINTS, URDF_PATH

# Universal Robots, "DH parameters for calculations of kinematics and dynamics", UR5e: d, a (m), alpha (rad).
DH = (
    (0.1625, 0.0, np.pi / 2),
    (0.0, -0.425, 0.0),
    (0.0, -0.3922, 0.0),
    (0.1333, 0.0, np.pi / 2),
    (0.0997, 0.0, -np.pi / 2),
    (0.0996, 0.0, 0.0),
)
TOOL_M = 0.157
kinematics = ur5e_kinematics((0.0, 0.0, 0.0))
angles = st.lists(st.floats(-np.pi, np.pi), min_size=6, max_size=6)


def forward_by_dh(joints):
    pose = np.diag([-1.0, -1.0, 1.0, 1.0])  # the base link is turned by half a turn against UR's base frame
    for theta, (d, a, alpha) in zip(joints, DH, strict=True):
        turn, tilt = (np.cos(theta), np.sin(theta)), (np.cos(alpha), np.sin(alpha))
        rotation = [
            [turn[0], -turn[1] * tilt[0], turn[1] * tilt[1]],
            [turn[1], turn[0] * tilt[0], -turn[0] * tilt[1]],
            [0.0, tilt[1], tilt[0]],
        ]
        pose = pose @ make_pose(rotation, (a * turn[0], a * turn[1], d))
    return pose @ make_pose(np.eye(3), (0.0, 0.0, TOOL_M))


@given(angles)
@settings(max_examples=60)
def test_forward_kinematics_are_those_of_the_published_parameters(joints):
    np.testing.assert_allclose(kinematics.tool_pose(joints), forward_by_dh(joints), atol=1e-9)


@given(st.lists(st.floats(-0.35, 0.35), min_size=6, max_size=6))
@settings(max_examples=30)
def test_the_arm_follows_poses_that_joints_can_reach(change):
    start = np.array([0.0, -1.6, 2.0, -1.97, -1.57, 0.0])
    path = np.linspace(start, start + change, 20)
    poses = np.array([kinematics.tool_pose(joints) for joints in path])
    found = kinematics.follow(poses, start)
    reached = np.array([kinematics.tool_pose(joints) for joints in found.joints])
    np.testing.assert_allclose(reached[:, :3, 3], poses[:, :3, 3], atol=2e-4)
    assert found.position_error.max() < 2e-4


def test_limits_and_stroke_are_the_published_ones():
    joints = {joint.get("name"): joint.find("limit") for joint in ElementTree.parse(URDF_PATH).iter("joint")}
    for name, torque in zip(ARM_JOINTS, (150, 150, 150, 28, 28, 28), strict=True):
        limit = joints[name]
        assert float(limit.get("upper")) == pytest.approx(2 * np.pi)
        assert float(limit.get("velocity")) == pytest.approx(np.pi)
        assert float(limit.get("effort")) == torque
    assert sum(float(joints[name].get("upper")) for name in FINGER_JOINTS) == pytest.approx(0.050)


def test_simulator_and_kinematics_agree_on_the_tool():
    import gymnasium

    import robust_instant_policy.tasks.maniskill.envs  # noqa: F401

    env = gymnasium.make("RIP-PushCube-v1", obs_mode="none")
    try:
        env.reset(seed=0)
        at_home = ur5e_kinematics(BASE_POSITION_M).tool_pose(HOME_JOINTS)
        np.testing.assert_allclose(env.unwrapped.tool_poses()[0], at_home, atol=1e-5)
    finally:
        env.close()
