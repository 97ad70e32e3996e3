"""Leaders: servo arms on an emulated bus, LeRobot's shape, keyboard, gamepad, SpaceMouse; their guided calibration."""

import json
import os
import shutil
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("dynamixel_sdk")

from robust_instant_policy.errors import CalibrationError, CellError, RobotError
from robust_instant_policy.motion.state import ArmState
from robust_instant_policy.robots.calibration.guided import copied_turns
from robust_instant_policy.robots.cell import DeviceConfig
from robust_instant_policy.robots.emulation.servos import ServoBus
from robust_instant_policy.robots.emulation.twin import SharedTwin
from robust_instant_policy.robots.leaders import JointMap, joint_source, make_leader
from robust_instant_policy.robots.leaders.gamepad import AXIS, BUTTON, EVENT
from robust_instant_policy.robots.leaders.joint_map import calibrate_joints
from robust_instant_policy.robots.operator import ENTER
from robust_instant_policy.robots.station import Station
from tests.robot_cell import PARK, TRAVEL, Cell, Hand, Scripted

UNIT_RAD = 2 * np.pi / 4096  # of a servo's encoder


@pytest.fixture
def cell(tmp_path):
    cell = Cell(tmp_path)
    yield cell
    cell.unplug()


def follower(joints=PARK):
    return ArmState(np.array(joints), np.zeros(6), TRAVEL, 0.0, 0.0)


def leader_of(cell, **table):
    """The leader of the cell's arm, with another table than that of its file."""
    device = cell.config.arms[0].leader if not table else DeviceConfig(table.pop("kind"), table, "cell.toml: leader")
    keys = table.pop("pressed", lambda keys: "")
    arm = replace(cell.config.arms[0], leader=device)
    return make_leader(arm, Station(cell.config).arms[0], 50.0, cell.file.parent, keys)


def test_a_leader_arm_is_read_to_its_encoders_resolution(cell):
    leader = leader_of(cell)
    leader.connect()
    leader.start()
    cell.hand.joints, cell.hand.travel = PARK + 0.1, 0.0
    command = leader.read(follower())
    np.testing.assert_allclose(command.joints, PARK + 0.1, atol=UNIT_RAD)
    assert command.finger_travel < 0.1 * TRAVEL
    cell.hand.travel = TRAVEL
    assert leader.read(follower()).finger_travel == TRAVEL


def test_a_leader_that_was_switched_on_after_a_turn_does_not_jump(cell):
    leader = leader_of(cell)
    cell.hand.joints = PARK + np.array([2 * np.pi, 0, 0, -4 * np.pi, 0, 0])
    leader.connect()
    leader.start()
    np.testing.assert_allclose(leader.read(follower()).joints, PARK, atol=UNIT_RAD)


def test_a_servo_that_restarts_while_it_leads_stops_it(cell):
    leader = leader_of(cell)
    leader.connect()
    leader.start()
    leader.read(follower())
    cell.hand.joints = PARK + np.array([0, 0, 1.5, 0, 0, 0])
    with pytest.raises(RobotError, match="joint 3 jumped by 86 degrees between two readings"):
        leader.read(follower())


def test_an_unplugged_or_missing_leader_is_told(cell):
    leader = leader_of(cell)
    leader.connect()
    leader.start()
    cell.leader.fault.set("silent")
    with pytest.raises(RobotError, match=r"servo 1 \(leader of left, channel 0\) does not answer"):
        leader.read(follower())
    leader.disconnect()
    with pytest.raises(RobotError, match="no answer from servo 1, 2, 4"):
        leader_of(cell).connect()


class Gello(Hand):
    """A leader assembled otherwise than its follower: other order, signs and offsets."""

    order = np.array([2, 0, 1, 5, 3, 4])  # joint of the follower for each servo
    signs = np.array([1, -1, 1, 1, -1, -1.0])
    offsets = np.array([1.57, 0, -1.57, 0.3, 3.1, -2.0])

    def states(self):
        (state,) = super().states()
        return [replace(state, joints=self.signs * state.joints[self.order] + self.offsets)]


def test_a_guided_calibration_finds_order_signs_and_offsets(cell, tmp_path):
    cell.hand = Gello(PARK)
    bus = ServoBus(SharedTwin(cell.hand), 0, TRAVEL)
    table = {**bus.options, "servos": [1, 2, 4, 6, 7, 8, 9], "baud": 1_000_000, "calibration": "l.toml"}
    arm = replace(cell.config.arms[0], leader=DeviceConfig("gello", table, "cell.toml: leader"))
    rng = np.random.default_rng(0)

    def copy():
        cell.hand.joints = cell.twin.state(0).joints + rng.normal(0, 0.02, 6)
        return ENTER

    def trigger(travel):
        def press():
            cell.hand.travel = travel
            return ENTER

        return press

    rules = [("open the trigger", trigger(TRAVEL)), ("close the trigger", trigger(0.0)), ("Enter", copy)]
    source = joint_source(arm)
    with Station(cell.config) as station:
        source.connect()
        copied_turns(station, source, 0, Scripted(rules)).save(tmp_path / "l.toml")
        source.disconnect()
    leader = make_leader(arm, Station(cell.config).arms[0], 50.0, tmp_path, lambda keys: "")
    leader.connect()
    leader.start()
    cell.hand.joints = PARK + np.array([0.2, -0.1, 0.1, 0.3, -0.2, 0.1])
    np.testing.assert_allclose(leader.read(follower()).joints, cell.hand.joints, atol=0.08)
    assert JointMap.load(tmp_path / "l.toml").gripper_channel == 6
    bus.unplug()


def test_a_turn_that_was_not_copied_is_told():
    rest = np.zeros(3)
    shown = np.stack([rest, *(0.35 * np.eye(3))])
    opened, closed = np.array([0.0, 0, 0, 0.8]), np.zeros(4)
    readings = np.column_stack([shown, np.zeros(4)])
    assert calibrate_joints(shown, readings, opened, closed).channels.tolist() == [0, 1, 2]
    for change, words in (
        (np.array([0, 0.0, 0, 0]), "joint 2: the follower turned by 20 degrees, the leader by 0"),
        (np.array([0.3, 0.35, 0, 0]), "more than one joint"),
        (np.array([0.35, 0.0, 0, 0]), "with the same joint"),
    ):
        wrong = readings.copy()
        wrong[2] = change
        with pytest.raises(CalibrationError, match=words):
            calibrate_joints(shown, wrong, opened, closed)
    with pytest.raises(CalibrationError, match="the trigger reads the same"):
        calibrate_joints(shown, readings, closed, closed)


class Teleoperator:
    """A teleoperator of LeRobot's shape, in degrees."""

    names = ("pan", "lift", "elbow", "roll", "flex", "wrist", "gripper")

    def connect(self):
        """Nothing to open."""

    def get_action(self):
        return {f"{name}.pos": value for name, value in zip(self.names, [*np.degrees(PARK), 50.0], strict=True)}

    def disconnect(self):
        """Nothing to close."""


def test_keys_move_the_tool_along_the_worlds_axes_and_never_run_away(cell):
    typed = ["", "uu ", "ii ", "", "", "k" * 100]  # the second before the arm follows
    leader = leader_of(cell, kind="keyboard", pressed=lambda keys: typed.pop(0) if typed else "i")
    tool = Station(cell.config).arms[0].kinematics.tool_pose
    leader.connect()
    leader.start()
    forward = leader.read(follower())
    np.testing.assert_allclose(tool(forward.joints)[:3, 3] - tool(PARK)[:3, 3], [0.008, 0, 0], atol=1e-3)
    assert forward.finger_travel == 0.0
    np.testing.assert_array_equal(leader.read(follower()).joints, forward.joints)
    held = replace(follower(), finger_travel=0.6 * TRAVEL, grip_load=0.8)
    leader.start()
    assert leader.read(held).finger_travel == 0.0  # what it holds would fall
    leader.start()
    assert leader.read(follower()).finger_travel == TRAVEL
    for _ in range(50):  # the follower does not move: something is in its way
        command = leader.read(follower())
    assert np.linalg.norm(tool(command.joints)[:3, 3] - tool(PARK)[:3, 3]) < 0.04


def test_a_gamepad_moves_the_tool_and_its_button_the_gripper(cell, tmp_path):
    device = tmp_path / "js0"
    os.mkfifo(device)
    leader = leader_of(cell, kind="gamepad", device=str(device))
    leader.connect()
    wire = os.open(device, os.O_WRONLY)
    os.write(wire, EVENT.pack(0, 1, BUTTON, 0))  # before the arm follows
    leader.start()
    tool = Station(cell.config).arms[0].kinematics.tool_pose
    os.write(wire, EVENT.pack(1, -32767, AXIS, 1) + EVENT.pack(2, 1, BUTTON, 0) + EVENT.pack(3, 2000, AXIS, 0))
    for _ in range(5):
        command = leader.read(follower())
    moved = tool(command.joints)[:3, 3] - tool(PARK)[:3, 3]
    np.testing.assert_allclose(moved, [5 * 0.12 / 50, 0, 0], atol=1e-3)
    assert command.finger_travel == 0.0
    os.close(wire)
    with pytest.raises(RobotError, match="unplugged"):
        leader.read(follower())


# Reports of a SpaceMouse Compact: an axis pushed fully is 350; 1 is translation, 2 rotation, 3 the buttons.
FORWARD, LEFT_TURN = struct.pack("<Bhhh", 1, 0, -350, 0), struct.pack("<Bhhh", 2, 0, 0, -175)
PRESSED, RELEASED = b"\x03\x01" + bytes(5), b"\x03" + bytes(6)
STEPS = """
import os, termios, tty
terminal = os.open("/dev/hidraw0", os.O_RDWR | os.O_NOCTTY)  # umockdev's device; it would take report 3 for Ctrl-C
tty.setraw(terminal, termios.TCSANOW)
import json, time
from robust_instant_policy.robots.leaders.spacemouse import SpaceMouseSource
source, steps = SpaceMouseSource("", 50), []
source.connect()
while len(steps) < 50:
    motion, toggled = source.step()
    steps.append((motion.tolist(), bool(toggled)))
    time.sleep(0.02)
time.sleep(1.5)  # reports at every 0.2 s, and then 0.5 s without
source.step()
time.sleep(0.6)
steps.append((source.step()[0].tolist(), False))
print(json.dumps(steps))
"""


@pytest.mark.skipif(not shutil.which("umockdev-run"), reason="umockdev emulates the kernel's side of the device")
def test_a_spacemouse_moves_the_tool_as_its_cap_is_pushed_and_a_button_the_gripper(tmp_path):
    """Through pyspacemouse and the system's HIDAPI; only /sys and /dev/hidraw0 are emulated."""
    descriptor = bytes.fromhex("05010908A101C0")
    size = struct.pack("<i", len(descriptor))
    answers = {"HIDIOCGRDESCSIZE": size, "HIDIOCGRDESC": size + descriptor.ljust(4096, b"\0")}
    lines = [f"{name} 0 {content.hex().upper()}" for name, content in answers.items()]
    (tmp_path / "ioctl").write_text("\n".join(["@DEV /dev/hidraw0", *lines, ""]))
    reports = (FORWARD, LEFT_TURN, PRESSED, RELEASED, PRESSED, RELEASED, PRESSED)
    script = b"".join(b"r 200 " + b"".join(map(escaped, report)) + b"\n" for report in reports)
    (tmp_path / "reports").write_bytes(script)
    command = ["umockdev-run", "-d", str(Path(__file__).with_name("files") / "spacemouse.umockdev")]
    command += ["-i", f"/dev/hidraw0={tmp_path / 'ioctl'}", "-s", f"/dev/hidraw0={tmp_path / 'reports'}"]
    done = subprocess.run([*command, "--", sys.executable, "-c", STEPS], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    steps = json.loads(done.stdout.splitlines()[-1])
    wanted = [0.12 / 50, 0, 0, 0, 0, 0.4 / 50]
    assert any(np.allclose(motion, wanted, atol=1e-9) for motion, _ in steps)
    assert not np.any(steps[-1][0])  # a device that says no more moves nothing
    assert sum(toggled for _, toggled in steps) % 2 == 1  # three presses, however they fall into steps


def escaped(byte):
    """A byte of a report in umockdev's script."""
    return b"^" + bytes([byte + 64]) if byte < 32 else b"^`" if byte == ord("^") else bytes([byte])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"signs": np.full(6, 0.5)}, r"signs must be 1 or -1 for each joint"),
        ({"gripper_channel": 3}, r"channels must be different numbers"),
        ({"gripper_channel": 7}, r"has 7 channels, 0 to 6; its calibration reads channel 7: run rip calibrate leader"),
    ],
)
def test_a_calibration_that_is_not_of_this_leader_is_told_before_it_leads(cell, change, words):
    sound = JointMap(np.arange(6), np.ones(6), np.zeros(6), 6, 1.7, 0.0)
    replace(sound, **change).save(cell.file.parent / "so101.toml")
    keys = " ".join(f"{name}.pos" for name in Teleoperator.names)
    table = {"factory": f"{__name__}:Teleoperator", "calibration": "so101.toml", "keys": keys}
    with pytest.raises((CellError, RobotError), match=words):
        leader_of(cell, kind="lerobot", **table).connect()


def test_a_leader_that_is_missing_or_not_calibrated_is_told(cell):
    with pytest.raises(CellError, match="has no leader"):
        make_leader(replace(cell.config.arms[0], leader=None), Station(cell.config).arms[0], 50.0, cell.file, str)
    with pytest.raises(CellError, match=r"is not calibrated.*rip calibrate leader"):
        leader_of(cell, kind="gello", port="/dev/ttyUSB9")
    with pytest.raises(CellError, match="leader arms are aloha, gello, lerobot"):
        leader_of(cell, kind="spacenav")
    with pytest.raises(RobotError, match=r"cannot open /dev/input/js99.*group input"):
        leader_of(cell, kind="gamepad", device="/dev/input/js99").connect()
    with pytest.raises(RobotError, match=r"SpaceMouse cannot be opened: .*libhidapi-hidraw0 and a udev rule"):
        leader_of(cell, kind="spacemouse").connect()
