"""What a real arm's motion must pass: each limit is named with its value, before anything moves."""

from __future__ import annotations

import time
from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from robust_instant_policy.errors import StoppedError, UnreachableError
from robust_instant_policy.geometry import make_pose
from robust_instant_policy.motion.arm import Motion
from robust_instant_policy.motion.capsules import ArmShape, segment_distance
from robust_instant_policy.motion.gate import Gate
from robust_instant_policy.motion.guard import Space, check_motion, joint_motion, park_motion, plan_guarded
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
        (((0.2, 0.28, 0.39), (0.3, 0.28, 0.39)), {}, "a pose it cannot reach"),
        (((-0.1, 0.35, 0.1), (-0.15, 0.35, 0.1)), {}, r"step 0 of the plan: its tool is outside the workspace by 0.0"),
        (((-0.1, 0.2, 0.1), (-0.1, 0.32, 0.1)), {}, r"step 1 of the plan: its tool is outside the workspace by 0.0"),
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
    assert shape.radius[~shape.fixed].max() < 0.06
    assert shape.radius[shape.fixed].tolist() == [0.09]
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


def test_a_motion_that_ends_outside_the_workspace_is_refused_unless_it_goes_home(cell):
    (arm,), limits = cell
    motion = guarded(cell, *PICK)
    small = replace(limits, workspace=np.array([[-0.30, -0.32, -0.005], [0.35, 0.32, 0.14]]))
    with pytest.raises(UnreachableError, match=r"outside the workspace by 0\.00997"):
        check_motion(motion, [arm], small, HZ)
    check_motion(motion, [arm], small, HZ, to_home=True)


def test_an_arm_that_would_hit_the_base_of_another_is_refused(two):
    arms, limits = two
    beside = replace(arms[1], kinematics=copy(arms[1].kinematics))
    beside.kinematics.base = arms[0].kinematics.base @ make_pose(np.eye(3), [0.45, 0.0, 0.0])
    wide = replace(limits, workspace=np.array([[-2.0, -2.0, -0.1], [2.0, 2.0, 2.0]]))
    space = Space([arms[0], beside], wide)
    away = np.array([0.0, -0.43, 0.434, 0.0, 1.567, 0.0])  # from the first arm, whose hand comes to the base
    space.check(np.stack([[0.0, -0.6, 0.87, 0.0, 0.51, 0.0], away])[None], HZ)
    with pytest.raises(UnreachableError, match=r"its distance from right is 0\.00925"):
        space.check(np.stack([[0.0, -0.28, 0.87, 0.0, 0.51, 0.0], away])[None], HZ)


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


def test_no_command_that_moves_tool_or_fingers_too_fast_passes_the_gate(cell):
    (arm,), limits = cell
    slow = Gate([replace(arm, tool_speed=0.05, joint_acceleration=np.inf)], limits, HZ)
    slow.start([state(arm, clock=-1.0)])
    with pytest.raises(UnreachableError, match=r"its tool is told to move at .* the limit is 0.05 m/s \(tool_speed"):
        slow.admit([Command(arm.home + np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0]), arm.finger_travel)])
    with pytest.raises(UnreachableError, match=r"a finger is told to move at 1.73 m/s, the limit is 0.1 m/s"):
        slow.admit([Command(arm.home, 0.0)])


def led(arm, limits, goal, steps=150, hz=HZ):
    """Joints ``(steps + 1, J)`` of an arm that starts at home and whose leader is at ``goal``."""
    gate = Gate([arm], limits, hz)
    gate.start([state(arm, clock=-1.0)])
    return np.array([arm.home] + [gate.limited([Command(goal, 0.0)])[0].joints for _ in range(steps)])


def tips_of(arm, joints):
    return arm.triangle.triplets(np.array([arm.kinematics.tool_pose(row) for row in joints]))[:, 1:]


@pytest.mark.parametrize("hz", [50.0, 200.0])
def test_a_leader_that_goes_through_a_wall_of_the_workspace_is_braked_before_it(cell, hz):
    (arm,), limits = cell
    wall = tips_of(arm, arm.home[None])[..., 1].max() + 0.1
    near = replace(limits, workspace=np.array([[-2.0, -2.0, -0.1], [2.0, wall, 2.0]]))
    joints = led(arm, near, arm.home + np.array([1.5, 0, 0, 0, 0, 0]), steps=int(3 * hz), hz=hz)
    across = tips_of(arm, joints)[..., 1].max(axis=1)
    assert across.max() <= wall + 1e-5
    assert across[-1] > wall - 0.01
    speeds = np.diff(joints, axis=0, prepend=joints[:1]) * hz
    assert np.abs(np.diff(speeds, axis=0)).max() * hz <= arm.joint_acceleration * 1.001
    assert np.abs(speeds[-int(hz) :]).max() < 0.05  # at rest, it does not chatter


def test_a_leader_leads_an_arm_back_into_the_workspace_but_not_farther_out(cell):
    (arm,), limits = cell
    start = tips_of(arm, arm.home[None])[..., 1].min()
    limits = replace(limits, workspace=np.array([[-2.0, start + 0.03, -0.1], [2.0, 2.0, 2.0]]))
    turn = np.array([0.15, 0, 0, 0, 0, 0])
    out = led(arm, limits, arm.home - turn)
    assert tips_of(arm, out)[..., 1].min() > start - 1e-4
    back = led(arm, limits, arm.home + 4 * turn)
    np.testing.assert_allclose(back[-1], arm.home + 4 * turn, atol=1e-6)


def test_a_leader_moves_the_tool_no_faster_than_its_limit(cell):
    (arm,), limits = cell
    slow = replace(arm, tool_speed=0.3)
    joints = led(slow, limits, arm.home + np.array([0.6, 0.1, -0.1, 0.3, -0.2, 0.5]))
    tools = np.array([arm.kinematics.tool_pose(row)[:3, 3] for row in joints])
    speeds = np.linalg.norm(np.diff(tools, axis=0), axis=1) * HZ
    assert 0.28 < speeds.max() <= 0.3 * 1.02
    changes = np.diff(joints, axis=0, prepend=joints[:1])
    assert np.abs(np.diff(changes, axis=0)).max() * HZ**2 <= arm.joint_acceleration * 1.001


def test_a_gripper_that_holds_something_is_told_to_close_at_every_start(gate):
    gate, arm = gate
    held = {"finger_travel": 0.6 * arm.finger_travel}
    gate.start([replace(state(arm, clock=0.0, **held), grip_load=0.8)])
    assert gate.last[0].finger_travel == 0.0
    gate.start([state(arm, clock=1.0, **held)])  # it was told to close
    assert gate.last[0].finger_travel == 0.0


def test_slow_fingers_get_the_time_to_close(cell):
    (arm,), limits = cell
    slow = replace(arm, finger_speed=0.02)
    motion = plan_guarded(reach(arm.triangle, *PICK, closed=(2, 3)), [slow], limits, 1.0, HZ)
    closing = np.flatnonzero(motion.closed[:, 0])
    closed = np.flatnonzero(motion.fingers[:, 0] <= 0.0)[0]
    between = motion.joints[closing[0] : closed, 0]
    moved = tips_of(arm, between)
    assert np.ptp(moved[..., 2]) < 0.005


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


def test_states_may_trail_the_commands_by_their_latency_and_a_blocked_joint_is_told_as_much_later(gate):
    gate, arm = gate
    trailing = round(0.2 * HZ)  # 0.5 rad at the speed of the arm, the limit is 0.35 rad
    ahead = np.array([0.5, 0, 0, 0, 0, 0])
    sent = [arm.home]

    def go_on(measured):
        (command,) = gate.limited([Command(sent[-1] + ahead, arm.finger_travel)])
        sent.append(command.joints)
        gate.judge([state(arm, measured, clock=float(len(sent)), latency_s=0.2)])

    while len(sent) < 30:
        go_on(sent[max(len(sent) - trailing, 0)])
    held = sent[-trailing]
    for _ in range(1 + int(0.35 / (arm.joint_speed / HZ))):
        go_on(held)
    with pytest.raises(StoppedError, match="joint 1 is away from its command"):
        go_on(held)


def test_a_frozen_state_stops_within_a_tenth_of_a_second(gate):
    gate, arm = gate
    same = state(arm, clock=1.0)
    gate.judge([same])
    time.sleep(0.08)  # and a control step of 0.02 s
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


FOLDED = np.array([0.0, -1.80, 1.55, 0.0, 0.3, 0.0])  # forearm on the upper arm, as the arm rests when it is not used


def test_links_of_one_arm_that_would_meet_are_refused_by_name(cell):
    (arm,), limits = cell
    inward = np.array([0.0, -0.9, 1.55, 0.0, 1.9, 0.0])  # the hand turns back towards the shoulder
    wide = replace(limits, workspace=np.array([[-2.0, -2.0, -0.1], [2.0, 2.0, 2.0]]))
    motion = joint_motion(arm.home[None], inward[None], np.array([0.03]), [arm], HZ, speed=0.3)
    with pytest.raises(UnreachableError, match=r"between its links \w+ and gripper is .* \(link_distance in the cell"):
        check_motion(motion, [arm], wide, HZ)


def test_an_arm_that_was_switched_on_folded_unfolds_but_does_not_fold_further(cell):
    (arm,), limits = cell
    wide = replace(limits, workspace=np.array([[-2.0, -2.0, -0.1], [2.0, 2.0, 2.0]]))
    away = park_motion(FOLDED[None], np.array([0.03]), [arm], wide, HZ, speed=0.5)
    np.testing.assert_allclose(away.joints[-1, 0], arm.home, atol=1e-3)
    back = replace(away, joints=away.joints[::-1].copy())
    with pytest.raises(UnreachableError, match="the distance between its links"):
        Space([arm], wide).check(back.joints, HZ)
