"""Recording with leader and follower on emulated buses, through the real drivers."""

import io
import json
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("dynamixel_sdk")

from robust_instant_policy.commands.live_camera import LiveCamera
from robust_instant_policy.datasets import DatasetWriter, load_demonstrations
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import RobotError, StoppedError
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.journal import Journal
from robust_instant_policy.robots.operator import ENTER
from robust_instant_policy.robots.recording import APPROACH_RAD_S
from robust_instant_policy.robots.session import keep_calibration
from robust_instant_policy.robots.signals import stop_on_signals
from robust_instant_policy.robots.station import Station
from tests.robot_cell import Cell, Scripted, shown, teaches
from tests.robots_cells import write_cell

KEEP = [("Enter", ENTER)]


@pytest.fixture
def cell(tmp_path):
    cell = Cell(tmp_path)
    yield cell
    cell.unplug()


def record(cell, out, answers, rows=None, count=1, press=None):
    """Run a session; returns the number of demonstrations in the folder ``out``."""
    cell.operator = Scripted(answers)
    cell.operator.press = press or teaches(cell, shown() if rows is None else rows)
    with Station(cell.config) as station, DatasetWriter(out, "turn", "turn it", 50) as writer:
        cell.session(station, writer, cell.operator).record(count)
        return writer.num_episodes


def test_what_the_leader_shows_is_what_the_dataset_holds(cell, tmp_path):
    out = tmp_path / "demos"
    assert record(cell, out, KEEP) == 1
    (demonstration,) = load_demonstrations(out)
    arm = Station(cell.config).arms[0]
    rows = shown()
    tips = np.array([arm.kinematics.tool_pose(joints)[:3, 3] for joints, _ in rows])
    recorded = demonstration.trajectory.triplets[:, 0, 1:].mean(axis=1)
    np.testing.assert_allclose(recorded[0], tips[0], atol=0.004)
    np.testing.assert_allclose(recorded[-1], tips[-1], atol=0.004)
    assert 1.3 < demonstration.seconds < 2.2
    state = demonstration.trajectory.gripper_state[:, 0]
    assert set(state) == {0.0, 1.0}
    assert np.flatnonzero(state)[0] == pytest.approx(len(state) / 2, abs=8)
    assert demonstration.info["calibration"] == cell.config.digest
    copies = list((out / "meta" / f"cell-{cell.config.digest}").iterdir())
    assert {file.name for file in copies} == {"cell.toml", "camera.toml"}
    assert any("whether images and paths belong together" in line for line in cell.operator.said)


def test_the_files_of_two_arms_are_kept_apart(tmp_path):
    path = write_cell(tmp_path, "left", "right")
    text = path.read_text()
    for name, length in (("left", 0.15), ("right", 0.16)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "gripper.toml").write_text(f"length = {length}\nopening = 0.07\n")
        text = text.replace(f'name = "{name}"', f'name = "{name}"\ngripper = "{name}/gripper.toml"')
    path.write_text(text)
    keep_calibration(CellConfig.load(path), tmp_path / "demos")
    (kept,) = (tmp_path / "demos" / "meta").glob("cell-*/cell.toml")
    assert [arm.gripper.length for arm in CellConfig.load(kept).arms] == [0.15, 0.16]


def test_a_follower_comes_slowly_to_a_leader_that_is_elsewhere(tmp_path):
    cell = Cell(tmp_path, hand_away=0.3)
    try:
        rows = [(joints + 0.3, travel) for joints, travel in shown()]
        record(cell, tmp_path / "demos", KEEP, rows)
        commands = cell.twin.commands[:, 0, :-1]
        speed = np.abs(np.diff(commands, axis=0)).max(axis=1) * 50
        coupling = np.flatnonzero(np.abs(commands - commands[0]).max(axis=1) < 0.2)
        assert speed[coupling[:-1]].max() <= APPROACH_RAD_S * 1.2
    finally:
        cell.unplug()


def test_a_discarded_demonstration_is_counted_and_recorded_again(cell, tmp_path):
    answers = iter(["d", ENTER])
    rules = [("keeps it", lambda: next(answers)), *KEEP]
    out = tmp_path / "demos"
    cell.operator = None
    assert record(cell, out, rules) == 1
    with DatasetWriter(out, "turn", "turn it", 50) as writer:
        assert (writer.num_episodes, writer.discarded) == (1, 1)
    assert sum("a gripper is closed" in line for line in cell.operator.said) == 1
    (demonstration,) = load_demonstrations(out)
    assert demonstration.trajectory.gripper_state[0, 0] == 0


def test_an_arm_that_did_not_move_makes_no_demonstration(cell, tmp_path):
    questions = iter([ENTER, "q"])
    rules = [("arrange the scene", lambda: next(questions)), *KEEP]
    assert record(cell, tmp_path / "demos", rules, rows=shown()[:1]) == 0
    assert any("nothing was shown" in line for line in cell.operator.said)


def test_a_killed_process_loses_no_step(tmp_path):
    out = tmp_path / "demos"
    command = [sys.executable, "-m", "tests.robot_cell", str(tmp_path), str(out)]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True, timeout=60)
    assert done.returncode == -9, done.stderr
    episode = Journal(out).read()
    assert len(episode.steps) > 50
    cell = Cell(tmp_path)
    try:
        (tmp_path / "cell.toml").touch()
        assert record(cell, out, KEEP, count=1) == 1
        assert any(f"episode of {len(episode.steps)} steps was found" in line for line in cell.operator.said)
        assert len(load_demonstrations(out)) == 1
        assert Journal(out).read() is None
    finally:
        cell.unplug()


def test_a_request_to_stop_holds_the_arm_and_keeps_the_episode(cell, tmp_path):
    teach = None

    def press():
        if len(cell.hand.script) == 20:
            cell.operator.stop("Ctrl-C")
        return teach()

    cell.operator = None
    teach_rows = shown()

    def lazily():
        nonlocal teach
        teach = teach or teaches(cell, teach_rows)
        return press()

    with pytest.raises(StoppedError, match=r"Ctrl-C; the arms hold; the episode of .* steps is kept"):
        record(cell, tmp_path / "demos", KEEP, press=lazily)
    assert len(Journal(tmp_path / "demos").read().steps) > 50
    assert not cell.follower.limp
    still = cell.twin.state(0).joints
    assert np.abs(cell.twin.commands[-1, 0, :-1] - still).max() < 0.2


def test_a_request_to_stop_ends_the_waiting_for_a_camera_that_hangs(cell, tmp_path):
    here, _there = multiprocessing.Pipe()

    class Hanging:
        name = "hanging"

        def read(self):
            threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
            here.poll(60)  # as `LiveCamera` waits
            pytest.fail("it waited on")

    with (
        Station(cell.config) as station,
        DatasetWriter(tmp_path / "demos", "turn", "turn it", 50) as writer,
        stop_on_signals() as stop,
    ):
        operator = Scripted(KEEP)
        operator.stop = stop
        session = replace(cell.session(station, writer, operator), camera=Hanging())
        with pytest.raises(StoppedError, match="Ctrl-C; the arms hold their position"):
            session.record(1)
    assert not cell.follower.limp


def test_an_unplugged_leader_stops_the_follower_and_keeps_the_episode(cell, tmp_path):
    teach = None

    def press():
        nonlocal teach
        teach = teach or teaches(cell, shown())
        if len(cell.hand.script) == 20:
            cell.leader.unplug()
        return teach()

    with pytest.raises(RobotError, match="unplugged"):
        record(cell, tmp_path / "demos", KEEP, press=press)
    assert len(Journal(tmp_path / "demos").read().steps) > 50
    assert not cell.follower.limp


def test_a_full_disk_is_told_and_the_demonstration_is_stored_once_there_is_space(cell, tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill():
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
        return ENTER

    def free():
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        return ENTER

    rules = [("tries again", free), ("keeps it", fill), *KEEP]
    try:
        assert record(cell, tmp_path / "demos", rules) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert any("no space left" in line for line in cell.operator.said)


def test_the_page_shows_the_live_picture_and_the_keypoints_of_the_start_image(cell, tmp_path):
    def get(path, host="127.0.0.1"):
        return urllib.request.urlopen(urllib.request.Request(camera.url + path, headers={"Host": host})).read()

    camera = LiveCamera(cell.config.camera, tmp_path, tmp_path / "demos", cell.config.limits.workspace)
    camera.connect()
    try:
        frame = camera.read()
        camera.show(Observation(frame.rgb, frame.depth, frame.intrinsics, np.eye(4)))
        camera.say("hold the leader <here>")
        within(20, lambda: b"once there is a demonstration" in get("/start"))
        within(20, lambda: json.loads(get("/state"))["line"] == "hold the leader <here>")
        shown = np.asarray(Image.open(io.BytesIO(get("/live.jpg"))), dtype=float)
        grey = (image @ [0.299, 0.587, 0.114] for image in (shown, frame.rgb))  # JPEG keeps fewer colours
        assert np.corrcoef(*map(np.ravel, grey))[0, 1] > 0.9
        assert b"/live.jpg" in get("/")
        with pytest.raises(urllib.error.HTTPError, match="403"):
            get("/live.jpg", host="attacker.example")
        for _ in range(11):  # looking used up none
            camera.read()
        with pytest.raises(RobotError, match=r"the 12 images of .* are used up"):
            camera.read()
    finally:
        camera.disconnect()
    with pytest.raises(RobotError, match="has ended"):
        camera.read()


def within(seconds, happens):
    """Wait until ``happens()`` is true."""
    end = time.monotonic() + seconds
    while not happens():
        assert time.monotonic() < end
        time.sleep(0.05)
