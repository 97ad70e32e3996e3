"""The LeRobot policy: what it computes without LeRobot, and inside LeRobot where that is installed (`make lerobot`)."""

import json
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from robust_instant_policy import load_demonstrations
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import PlanningError, UnreachableError, UsageError
from robust_instant_policy.geometry import GripperTriangle, make_pose
from robust_instant_policy.motion.limits import Limits
from robust_instant_policy.policies import Neighbours
from robust_instant_policy.tasks import make_task

PLUGIN = Path(__file__).parents[1] / "plugins/lerobot_policy_rip/lerobot_policy_rip"
URDF = Path(__file__).parents[1] / "src/robust_instant_policy/motion/urdf/ur5e_hande.urdf"
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
DOWN = np.diag([1.0, -1.0, -1.0])
HOME = [51.6, -108.9, 126.1, -107.1, -90.0, -38.4, 100.0]
TRIANGLE = GripperTriangle(length=0.1, opening=0.08)
TRIPLETS = TRIANGLE.triplets(np.eye(4)[None])

try:
    import lerobot
except ModuleNotFoundError:  # its modules that do not need it can still be imported
    lerobot = None
    package = types.ModuleType("lerobot_policy_rip")
    package.__path__ = [str(PLUGIN)]
    sys.modules["lerobot_policy_rip"] = package

from lerobot_policy_rip.embodiment import ArmConfig, Embodiment, PoseKinematics, simulated_arms  # noqa: E402
from lerobot_policy_rip.planner import Calibration, Planner  # noqa: E402

in_lerobot = pytest.mark.skipif(lerobot is None, reason="lerobot has an environment of its own: make lerobot")


def triplets_of(demonstrations) -> np.ndarray:
    return np.concatenate([shown.trajectory.triplets for shown in demonstrations])


@pytest.fixture(scope="module")
def planner(workbench):
    demonstrations = load_demonstrations(workbench / "data/push-cube")
    policy = Neighbours().fit(demonstrations)
    embodiment = Embodiment(simulated_arms(["hand-e"]), triplets_of(demonstrations))

    def make(min_confidence: float, limits: Limits | None = None, robot: Embodiment = embodiment) -> Planner:
        camera = Calibration.of(demonstrations, None, None)
        return Planner(policy, robot, camera, min_confidence, rate_hz=55.0, waypoint_hz=5.5, limits=limits)

    return make


def test_states_and_actions_are_in_degrees_and_percent_of_the_gripper():
    robot = Embodiment([ArmConfig(str(URDF), joints=JOINTS, tool="tool")], TRIPLETS)
    assert robot.axes == [*(f"{joint}.pos" for joint in JOINTS), "gripper.pos"]
    opened, closed = robot.to_robot([[np.pi / 2, 0, 0, 0, 0, 0, 0.04], [0, 0, 0, 0, 0, -np.pi, 0]])
    assert opened.tolist() == pytest.approx([90, 0, 0, 0, 0, 0, 100])
    assert closed.tolist() == pytest.approx([0, 0, 0, 0, 0, -180, 0])
    assert robot.from_robot(closed).tolist() == pytest.approx([0, 0, 0, 0, 0, -np.pi, 0])


def test_two_arms_have_the_prefixes_of_lerobots_bimanual_robots():
    arms = [ArmConfig(name="left"), ArmConfig(name="right")]
    axes = Embodiment(arms, np.concatenate([TRIPLETS, TRIPLETS])).axes
    assert axes[6:8] == ["left_ee.gripper.pos", "right_ee.x.pos"]


def test_an_arm_of_a_urdf_starts_where_it_was_measured_and_reaches_poses():
    home = np.array([0.9, -1.9, 2.2, -1.87, -1.5708, -0.67])
    base = make_pose(np.eye(3), (-0.5, 0, 0)).tolist()
    config = ArmConfig(str(URDF), joints=JOINTS, tool="tool", base=base)
    (arm,) = Embodiment([config], TRIPLETS).arms_at([*np.rad2deg(home), 100.0, 7.0])  # one number more than is used
    assert arm.home == pytest.approx(home)
    goal = arm.home_pose.copy()
    goal[:3, 3] += (0.05, -0.05, 0.03)
    path = arm.kinematics.follow([goal], home)
    assert path.position_error[0] < 1e-3
    assert np.abs(arm.kinematics.tool_pose(path.joints[0]) - goal).max() < 1e-3


def test_the_tool_frame_may_lie_anywhere_in_the_gripper_link():
    offset = make_pose(DOWN, (0.01, 0.02, 0.03))
    plain, shifted = (
        Embodiment([ArmConfig(str(URDF), joints=JOINTS, tool="tool", tool_offset=pose)], TRIPLETS).arms_at([0.0] * 7)[0]
        for pose in (None, offset.tolist())
    )
    assert shifted.home_pose == pytest.approx(plain.home_pose @ offset, abs=1e-9)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"tool": "gripper"}, "has no link 'gripper'"),
        ({"joints": JOINTS[::-1]}, "joints must be the first joints"),
        ({"model": "nowhere.urdf"}, "no usable robot model"),
    ],
)
def test_a_robot_model_that_does_not_fit_is_told_in_one_line(changes, words):
    config = ArmConfig(**{"model": str(URDF), "joints": JOINTS, "tool": "tool", **changes})
    with pytest.raises(UsageError, match=words) as told:
        Embodiment([config], TRIPLETS)
    assert "\n" not in str(told.value)


def test_commanded_rotation_vectors_go_past_a_half_turn_without_a_jump():
    angles = np.deg2rad(np.arange(150, 211, 5))
    rotations = [DOWN @ np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]) for a in angles]
    about_x = [np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]]) for a in angles]
    kinematics = PoseKinematics(np.eye(4), np.eye(4))
    for turns in (rotations, about_x):
        poses = np.stack([make_pose(turn, (0.3, 0, 0.2)) for turn in turns])
        start = np.array([0.3, 0, 0.2, np.deg2rad(145), 0, 0])
        joints = kinematics.follow(poses, start).joints
        assert np.stack([kinematics.tool_pose(values) for values in joints]) == pytest.approx(poses, abs=1e-9)
        assert np.linalg.norm(np.diff(joints[:, 3:], axis=0), axis=1).max() < np.deg2rad(11)


def test_a_plan_begins_at_the_measured_state_and_does_the_task(planner):
    task = make_task("push-cube")
    try:
        seen = task.reset(1_000_000)
        robot = Embodiment.simulated(task.end_effectors, [arm.triangle for arm in task.arms])
        state = robot.to_robot(task.cell.measured())
        actions = planner(0.01).plan(seen.rgb, seen.depth, state)
        assert np.abs(actions[0] - state)[:6].max() < 1.0
        for action in actions.astype(np.float32):
            task.cell.advance(robot.from_robot(action))
        assert task.cell.failure() == ""
    finally:
        task.close()


def test_a_plan_below_the_confidence_threshold_is_refused_with_its_reason(planner, workbench):
    seen = Observation.load(workbench / "observation.npz")
    with pytest.raises(PlanningError, match=r"is refused: confidence .*, needed 1\.01"):
        planner(1.01).plan(seen.rgb, seen.depth, HOME)


def test_a_real_arm_moves_within_its_workspace_or_not_at_all(planner, workbench):
    seen = Observation.load(workbench / "observation.npz")
    base = make_pose(np.eye(3), (-0.5, 0, 0)).tolist()
    config = ArmConfig(str(URDF), joints=JOINTS, tool="tool", base=base, tool_speed=0.5)
    robot = Embodiment([config], triplets_of(load_demonstrations(workbench / "data/push-cube")))
    corners = np.array([[-0.34, -0.4, -0.005], [0.46, 0.4, 0.4]])
    actions = planner(0.01, Limits(corners), robot).plan(seen.rgb, seen.depth, HOME)
    assert np.abs(np.diff(actions[:, :6], axis=0)).max() * 55 < np.rad2deg(1.0) * 1.03  # the configured joint speed
    corners[1, 0] = -0.3
    with pytest.raises(UnreachableError, match="workspace"):
        planner(0.01, Limits(corners), robot).plan(seen.rgb, seen.depth, HOME)


def test_a_camera_that_moved_between_demonstrations_must_be_given(workbench):
    shown = load_demonstrations(workbench / "data/push-cube")
    moved = shown[0].observation.camera_pose.copy()
    moved[0, 3] += 0.01
    seen = shown[0].observation
    other = type(shown[0])(Observation(seen.rgb, seen.depth, seen.intrinsics, moved), shown[0].trajectory, 55.0)
    with pytest.raises(UsageError, match="camera_pose"):
        Calibration.of([*shown, other], None, None)
    assert Calibration.of([*shown, other], None, moved.tolist()).pose == pytest.approx(moved)


@in_lerobot
def test_a_policys_folder_is_what_lerobot_opens(workbench, tmp_path, monkeypatch):
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    from lerobot_policy_rip.__main__ import main

    folder, demonstrations = tmp_path / "policy", workbench / "data/push-cube"
    arguments = [f"--demonstrations={demonstrations}", "--arms=[{model: ur5e-hande}]", f"--out={folder}"]
    monkeypatch.setattr(sys, "argv", ["lerobot_policy_rip", *arguments, "--min_confidence=1.01"])
    assert main() == 0
    assert {path.name for path in folder.iterdir()} >= {
        "config.json", "model.safetensors", "policy_preprocessor.json", "policy_postprocessor.json",
    }  # fmt: skip
    assert json.loads((folder / "config.json").read_text())["type"] == "rip"

    import torch

    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    policy = get_policy_class("rip").from_pretrained(folder, config=config)
    before, after = make_pre_post_processors(config, pretrained_path=str(folder))
    seen = Observation.load(workbench / "observation.npz")
    state = torch.tensor(HOME)
    batch = {
        "observation.images.top": torch.from_numpy(seen.rgb.copy()).permute(2, 0, 1) / 255,
        "observation.images.top_depth": torch.from_numpy(np.rint(seen.depth[None] * 1000).astype(np.uint16)),
        "observation.state": state,
    }
    for _ in range(2):  # the plan is refused, so the robot is told to stay where it was measured
        assert after(policy.select_action(before(dict(batch))))[0].tolist() == pytest.approx(state.tolist())
    with pytest.raises(UsageError, match="not trained"):
        policy.forward(batch)


@in_lerobot
def test_folder_without_demonstrations_is_one_line(tmp_path, monkeypatch, capsys):
    from lerobot_policy_rip.__main__ import main

    monkeypatch.setattr(sys, "argv", ["x", "--demonstrations=/nowhere", "--arms=[]", f"--out={tmp_path / 'policy'}"])
    assert main() == 1 + 1
    assert "there is no folder '/nowhere'" in capsys.readouterr().err


@in_lerobot
def test_the_depth_camera_is_one_of_lerobots_and_its_depth_is_aligned():
    pytest.importorskip("pyrealsense2")
    from lerobot_robot_rip import RipRealSense, RipRealSenseConfig

    from tests.test_robots_cameras import INTRINSICS, SoftwareDevice, grey

    device = SoftwareDevice(grey)
    camera = RipRealSense(RipRealSenseConfig(), device.device)
    try:
        camera.connect()
        assert camera.use_depth  # LeRobot's arms then record NAME_depth, too
        first, depth = camera.read_latest(), camera.read_latest_depth()
        assert first.shape == (480, 640, 3)
        assert (depth.shape, depth.dtype) == ((480, 640, 1), np.uint16)
        assert np.median(depth) == pytest.approx(800, abs=1)
        assert camera.intrinsics == pytest.approx(INTRINSICS)
        assert (camera.async_read() != first).any()
    finally:
        camera.disconnect()
        device.stop()


@in_lerobot
def test_the_leader_demonstrates_brings_the_arms_home_and_lays_out_the_next_scene(capsys):
    from lerobot_robot_rip import RipTwin, RipTwinConfig, RipTwinLeader, RipTwinLeaderConfig

    robot, leader = RipTwin(RipTwinConfig(id="test")), RipTwinLeader(RipTwinLeaderConfig(id="test", pause_s=0.4))
    leader.connect()
    robot.connect()
    try:
        said, steps = "", 0
        while "next scene" not in said:
            action = leader.get_action()
            assert action.keys() == robot.action_features.keys()
            robot.send_action(action)
            said, steps = said + capsys.readouterr().out, steps + 1
        assert "scene 0: done" in said
        assert robot.seed == 1
        assert 30 < steps < 100
        seen = robot.get_observation()
        assert seen.keys() == robot.observation_features.keys()
        assert 500 < np.median(seen["top_depth"]) < 1000
    finally:
        robot.disconnect()
