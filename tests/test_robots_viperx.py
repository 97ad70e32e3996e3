"""ALOHA's arm through Robotis' SDK, on an emulated servo bus: plans arrive, and faults stop it."""

from __future__ import annotations

import os
import re
import signal
import time
from dataclasses import replace

import numpy as np
import pytest

from robust_instant_policy.cli import main
from robust_instant_policy.errors import RobotError, StoppedError
from robust_instant_policy.motion.guard import plan_guarded
from robust_instant_policy.motion.state import Command
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.emulation.client import devices_of
from robust_instant_policy.robots.execution import is_parked, park
from robust_instant_policy.robots.signals import REASONS, StopRequest, stop_on_signals
from robust_instant_policy.robots.station import Station
from tests.robots_cells import after, reach, write_cell

PICK = ((-0.15, 0.0, 0.05), (-0.15, 0.0, 0.005), (-0.15, 0.0, 0.05))


@pytest.fixture(scope="module")
def left(tmp_path_factory):
    path = write_cell(tmp_path_factory.mktemp("cell"), "left")
    with devices_of(CellConfig.load(path)) as (config, emulation):
        yield config, emulation


@pytest.fixture
def emulated(left):
    """The emulated cell without a fault, its arm at its park pose."""
    config, emulation = left
    emulation.fault("left", "")
    with Station(config) as station:
        if not is_parked(station):
            park(station, StopRequest(), 1.0)
    return left


@pytest.fixture
def own(tmp_path):
    """An emulated cell of one's own, which may be broken."""
    with devices_of(CellConfig.load(write_cell(tmp_path, "left"))) as emulated:
        yield emulated


def pick(station: Station):
    trajectory = reach(station.arms[0].triangle, *PICK, closed=(1, 2))
    return plan_guarded(trajectory, station.arms, station.config.limits, 1.0, station.rate_hz)


def test_a_plan_is_executed_as_planned_and_a_grasp_of_nothing_is_told(emulated):
    config, emulation = emulated
    with Station(config) as station:
        motion = pick(station)
        played = station.play(motion, StopRequest())
    assert not played.stopped
    path = played.path
    assert len(path.seconds) == len(motion.joints)
    sent = emulation.commands()
    np.testing.assert_allclose(sent[-1, 0, :6], motion.joints[-1, 0], atol=2e-3)  # of the servos' resolution
    assert path.joint_errors.max() < 0.1
    assert np.linalg.norm(path.measured_tools[-1, 0] - PICK[-1]) < 5e-3
    (line,) = path.empty_grasps(["left"])
    assert "the gripper left closed on nothing" in line


def test_two_arms_on_two_buses_move_together(tmp_path):
    with (
        devices_of(CellConfig.load(write_cell(tmp_path, "left", "right"))) as (config, emulation),
        Station(config) as station,
    ):
        targets = ((-0.2, 0.0, 0.1), (-0.15, 0.0, 0.15)), ((0.2, 0.0, 0.1), (0.15, 0.0, 0.15))
        single = [reach(arm.triangle, *points) for arm, points in zip(station.arms, targets, strict=True)]
        actions = np.concatenate([one.actions for one in single], axis=1)
        trajectory = type(single[0]).from_actions(actions)
        motion = plan_guarded(trajectory, station.arms, config.limits, 1.0, station.rate_hz)
        played = station.play(motion, StopRequest())
        assert not played.stopped
        assert np.linalg.norm(played.path.measured_tools[-1] - [targets[0][1], targets[1][1]], axis=1).max() < 5e-3
        assert emulation.limp() == []


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("silent", "does not answer"),
        ("frozen", r"frozen|away from its command"),
        ("blocked", r"joint 2 (is|rests) away from its command"),
        ("nan", "is away from its command"),
    ],
)
def test_a_fault_stops_the_arm_where_it_is(emulated, fault, words):
    config, emulation = emulated
    begun = len(emulation.commands())
    with Station(config) as station:
        motion = pick(station)
        thread = after(emulation, 40, emulation.fault, "left", fault)
        played = station.play(motion, StopRequest())
        thread.join()
        assert re.search(words, played.stopped)
        assert 0 < len(played.path.seconds) < len(motion.joints)
    sent = emulation.commands()[begun:, 0, :6]
    assert np.abs(np.diff(sent, axis=0)).max() * config.rate_hz < station.arms[0].joint_speed * 1.1
    assert len(sent) <= len(played.path.seconds) + 5  # what follows a stop holds the arm
    assert np.abs(sent[-1] - played.path.commanded[-1, 0, :6]).max() < 0.4


@pytest.mark.parametrize(
    ("fault", "words", "known"),
    [
        ("unplugged", "was unplugged", "look at the arms"),
        ("overload", "overload; relieve the arm", "the arms hold their position"),
    ],
)
def test_a_fault_that_lasts_stops_the_arm_and_is_named(own, fault, words, known):
    config, emulation = own
    with Station(config) as station:
        thread = after(emulation, 40, emulation.fault, "left", fault)
        played = station.play(pick(station), StopRequest())
        thread.join()
    assert re.search(words, played.stopped)
    with pytest.raises(StoppedError, match=f"{words}.*; {known}"):
        played.require_end()


def test_damaged_packets_now_and_then_do_not_disturb_a_run(emulated):
    config, emulation = emulated
    with Station(config) as station:
        emulation.fault("left", "garbled")
        played = station.play(pick(station), StopRequest())
    assert not played.stopped


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_brakes_the_arm_on_its_path_and_it_keeps_its_torque(emulated, number):
    config, emulation = emulated
    with Station(config) as station, stop_on_signals() as stop:
        motion = pick(station)
        thread = after(emulation, 60, os.kill, os.getpid(), number)
        played = station.play(motion, stop)
        thread.join()
    assert played.stopped == REASONS[number]
    changes = np.diff(played.path.commanded[:, 0, :6], axis=0) * config.rate_hz
    assert np.abs(np.diff(changes, axis=0)).max() * config.rate_hz < station.arms[0].joint_acceleration * 1.06
    assert np.abs(changes[-1]).max() < 0.3  # slow at the end
    assert emulation.limp() == []


def test_an_arm_that_stands_elsewhere_does_not_jump_to_the_plan_and_obeys_one_program(emulated):
    config, _ = emulated
    with Station(config) as station:
        motion = pick(station)
        with pytest.raises(RobotError, match="another program uses it"), Station(config):
            pytest.fail("two programs command one arm")
        elsewhere = replace(motion, joints=motion.joints + 0.3)
        played = station.play(elsewhere, StopRequest())
        assert "rad away from where the motion begins" in played.stopped
        assert len(played.path.seconds) == 0


def test_a_leaders_jump_is_followed_within_the_limits(emulated):
    config, emulation = emulated
    begun = len(emulation.commands())
    with Station(config) as station:
        goal = station.arms[0].home + np.array([0.4, 0.1, -0.1, 0.2, -0.2, 0.3])
        end = time.monotonic() + 0.5
        station.lead(lambda states: [Command(goal, 0.0)] if time.monotonic() < end else None)
    sent = emulation.commands()[begun:, 0, :6]
    assert np.abs(np.diff(sent, axis=0)).max() * config.rate_hz < station.arms[0].joint_speed * 1.05
    np.testing.assert_allclose(sent[-1], goal, atol=2e-3)


def test_a_servo_that_is_missing_is_named(own):
    config, emulation = own
    emulation.fault("left", "silent")
    station = Station(config)
    with pytest.raises(RobotError, match=r"no answer from servo 1 \(waist\).*9 \(gripper\); check power"), station:
        pass


def test_robot_check_says_what_is_well_and_what_is_not(tmp_path, capsys):
    path = write_cell(tmp_path, "left")
    leader = 'leader = { kind = "gello", port = "/dev/nowhere", calibration = "leader.toml" }'
    path.write_text(path.read_text().replace("driver", f"{leader}\ndriver"))
    assert main(["robot", "check", "--robot", str(path)]) == 1
    said = capsys.readouterr().out
    assert re.search(r"ok    left: its clock advances by \d+\.\d\d s a second", said)
    assert "WRONG the leader of left is not calibrated" in said
    assert "left: 95% of the states within" in said  # how fast depends on the machine
    assert "ok    left: at its park pose" in said
    assert "WRONG this emulated cell has no scene and no camera" in said
