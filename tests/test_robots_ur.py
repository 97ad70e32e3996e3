"""The UR5e through ur_rtde and its Hand-E, against an emulated controller in a process of its own."""

from __future__ import annotations

import re
import socketserver
import threading

import numpy as np
import psutil
import pytest

from robust_instant_policy.errors import RobotError, StoppedError
from robust_instant_policy.motion.guard import plan_guarded
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.emulation.client import devices_of
from robust_instant_policy.robots.execution import is_parked, park
from robust_instant_policy.robots.signals import StopRequest
from robust_instant_policy.robots.station import Station
from tests.robots_cells import after, reach, write_cell

pytest.importorskip("rtde_control", reason="ur_rtde has no release for Python 3.13")

from robust_instant_policy.robots.rtde import GRIPPER_PORT, RobotiqGripper

POINTS = ((0.0, 0.0, 0.05), (0.0, 0.0, 0.01), (0.0, 0.0, 0.05))


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    path = write_cell(tmp_path_factory.mktemp("cell"), "hand-e", pace=4.0)
    with devices_of(CellConfig.load(path)) as (config, emulation):
        yield config, emulation


@pytest.fixture
def emulated(cell):
    """The emulated cell without a fault, its arm at its park pose."""
    config, emulation = cell
    emulation.fault("hand-e", "")
    with Station(config) as station:
        if not is_parked(station):
            park(station, StopRequest(), 1.0)
    return cell


def pick(station: Station):
    trajectory = reach(station.arms[0].triangle, *POINTS, closed=(1, 2))
    return plan_guarded(trajectory, station.arms, station.config.limits, 1.0, station.rate_hz)


def test_a_plan_is_executed_as_planned_with_the_gripper(emulated):
    config, emulation = emulated
    with Station(config) as station:
        motion = pick(station)
        played = station.play(motion, StopRequest())
    assert not played.stopped
    assert np.linalg.norm(played.path.measured_tools[-1, 0] - POINTS[-1]) < 5e-3
    assert played.path.measured[-1, 0, -1] < 1e-3
    np.testing.assert_allclose(emulation.commands()[-1, 0, :6], motion.joints[-1, 0], atol=1e-3)


def end_library():
    (process,) = [one for one in psutil.Process().children() if "robust_instant_policy.robots.rtde" in one.cmdline()]
    process.kill()


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("protective-stop", "protective stop; see the teach pendant for the reason"),
        ("frozen", r"frozen|away from its command"),
        ("silent", "does not answer"),
        ("nan", "not numbers"),
        ("library's process ends", "the connection to .* was lost, and the UR library with it"),
    ],
)
def test_a_fault_stops_the_arm_and_a_later_run_works_again(emulated, fault, words):
    config, emulation = emulated
    with Station(config) as station:
        motion = pick(station)
        if "ends" in fault:
            thread = after(emulation, 40, end_library)
        else:
            thread = after(emulation, 40, emulation.fault, "hand-e", fault)
        played = station.play(motion, StopRequest())
        thread.join()
        assert re.search(words, played.stopped)
        assert 0 < len(played.path.seconds) < len(motion.joints)
        executed = len(emulation.commands())
        emulation.fault("hand-e", "")
    assert len(emulation.commands()) <= executed + 1
    with Station(config) as station:
        assert not park(station, StopRequest(), 1.0).stopped


def test_an_arm_whose_positions_are_not_numbers_is_not_parked(emulated):
    config, emulation = emulated
    with Station(config) as station:
        emulation.fault("hand-e", "nan")
        while np.isfinite(station.states()[0].joints).all():
            pass
        with pytest.raises(StoppedError, match="hand-e measures positions that are not numbers"):
            park(station, StopRequest(), 1.0)


def test_a_garbled_answer_of_the_gripper_is_told():
    class Garbled(socketserver.StreamRequestHandler):
        def handle(self):
            for line in self.rfile:
                self.wfile.write(b"STA 3\n" if line == b"GET STA\n" else b"P\xff\n")

    address = "127.63.0.1"
    with socketserver.ThreadingTCPServer((address, GRIPPER_PORT), Garbled) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        gripper = RobotiqGripper(address, 0.025, 100, 5.0)
        gripper.connect()
        with pytest.raises(RobotError, match=r"the gripper at 127\.63\.0\.1 answers .*, not three numbers"):
            gripper.read()
        gripper.disconnect()
        server.shutdown()


def test_a_lost_network_is_told_and_a_controller_that_is_not_there_is_named(tmp_path):
    with devices_of(CellConfig.load(write_cell(tmp_path, "hand-e", pace=4.0))) as (config, emulation):
        with Station(config) as station:
            thread = after(emulation, 40, emulation.fault, "hand-e", "unplugged")
            played = station.play(pick(station), StopRequest())
            thread.join()
        assert "does not answer" in played.stopped or "lost" in played.stopped
        with pytest.raises(RobotError, match="no controller at 127"), Station(config):
            pass
