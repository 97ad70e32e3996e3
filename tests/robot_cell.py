"""A cell in this process: a ViperX on an emulated bus, its leader on another one, moved by a scripted hand."""

import sys
import time
from pathlib import Path

import numpy as np

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.robots.cameras import make_camera
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.emulation.servos import ServoBus
from robust_instant_policy.robots.emulation.twin import LaggingTwin, SharedTwin, TwinState
from robust_instant_policy.robots.leaders import make_leader
from robust_instant_policy.robots.operator import ENTER
from robust_instant_policy.robots.session import Session
from robust_instant_policy.robots.signals import StopRequest
from robust_instant_policy.robots.station import Station

PARK = np.array([0.0, -0.6, 0.6, 0.0, 0.9, 0.0])
TRAVEL = 0.0346
PACE = 4.0

CELL = """
[cell]
workspace = [[-0.40, -0.40, -0.005], [0.40, 0.40, 0.60]]

[[arms]]
name = "left"
model = "viperx-300"
base = [-0.469, 0, 0, 0, 0, 0]
park = {park}
driver = {{ kind = "viperx", port = "{follower}", timeout_ms = 600 }}
leader = {{ kind = "aloha", port = "{leader}", timeout_ms = 600 }}

[camera]
kind = "folder"
path = "images"
calibration = "camera.toml"

[emulation]
pace = {pace}
"""


class Hand:
    """A twin that is where it was put; of a ``script`` of (joints, travel) it takes the next row at each reading."""

    def __init__(self, joints, travel=TRAVEL):
        self.joints, self.travel, self.script = np.array(joints), travel, []

    def states(self):
        if self.script:
            self.joints, self.travel = self.script.pop(0)
        return [TwinState(np.array(self.joints), self.travel, 0.0)]

    def advance(self, commands):
        """A person's hand does not follow commands."""

    def reset(self, seed):
        """The hand stays."""


class Scripted:
    """An `Operator` who answers each question by the first rule whose words it holds, and ends episodes on time.

    ``answers`` are (words, key or function); ``press()`` is asked in each step for keys.
    """

    def __init__(self, answers, press=lambda: ""):
        self.stop, self.answers, self.press, self.said = StopRequest(), answers, press, []

    def say(self, line):
        self.said.append(line)

    def pressed(self, keys):
        return "".join(key for key in self.press() if key in keys)

    def ask(self, line, keys):
        self.say(line)
        if self.stop.reason:
            return ""
        for words, answer in self.answers:
            if words in line:
                key = answer() if callable(answer) else answer
                assert key in keys, line
                return key
        raise AssertionError(f"nobody answers {line!r}")


class Cell:
    """``config`` in the folder ``path``; ``hand`` moves the leader, ``twin`` is the follower's physics."""

    def __init__(self, path, hand_away=0.0, pace=PACE):
        self.hand = Hand(PARK + hand_away)
        self.twin = SharedTwin(LaggingTwin([PARK], [TRAVEL]))
        self.follower = ServoBus(self.twin, 0, TRAVEL)
        self.leader = ServoBus(SharedTwin(self.hand), 0, TRAVEL)
        self.file = Path(path) / "cell.toml"
        self.file.write_text(
            CELL.format(
                park=PARK.tolist(),
                follower=self.follower.options["port"],
                leader=self.leader.options["port"],
                pace=pace,
            )
        )
        (self.file.parent / "camera.toml").write_text(f"pose = {np.diag([1.0, -1, -1, 1]).tolist()}\n")
        self.config = CellConfig.load(self.file)
        images = self.file.parent / "images"
        images.mkdir(exist_ok=True)
        rng = np.random.default_rng(0)
        for index in range(12):
            rgb = rng.integers(0, 255, (60, 80, 3), dtype=np.uint8)
            Observation(
                rgb, np.full((60, 80), 0.8, np.float32), [[80, 0, 40], [0, 80, 30], [0, 0, 1.0]], np.eye(4)
            ).save(images / f"{index:02}.npz")

    def unplug(self):
        for bus in (self.follower, self.leader):
            bus.unplug()

    def session(self, station, writer, operator):
        """A `Session` with its devices connected."""
        leader = make_leader(self.config.arms[0], station.arms[0], station.rate_hz, self.file.parent, operator.pressed)
        leader.connect()
        camera = make_camera(self.config.camera, self.file.parent)
        camera.connect()
        return Session(station, [leader], camera, writer, operator, show=lambda seen: None)


def shown(seconds=1.6, rate_hz=50.0, close_at=0.5, joint=0):
    """Rows (joints, travel) of a hand that turns ``joint`` there and closes the gripper on the way."""
    rows = []
    for share in np.linspace(0.0, 1.0, int(seconds * rate_hz)):
        joints = PARK.copy()
        joints[joint] += 0.5 * (10 * share**3 - 15 * share**4 + 6 * share**5)
        rows.append((joints, TRAVEL if share < close_at else 0.0))
    return rows


def teaches(cell, rows):
    """A function for `Scripted`: once coupled, the hand follows ``rows``; Enter 0.1 s after their end."""
    state = {"started": False, "ended": None}

    def press():
        if not state["started"]:
            state["started"] = any("coupled" in line for line in cell.operator.said)
            if state["started"]:
                cell.hand.script = list(rows)
            return ""
        if cell.hand.script:
            return ""
        state["ended"] = state["ended"] or time.monotonic()
        if time.monotonic() - state["ended"] < 0.1:
            return ""
        cell.operator.said = [line for line in cell.operator.said if "coupled" not in line]
        state.update(started=False, ended=None)
        cell.hand.joints, cell.hand.travel = PARK, TRAVEL  # ready for the next one
        return ENTER

    return press


def main(folder, out):
    """Record until this process is killed by the hand, half-way through an episode."""
    import os
    import signal

    from robust_instant_policy.datasets import DatasetWriter

    cell = Cell(folder)
    teach = None

    def press():
        if len(cell.hand.script) == 20:
            os.kill(os.getpid(), signal.SIGKILL)
        return teach()

    cell.operator = Scripted([("Enter", ENTER)], press)
    teach = teaches(cell, shown())
    with Station(cell.config) as station, DatasetWriter(out, "turn", "turn it", 50) as writer:
        cell.session(station, writer, cell.operator).record(1)


if __name__ == "__main__":
    main(*sys.argv[1:])
