"""Calibration as a person does it: led through touches and photographs, and the commands."""

import itertools
import os
import tomllib
from contextlib import nullcontext
from dataclasses import asdict

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

pytest.importorskip("dynamixel_sdk")

from robust_instant_policy.cli import main
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import GripperTriangle, invert_pose, make_pose, transform_points
from robust_instant_policy.robots.calibration import Board, in_hand, on_table, touched_place
from robust_instant_policy.robots.calibration.guided import Guide, photograph_places
from robust_instant_policy.robots.camera import Frame
from robust_instant_policy.robots.cell import CellConfig, read_gripper
from robust_instant_policy.robots.leaders import make_leader
from robust_instant_policy.robots.models import arm_of
from robust_instant_policy.robots.operator import ENTER
from robust_instant_policy.robots.station import Station
from tests.charuco import INTRINSICS, error_of, photograph
from tests.robot_cell import CELL, PARK, TRAVEL, Cell, Scripted

BOARD = Board()
CAMERA = make_pose(Rotation.from_euler("xyz", [180, 2, -90], degrees=True).as_matrix(), [-0.05, 0.0, 0.85])
PLACES = [
    make_pose(Rotation.from_euler("z", yaw, degrees=True).as_matrix(), [x, y, 0.0])
    for x, y, yaw in [(-0.15, -0.1, 0), (-0.25, -0.3, 10), (-0.2, 0.1, -20), (0.1, 0.15, 60), (0.15, -0.1, 80)]
]


class TopCamera:
    """Sees the board at one place after another."""

    name = "top"

    def __init__(self):
        self.rng, self.places = np.random.default_rng(0), iter(PLACES)

    def read(self):
        rgb, depth = photograph(BOARD, invert_pose(CAMERA) @ next(self.places), self.rng)
        return Frame(rgb, depth, INTRINSICS, 0.0)


class Toucher(Scripted):
    """Leads the arm to each corner that it is told to touch, and presses Enter when the arm has come there."""

    def __init__(self, cell, arm):
        super().__init__([("Enter", ENTER)], self.arrived)
        self.cell, self.arm, self.corner = cell, arm, None

    def say(self, line):
        super().say(line)
        if line.startswith("touch corner"):
            self.corner = transform_points(PLACES[0], BOARD.outer_corners)["ABCD".index(line.split("corner ")[1][0])]
        elif "coupled" in line:
            self.cell.hand.script = [(joints, 0.0) for joints in self.way(self.corner)]
            self.corner = None

    def way(self, corner):
        """Joints along a way up, across, and down to a corner, tool downward."""
        start = self.arm.kinematics.tool_pose(self.cell.hand.joints)
        down = Rotation.from_euler("x", np.pi)
        knots = [start, *(make_pose(down.as_matrix(), corner + np.array([0, 0, height])) for height in (0.08, 0.0))]
        if start[2, 3] < 0.05:
            knots.insert(1, make_pose(start[:3, :3], start[:3, 3] + np.array([0, 0, 0.08])))
        poses = []
        for one, other in itertools.pairwise(knots):
            turns = Slerp([0, 1], Rotation.from_matrix([one[:3, :3], other[:3, :3]]))
            for share in np.linspace(0.02, 1, 50):
                poses.append(make_pose(turns(share).as_matrix(), (1 - share) * one[:3, 3] + share * other[:3, 3]))
        return self.arm.kinematics.follow(poses, self.cell.hand.joints).joints

    def arrived(self):
        if self.corner is not None or self.cell.hand.script:
            return ""
        gap = np.abs(self.cell.twin.state(0).joints - self.cell.hand.joints).max()
        return ENTER if gap < 2e-3 else ""


def test_a_person_who_touches_the_board_and_moves_it_over_the_table_calibrates_the_camera(tmp_path):
    cell = Cell(tmp_path)
    try:
        with Station(cell.config) as station:
            operator = Toucher(cell, station.arms[0])
            leader = make_leader(cell.config.arms[0], station.arms[0], 50.0, tmp_path, operator.pressed)
            leader.connect()
            words = [f"touch corner {corner}" for corner in "ABCD"]
            touched = Guide(station, leader, 0, operator).poses(words)[:, :3, 3]
        np.testing.assert_allclose(touched, transform_points(PLACES[0], BOARD.outer_corners), atol=0.003)
        camera = TopCamera()
        frames = photograph_places(camera, BOARD, len(PLACES), operator)
        _, angle = error_of(on_table("top", frames, BOARD, touched_place(touched, BOARD)).pose, CAMERA)
        assert angle < 0.3
    finally:
        cell.unplug()


TIP = make_pose(np.eye(3), [0.001, -0.003, 0.004])  # the gripper's true tool frame in that of the arm's model
SCREW = np.array([-0.15, 0.05, 0.12])  # the fixed point to touch
TILTS = ([0, 0, 0], [0, 25, 0], [0, -25, 0], [25, 0, 0], [-25, 0, 0], [0, 15, 60])


class Pivoting(Scripted):
    """Touches a point with one finger after the other, from the directions that are asked for."""

    def __init__(self, cell, arm):
        super().__init__([("Enter", ENTER)], self.arrived)
        self.cell, self.arm, self.touches, self.coupled = cell, arm, 0, False

    def __enter__(self):
        return self

    def __exit__(self, *error):
        """Nothing to restore."""

    def say(self, line):
        super().say(line)
        hand = self.cell.hand
        if "touch a fixed point" in line:
            finger, way = divmod(self.touches, len(TILTS))
            self.touches += 1
            turn = Rotation.from_euler("x", np.pi) * Rotation.from_euler("xyz", TILTS[way], degrees=True)
            tip = transform_points(TIP, [0, (TRAVEL, -TRAVEL)[finger], 0])
            pose = make_pose(turn.as_matrix(), SCREW - turn.apply(tip))
            hand.joints, hand.travel = (
                self.arm.kinematics.follow(np.repeat(pose[None], 9, axis=0), hand.joints).joints[-1],
                TRAVEL,
            )
        elif "the gripper, free" in line:
            hand.travel = 0.0 if line.startswith("close") else TRAVEL
        self.coupled = line.startswith("coupled") or (self.coupled and "touch" not in line)

    def arrived(self):
        state = self.cell.twin.state(0)
        gap = max(np.abs(state.joints - self.cell.hand.joints).max(), abs(state.finger_travel - self.cell.hand.travel))
        return ENTER if self.coupled and gap < 1e-3 else ""


MOUNTING = make_pose(Rotation.from_euler("x", np.pi).as_matrix(), [-0.12, 0.09, 0.06])  # board -> hand, facing up
HELD = ([0, 0, 0], [0, 20, 0], [0, -20, 10], [20, 0, 0], [-20, 0, -10], [15, 15, 30], [-15, -15, -30], [0, 0, 60])


class Holding(Pivoting):
    """Turns the hand to another pose at each question, one of them with the board out of the camera's view."""

    def say(self, line):
        Scripted.say(self, line)
        if line.startswith("pose"):
            way, self.touches = self.touches, self.touches + 1
            turn = Rotation.from_euler("x", np.pi) * Rotation.from_euler("xyz", HELD[max(way - 1, 0)], degrees=True)
            pose = make_pose(turn.as_matrix(), [-0.15, 0.36 if way == 0 else 0.05 * np.sin(way), 0.25])
            self.cell.hand.joints = self.arm.kinematics.follow(
                np.repeat(pose[None], 9, axis=0), self.cell.hand.joints
            ).joints[-1]
        self.coupled = line.startswith("coupled") or (self.coupled and not line.startswith("pose"))


def test_a_board_in_the_hand_calibrates_the_camera(tmp_path):
    cell = Cell(tmp_path)
    rng = np.random.default_rng(0)

    class Top:
        def read(self):
            hand = operator.arm.kinematics.tool_pose(cell.twin.state(0).joints)
            rgb, depth = photograph(BOARD, invert_pose(CAMERA) @ hand @ MOUNTING, rng)
            return Frame(rgb, depth, INTRINSICS, 0.0)

    try:
        with Station(cell.config) as station:
            operator = Holding(cell, station.arms[0])
            leader = make_leader(cell.config.arms[0], station.arms[0], 50.0, tmp_path, operator.pressed)
            leader.connect()
            frames, hands = Guide(station, leader, 0, operator).held_board(Top(), BOARD, len(HELD))
        assert any("not usable" in line for line in operator.said)
        distance, angle = error_of(in_hand("top", frames, hands, BOARD).pose, CAMERA)
        assert distance < 3.0
        assert angle < 0.4
    finally:
        cell.unplug()


def answer(monkeypatch, text):
    """Give ``text`` as the lines that are typed."""
    read, write = os.pipe()
    os.write(write, text.encode())
    os.close(write)
    monkeypatch.setattr("sys.stdin", os.fdopen(read))


def test_the_command_calibrates_from_a_board_at_a_stated_place(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "images"
    folder.mkdir()
    camera = TopCamera()
    for index in range(len(PLACES)):
        frame = camera.read()
        Observation(frame.rgb, frame.depth, frame.intrinsics, np.eye(4)).save(folder / f"{index}.npz")
    robot = tmp_path / "cell.toml"
    text = CELL.format(park=PARK.tolist(), follower="/dev/null", leader="/dev/zero", pace=1)
    robot.write_text(text[: text.index("[emulation]")])
    answer(monkeypatch, "\n" * len(PLACES))
    command = ["calibrate", "camera", "--robot", str(robot), "--places", str(len(PLACES))]
    assert main([*command, "--place", "-0.15", "-0.1", "0", "0"]) == 0
    _, angle = error_of(CellConfig.load(robot).camera_pose, CAMERA)
    assert angle < 0.1
    assert tomllib.loads((tmp_path / "camera.toml").read_text())["board"] == asdict(BOARD)
    assert "left out one by one: median 0." in capsys.readouterr().out
    answer(monkeypatch, "\n")
    assert main([*command, "--place", "-0.15", "-0.1", "0", "0"]) == 1
    assert "the terminal was closed" in capsys.readouterr().err


def test_a_measured_tool_moves_the_arms_model(tmp_path):
    cell = Cell(tmp_path)
    try:
        config = cell.config.arms[0]
        correction = make_pose(np.eye(3), [0.0, 0.004, 0.01])
        (tmp_path / "gripper.toml").write_text(f"length = 0.1637\nopening = 0.07\ntool = {correction.tolist()}\n")
        cell.file.write_text(cell.file.read_text().replace("driver =", 'gripper = "gripper.toml"\ndriver ='))
        measured = arm_of(CellConfig.load(cell.file).arms[0], tmp_path)
        assert measured.triangle == GripperTriangle(0.1637, 0.07)
        expected = arm_of(config, tmp_path).kinematics.tool_pose(PARK) @ correction
        np.testing.assert_allclose(measured.kinematics.tool_pose(PARK), expected, atol=1e-9)
    finally:
        cell.unplug()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["board", "--out", "board.gif"], "must end in .pdf or .png"),
        (["board", "--square", "35", "--out", "b.png"], "both are edge lengths in metres"),
        (["camera", "--robot", "nowhere.toml"], "no file at nowhere.toml"),
    ],
)
def test_wrong_usage_is_one_line(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["calibrate", *arguments]) != 0
    assert words in capsys.readouterr().err


def test_the_command_measures_a_gripper_by_touching_a_point_with_both_fingers(tmp_path, monkeypatch, capsys):
    cell = Cell(tmp_path)
    operators = []

    def person(stop, say):
        operators.append(Pivoting(cell, arm_of(cell.config.arms[0], tmp_path)))
        operators[0].stop = stop
        return operators[0]

    monkeypatch.setattr("robust_instant_policy.commands.calibrate.Terminal", person)
    monkeypatch.setattr("robust_instant_policy.commands.calibrate.CellConfig.load", lambda path: cell.config)
    monkeypatch.setattr(
        "robust_instant_policy.commands.calibrate.devices_of", lambda config: nullcontext((config, None))
    )
    try:
        out = tmp_path / "gripper.toml"
        assert main(["calibrate", "tool", "--robot", str(cell.file), "--out", str(out)]) == 0, capsys.readouterr().err
        gripper, tool = read_gripper(out)
        assert gripper.opening == pytest.approx(2 * TRAVEL, abs=0.002)  # the encoders' steps are 0.8 mm here
        np.testing.assert_allclose(tool[:3, 3], TIP[:3, 3], atol=0.002)
    finally:
        cell.unplug()
