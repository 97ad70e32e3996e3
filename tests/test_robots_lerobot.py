"""LeRobot's robots and teleoperators: classes of our own follow and lead through the adapters.

Where LeRobot is installed (`make lerobot`), they derive from its ``Robot`` and ``Teleoperator``, else have that shape.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from robust_instant_policy.errors import CellError, RobotError
from robust_instant_policy.motion.guard import plan_guarded
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.leaders import JointMap, make_leader
from robust_instant_policy.robots.signals import StopRequest
from robust_instant_policy.robots.station import Station
from robust_instant_policy.trajectory import Trajectory

KEYS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
SIGNS, OFFSETS = (1, -1, 1, 1, 1), (0, 10, 0, 0, 0)
PARK = (0.9, -0.6, 1.2, 0.9, 0.0)
AXES = ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "1 0 0")
ORIGINS = ("0 0 0.06", "0 0 0.05", "0.03 0 0.11", "0.13 0 0", "0.06 0 0")


def urdf() -> str:
    """A desktop arm of five joints, with a jaw."""
    text = '<robot name="desk"><link name="base"/>'
    before = "base"
    for name, axis, origin in zip(JOINTS, AXES, ORIGINS, strict=True):
        text += (
            f'<joint name="{name}" type="revolute"><parent link="{before}"/><child link="{name}_link"/>'
            f'<origin xyz="{origin}"/><axis xyz="{axis}"/><limit lower="-2" upper="2" velocity="3" effort="3"/></joint>'
            f'<link name="{name}_link"><collision><geometry><sphere radius="0.02"/></geometry></collision></link>'
        )
        before = f"{name}_link"
    text += (
        f'<joint name="jaw" type="revolute"><parent link="{before}"/><child link="jaw_link"/><origin xyz="0.04 0 0"/>'
        '<axis xyz="0 0 1"/><limit lower="0" upper="1" velocity="3" effort="3"/></joint><link name="jaw_link">'
        '<collision><geometry><sphere radius="0.01"/></geometry></collision></link>'
        f'<joint name="mount" type="fixed"><parent link="{before}"/><child link="tool"/><origin xyz="0.08 0 0" '
        'rpy="3.141592653589793 -1.570796326794897 0"/></joint><link name="tool"/></robot>'
    )
    return text


try:
    from lerobot.robots import Robot, RobotConfig
    from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

    @dataclass
    class DeskConfig(RobotConfig):
        disable_torque_on_disconnect: bool = True

except ImportError:  # it needs an environment of its own
    DeskConfig = TeleoperatorConfig = SimpleNamespace

    class Robot:
        def __init__(self, config: Any): ...

    Teleoperator = Robot


class Device:
    """What LeRobot asks of a device, beyond its data."""

    is_connected = is_calibrated = True
    action_features = observation_features = feedback_features = MappingProxyType(dict.fromkeys(KEYS, float))

    def connect(self, calibrate: bool = True) -> None: ...
    def calibrate(self) -> None: ...
    def configure(self) -> None: ...
    def send_feedback(self, feedback: dict) -> None: ...
    def disconnect(self) -> None: ...


class Desk(Device, Robot):
    """Follows its actions at once, in degrees and percent, as LeRobot's robots do."""

    name, config_class = "desk", DeskConfig

    def __init__(self, folder: Path) -> None:
        self.config = DeskConfig(id="desk", calibration_dir=folder)
        self.config.disable_torque_on_disconnect = True
        super().__init__(self.config)
        degrees = np.array(SIGNS) * np.rad2deg(PARK) + OFFSETS
        self.values = {f"{name}.pos": float(value) for name, value in zip(JOINTS, degrees, strict=True)}
        self.values["gripper.pos"] = 100.0
        self.broken = False

    def connect(self, calibrate: bool = True) -> None:
        assert not self.config.disable_torque_on_disconnect  # it would fall at the end

    def get_observation(self) -> dict:
        if self.broken:
            raise ConnectionError("no status packet")
        return {**self.values, "front": np.zeros((4, 4, 3))}

    def send_action(self, action: dict) -> dict:
        self.values.update(action)
        return action


class Leading(Device, Teleoperator):
    """A leader arm at the desk's park pose, turned by 0.2 rad, its trigger half closed."""

    name, config_class = "leading", TeleoperatorConfig

    def __init__(self, folder: Path) -> None:
        super().__init__(TeleoperatorConfig(id="leading", calibration_dir=folder))

    def get_action(self) -> dict:
        values = [*np.rad2deg(np.subtract(PARK, [0.2, 0, 0, 0, 0])), 50.0]
        return {f"{name}.pos": float(value) for name, value in zip(KEYS, values, strict=True)}


TWO = f"""[[arms]]
name = "left"
model = "desk.urdf"
park = {list(PARK[:4])}
gripper = "gripper.toml"
driver = {{ kind = "lerobot", factory = "my_robot:make", keys = "{" ".join(f"{name}.pos" for name in JOINTS[:4])}" }}
[[arms]]"""


@pytest.fixture
def cell(tmp_path, monkeypatch):
    module = SimpleNamespace(desk=Desk(tmp_path))
    module.make, module.leading = lambda: module.desk, lambda: Leading(tmp_path)
    monkeypatch.setitem(sys.modules, "my_robot", module)
    (tmp_path / "desk.urdf").write_text(urdf())
    (tmp_path / "gripper.toml").write_text("length = 0.06\nopening = 0.05\n")
    keys = " ".join(f"{name}.pos" for name in JOINTS)
    path = tmp_path / "cell.toml"
    path.write_text(
        f"[cell]\nrate_hz = 100\nworkspace = [[-0.1, -0.4, 0.0], [0.45, 0.4, 0.5]]\n[[arms]]\nname = 'desk'\n"
        f"model = 'desk.urdf'\npark = {list(PARK)}\ngripper = 'gripper.toml'\njoint_speed = 5\ntool_speed = 1\n"
        f"driver = {{ kind = 'lerobot', factory = 'my_robot:make', keys = '{keys}', signs = {list(SIGNS)}, "
        f"offsets = {list(OFFSETS)} }}\n"
    )
    return path, module.desk


def turn(station: Station):
    """Turn about the base by 0.4 rad: reachable with five joints."""
    (arm,) = station.arms
    joints = np.array([arm.home + np.array([angle, 0, 0, 0, 0]) for angle in (0.0, -0.2, -0.4)])
    poses = np.array([arm.kinematics.tool_pose(row) for row in joints])
    trajectory = Trajectory.from_poses(poses, [0.0, 0.0, 1.0], arm.triangle)
    return plan_guarded(trajectory, station.arms, station.config.limits, 5.0, station.rate_hz)


def test_a_plan_arrives_in_the_robots_own_units_and_its_torque_stays_on(cell):
    path, desk = cell
    with Station(CellConfig.load(path)) as station:
        motion = turn(station)
        played = station.play(motion, StopRequest())
    assert not played.stopped
    sent = np.array([desk.values[f"{name}.pos"] for name in JOINTS])
    np.testing.assert_allclose(sent, np.array(SIGNS) * np.rad2deg(motion.joints[-1, 0]) + OFFSETS, atol=1e-9)
    assert desk.values["gripper.pos"] == pytest.approx(0.0)


def test_a_teleoperator_leads_by_its_degrees_and_the_robot_follows(cell):
    path, desk = cell
    JointMap(np.arange(5), np.ones(5), np.zeros(5), 5, np.radians(100.0), 0.0).save(path.parent / "leader.toml")
    keys = " ".join(f"{name}.pos" for name in KEYS)
    leader = f"{{ kind = 'lerobot', factory = 'my_robot:leading', keys = '{keys}', calibration = 'leader.toml' }}"
    path.write_text(path.read_text().replace("driver =", f"leader = {leader}\ndriver ="))
    config = CellConfig.load(path)
    with Station(config) as station:
        device = make_leader(config.arms[0], station.arms[0], 100.0, path.parent, lambda keys: "")
        device.connect()
        device.start()
        steps = iter(range(100))
        station.lead(lambda states: [device.read(states[0])] if next(steps) < 99 else None)
        device.disconnect()
    assert desk.values["shoulder_pan.pos"] == pytest.approx(np.rad2deg(PARK[0] - 0.2))
    assert desk.values["gripper.pos"] == pytest.approx(50.0)
    path.write_text(path.read_text().replace(keys, "shoulder.pos " * 6))
    with pytest.raises(RobotError, match=r"has no shoulder\.pos.*it has elbow_flex\.pos"):
        make_leader(CellConfig.load(path).arms[0], station.arms[0], 100.0, path.parent, lambda keys: "").connect()


def test_a_joint_that_turns_without_end_has_no_range(cell):
    path, desk = cell
    urdf = path.parent / "desk.urdf"
    before, roll = urdf.read_text().split('<joint name="wrist_roll" type="revolute">')
    roll = roll.replace('<limit lower="-2" upper="2" velocity="3" effort="3"/>', "", 1)
    urdf.write_text(f'{before}<joint name="wrist_roll" type="continuous">{roll}')
    path.write_text(path.read_text().replace("0.9, 0.0]", "0.9, 3.5]"))
    desk.values["wrist_roll.pos"] = np.rad2deg(3.5)
    with Station(CellConfig.load(path)) as station:
        assert not station.play(turn(station), StopRequest()).stopped


def test_an_arm_that_cannot_be_stopped_leaves_the_others_stopped_and_all_disconnected(cell, monkeypatch):
    path, desk = cell
    station = Station(CellConfig.load(path))
    (first,), done = station.followers, []

    class Second:
        def connect(self): ...
        def stop(self):
            done.append("stopped")

        def disconnect(self):
            done.append("disconnected")

    def broken():
        raise KeyError("no such register")

    monkeypatch.setattr(first, "stop", broken)
    desk.disconnect = lambda: done.append("desk disconnected")
    station.followers = first, Second()
    with pytest.raises(KeyError), station:
        pass
    assert done == ["stopped", "disconnected", "desk disconnected"]


def test_a_robot_that_does_not_answer_stops_the_run_and_is_named(cell):
    path, desk = cell
    with Station(CellConfig.load(path)) as station:
        motion = turn(station)
        desk.broken = True
        played = station.play(motion, StopRequest())
    assert "desk does not answer: no status packet" in played.stopped


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("wrist_roll.pos", "", "keys must name 5 joints"),
        ("wrist_roll.pos", "gripper.pos", "keys must name each joint once, and not the gripper"),
        ("'my_robot:make'", "'my_robot:nothing'", "factory must be module:function"),
        (
            "'my_robot:make'",
            "'my_robot:desk'",
            "my_robot:desk fails: TypeError: 'Desk' object is not callable",
        ),
        ("'desk.urdf'", "'other.urdf'", "no model 'other.urdf'; known: viperx-300"),
        ("'desk.urdf'", "'broken.urdf'", "^[^\\n]*broken.urdf cannot be used: [^\\n]*; it needs a link called tool$"),
        ("signs = [1,", "signs = [0.5,", "signs must be 1 or -1 for each joint"),
        ("[[arms]]", TWO, "arms of a cell must have as many joints as each other, not left 4, desk 5"),
    ],
)
def test_a_wrong_line_about_the_robot_is_named(cell, old, new, words):
    path, _ = cell
    (path.parent / "broken.urdf").write_text("<robot><joint/></robot>")
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(CellError, match=words):
        Station(CellConfig.load(path))
