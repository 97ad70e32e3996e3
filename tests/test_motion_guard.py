"""What a real arm's motion must pass: each limit is named with its value, before anything moves."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from robust_instant_policy.errors import StoppedError, UnreachableError
from robust_instant_policy.motion.arm import Motion
from robust_instant_policy.motion.capsules import ArmShape, segment_distance
from robust_instant_policy.motion.gate import Gate
from robust_instant_policy.motion.guard import check_motion, joint_motion, park_motion, plan_guarded
from robust_instant_policy.motion.state import ArmState, Command
from robust_instant_policy.trajectory import Trajectory
from tests.robots_cells import arms_of, reach, write_cell

HZ = 50.0


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    return arms_of(write_cell(tmp_path_factory.mktemp("cell"), "left"))


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    return arms_of(write_cell(tmp_path_factory.mktemp("two"), "left", "right"))


def guarded(cell, *points, **options):
    arms, limits = cell
    return plan_guarded(reach(arms[0].triangle, *points, **options), arms, limits, 1.0, HZ)


PICK = ((-0.15, 0.0, 0.15), (-0.15, 0.0, 0.05), (-0.15, 0.0, 0.005), (-0.15, 0.0, 0.15))


def test_a_sound_plan_passes_with_smooth_speeds_within_the_limits(cell):
    (arm,), limits = cell
    motion = guarded(cell, *PICK, closed=(2, 3))
    speeds = np.diff(motion.joints[:, 0], axis=0) * HZ
    assert np.abs(speeds).max() <= arm.joint_speed
    assert np.abs(np.diff(speeds, axis=0) * HZ).max() <= arm.joint_acceleration * 1.05
    check_motion(motion, [arm], limits, HZ)
    slow = plan_guarded(reach(arm.triangle, *PICK), [arm], limits, 1.0, HZ, speed=0.25)
    assert len(slow.joints) > 1.5 * len(guarded(cell, *PICK).joints)


@pytest.mark.parametrize(
    ("points", "options", "words"),
    [
        (((-0.25, -0.2, 0.1), (0.1, 0.2, 0.1)), {}, r"the tool moves to the next one by 0.53.* m, the limit is 0.35"),
        (((-0.1, 0, 0.1), (-0.1, 0, 0.12)), {"yaw": 1.3}, r"turns to the next one by 74.5 degrees, the limit is 60"),
        (((-0.1, 0, 0.1), (-0.1, 0.25, 0.1), (-0.1, 0.45, 0.1), (-0.1, 0.2, 0.1)), {}, r"outside the workspace by 0.1"),
        (((-0.1, 0, 0.1), (-0.1, 0, -0.03)), {}, "30 mm inside the table"),
        (((0.2, 0.3, 0.39), (0.3, 0.3, 0.39)), {}, "a pose it cannot reach"),
    ],
)  # fmt: skip
def test_a_plan_beyond_a_limit_is_refused_with_limit_and_value(cell, points, options, words):
    with pytest.raises(UnreachableError, match=words):
        guarded(cell, *points, **options)


def test_a_motion_that_is_not_a_number_or_too_fast_is_refused(cell):
    arms, limits = cell
    motion = guarded(cell, *PICK)
    broken = motion.joints.copy()
    broken[40, 0, 2] = np.nan
    with pytest.raises(UnreachableError, match="not numbers"):
        check_motion(replace(motion, joints=broken), arms, limits, HZ)
    fast = Motion(*(getattr(motion, name)[::25] for name in ("joints", "fingers", "poses", "closed")))
    with pytest.raises(UnreachableError, match=r"the limit is .* \((joint_speed|joint_acceleration|tool_speed) in"):
        check_motion(fast, arms, limits, HZ)


def test_an_elbow_that_would_touch_the_table_is_refused(cell):
    arms, limits = cell
    limits = replace(limits, workspace=np.array([[-1.0, -1.0, -0.1], [1.0, 1.0, 1.0]]))
    low = np.array([[-1.4, 1.2, -0.1, 0.0, -1.8, 0.0]])
    motion = joint_motion(np.stack([arms[0].home]), low, np.array([0.03]), arms, HZ, speed=0.3)
    with pytest.raises(UnreachableError, match="a link has a height above the table"):
        check_motion(motion, arms, limits, HZ)


def test_two_arms_whose_forearms_come_too_close_are_refused(two):
    arms, limits = two
    # The hands stay 0.2 m apart, the forearms cross beside each other.
    points = ((-0.1, -0.15, 0.15), (0.06, -0.05, 0.15)), ((0.1, 0.15, 0.15), (-0.06, 0.05, 0.15))
    single = [reach(arm.triangle, *path).actions for arm, path in zip(arms, points, strict=True)]
    together = Trajectory.from_actions(np.concatenate(single, axis=1))
    with pytest.raises(UnreachableError, match=r"its distance from right is .* \(arm_distance"):
        plan_guarded(together, arms, limits, 1.0, HZ)


def test_an_arm_parks_from_where_a_plan_ended(cell):
    arms, limits = cell
    motion = guarded(cell, *PICK, closed=(2, 3))
    back = park_motion(motion.joints[-1], motion.fingers[-1], arms, limits, HZ, speed=0.5)
    np.testing.assert_allclose(back.joints[-1, 0], arms[0].home, atol=1e-3)
    assert (back.fingers == motion.fingers[-1]).all()


def test_the_shapes_of_an_arm_enclose_its_tool_and_no_more_than_the_model_says(cell):
    (arm,), _ = cell
    shape = ArmShape(arm.kinematics)
    assert shape.radius.max() < 0.06
    links = shape.at(arm.home)
    tip = arm.kinematics.tool_pose(arm.home)[:3, 3]
    assert segment_distance(links.start[0, -1], links.stop[0, -1], tip, tip) < 0.02


def test_segments_are_as_far_apart_as_dense_points_on_them():
    rng = np.random.default_rng(0)
    a, b, c, d = rng.normal(size=(4, 200, 3))
    share = np.linspace(0, 1, 60)[:, None]
    for i in range(50):
        first, second = a[i] + share * (b[i] - a[i]), c[i] + share * (d[i] - c[i])
        dense = np.linalg.norm(first[:, None] - second[None], axis=-1).min()
        exact = float(segment_distance(a[i], b[i], c[i], d[i]))
        assert dense - 0.05 < exact <= dense + 1e-9


def state(arm, joints=None, clock=0.0, **more):
    joints = arm.home if joints is None else joints
    return ArmState(joints, np.zeros(6), more.pop("finger_travel", arm.finger_travel), 0.0, clock, **more)


@pytest.fixture
def gate(cell):
    (arm,), limits = cell
    gate = Gate([arm], limits, HZ)
    gate.start([state(arm, clock=-1.0)])
    return gate, arm


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (np.full(6, np.nan), "not a number"),
        (np.array([0.2, 0, 0, 0, 0, 0]), r"told to move at 10 rad/s, the limit is 2.51 rad/s \(joint_speed"),
        (np.array([0.04, 0, 0, 0, 0, 0]), r"accelerate by 100 rad/s², the limit is 25"),
        (np.array([0, 0, 0, 0, 0, 4.0]), "joint 6 goes to"),
    ],
)
def test_no_command_beyond_the_limits_passes_the_gate(gate, change, words):
    gate, arm = gate
    with pytest.raises(UnreachableError, match=words):
        gate.admit([Command(arm.home + change, arm.finger_travel)])


def test_a_leader_that_jumps_is_followed_at_the_arms_own_speed_and_stops_at_the_goal(gate):
    gate, arm = gate
    goal = arm.home + np.array([0.6, 0.1, -0.1, 0.3, -0.2, 0.5])
    joints = [arm.home]
    for _ in range(100):
        (command,) = gate.limited([Command(goal, 0.0)])
        joints.append(command.joints)
    speeds = np.diff(joints, axis=0) * HZ
    assert np.abs(speeds).max() <= arm.joint_speed * 1.001
    assert np.abs(np.diff(speeds, axis=0)).max() * HZ <= arm.joint_acceleration * 1.001
    np.testing.assert_allclose(joints[-1], goal, atol=1e-6)
    assert np.max(np.array(joints)[:, 0]) <= goal[0] + 1e-3


def test_a_leader_cannot_push_the_gripper_into_the_table(gate):
    gate, arm = gate
    down = arm.home + np.array([0.0, 0.9, 0.3, 0.0, 0.2, 0.0])
    for _ in range(150):
        (command,) = gate.limited([Command(down, 0.0)])
    points = arm.triangle.triplets(arm.kinematics.tool_pose(command.joints))
    assert points[:, 2].min() > -0.013


@pytest.mark.parametrize(
    ("measured", "words"),
    [
        ({"faults": ("servo 2 (shoulder): overload",)}, "reports: servo 2"),
        ({"joints": np.full(6, np.nan)}, "not numbers"),
        ({"joints": "far"}, r"joint 3 is away from its command by 0.5 rad, the limit is 0.35 rad \(following_error"),
    ],
)
def test_a_state_that_is_no_reason_to_go_on_stops_the_arm(gate, measured, words):
    gate, arm = gate
    if isinstance(measured.get("joints"), str):
        measured = {"joints": arm.home + np.array([0, 0, 0.5, 0, 0, 0])}
    with pytest.raises(StoppedError, match=words):
        gate.judge([state(arm, **measured)])


def test_a_frozen_state_stops_after_a_tenth_of_a_second(gate):
    gate, arm = gate
    same = state(arm, clock=1.0)
    gate.judge([same])
    time.sleep(0.11)
    with pytest.raises(StoppedError, match="frozen"):
        gate.judge([same])


def test_a_joint_that_is_held_a_little_away_from_a_command_at_rest_is_told(gate):
    gate, arm = gate
    held = arm.home + np.array([0, 0.15, 0, 0, 0, 0])
    for step in range(int(0.5 * HZ)):
        gate.judge([state(arm, held, clock=float(step))])
    with pytest.raises(StoppedError, match=r"joint 2 rests away from its command by 0.15 rad, the limit is 0.117"):
        gate.judge([state(arm, held, clock=-2.0)])


def test_a_gripper_that_does_not_open_is_told(gate):
    gate, arm = gate
    for step in range(int(1.5 * HZ)):
        gate.judge([state(arm, clock=float(step), finger_travel=0.0)])
    with pytest.raises(StoppedError, match="gripper is blocked"):
        gate.judge([state(arm, clock=-2.0, finger_travel=0.0)])


def test_the_urdf_of_the_viperx_moves_its_tool_as_the_simulated_arm_does(cell):
    from robust_instant_policy.tasks.aloha.robot import viperx

    (arm,), _ = cell
    low, high = arm.kinematics.joint_range.T
    simulated = viperx("left").kinematics
    for joints in np.random.default_rng(0).uniform(low, high, (20, len(low))):
        np.testing.assert_allclose(arm.kinematics.tool_pose(joints), simulated.tool_pose(joints), atol=1e-4)
