"""Calibrations with a person: touching, holding and photographing the board, copying joints."""

import time
from collections.abc import Sequence

import numpy as np

from robust_instant_policy.errors import CalibrationError, StoppedError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.state import Command
from robust_instant_policy.robots.calibration.board import Board
from robust_instant_policy.robots.camera import Camera, Frame
from robust_instant_policy.robots.leader import Leader
from robust_instant_policy.robots.leaders.arm_leader import JointSource
from robust_instant_policy.robots.leaders.joint_map import JointMap, calibrate_joints
from robust_instant_policy.robots.operator import ENTER, Operator
from robust_instant_policy.robots.recording import DISCARD, guide
from robust_instant_policy.robots.station import Station

STILL_S = 0.5  # between the end of a motion and a reading
TURN_RAD = 0.35  # of a joint that a leader has to copy
COUPLED = "coupled: Enter takes the reading"


class Guide:
    """Guides a person who moves arm ``index`` of a connected station with its leader."""

    def __init__(self, station: Station, leader: Leader, index: int, operator: Operator):
        self._station, self._index, self._operator = station, index, operator
        self._leaders: list[Leader | None] = [None] * len(station.arms)
        self._leaders[index] = leader

    def poses(self, words: Sequence[str]) -> FloatArray:
        """Tool poses ``(N, 4, 4)``, one where the person led the arm after each line."""
        return np.stack([self._pose(line) for line in words])

    def held_board(self, camera: Camera, board: Board, count: int) -> tuple[list[Frame], FloatArray]:
        """``count`` frames of a board in the hand, and the tool poses ``(N, 4, 4)``; unusable ones are repeated."""
        frames: list[Frame] = []
        hands = []
        while len(frames) < count:
            pose = self._pose(f"pose {len(frames) + 1} of {count}: turn the board to another side, in full view")
            if (frame := _photograph(camera, board, self._operator)) is not None:
                frames.append(frame)
                hands.append(pose)
        return frames, np.stack(hands)

    def _pose(self, words: str) -> FloatArray:
        self._operator.say(words)
        require(self._operator, guide(self._station, self._leaders, self._operator, COUPLED))
        time.sleep(STILL_S / self._station.config.pace)
        joints = self._station.states()[self._index].joints
        return self._station.arms[self._index].kinematics.tool_pose(joints)


def photograph_places(camera: Camera, board: Board, count: int, operator: Operator) -> list[Frame]:
    """Frames of a board at ``count`` places of the table; the person moves it between them."""
    frames: list[Frame] = []
    while len(frames) < count:
        where = "where it lies" if not frames else "at another place on the table, near another corner of the image"
        _wait(operator, f"place {len(frames) + 1} of {count}: the board {where}, in full view; Enter photographs")
        if (frame := _photograph(camera, board, operator)) is not None:
            frames.append(frame)
    return frames


def _photograph(camera: Camera, board: Board, operator: Operator) -> Frame | None:
    """A frame in which the board is found; None where it is not, which the person is told."""
    with operator.stop.ends_waiting():
        frame = camera.read()
    try:
        board.find(frame.rgb)
    except CalibrationError as error:
        operator.say(f"  not usable: {error}")
        return None
    return frame


def copied_turns(station: Station, source: JointSource, index: int, operator: Operator) -> JointMap:
    """Joint map of a leader arm: arm ``index`` turns joint after joint, and the person copies it with the leader."""
    rest = station.states()[index].joints
    _wait(operator, "give the leader the same pose as the follower; Enter")
    joints, readings = [rest], [source.angles()]
    highest = station.arms[index].kinematics.joint_range[:, 1]
    for joint in range(len(rest)):
        shown = rest.copy()
        shown[joint] += TURN_RAD if rest[joint] + TURN_RAD < highest[joint] else -TURN_RAD
        _show(station, index, shown, operator)
        _wait(
            operator, f"joint {joint + 1} of the follower turned; turn that joint of the leader alike, no other; Enter"
        )
        joints.append(station.states()[index].joints)
        readings.append(source.angles())
        _show(station, index, rest, operator)
        _wait(operator, "turn it back; Enter")
    _wait(operator, "open the trigger; Enter")
    opened = source.angles()
    _wait(operator, "close the trigger; Enter")
    return calibrate_joints(np.array(joints), np.array(readings), opened, source.angles())


def _wait(operator: Operator, words: str) -> None:
    """Say ``words``, and wait for Enter."""
    require(operator, operator.ask(words, ENTER))


def require(operator: Operator, key: str) -> None:
    """Raises `StoppedError` for anything but Enter."""
    if key != ENTER:
        raise StoppedError(operator.stop.reason or "ended by " + ("d" if key == DISCARD else "q"))


def _show(station: Station, index: int, joints: FloatArray, operator: Operator) -> None:
    """Move arm ``index`` to ``joints``; raises `CalibrationError` where it does not come there."""
    steps = 0

    def command(states: Sequence) -> list[Command] | None:
        nonlocal steps
        steps += 1
        last = list(station.gate.last)
        gap = joints - last[index].joints
        if operator.stop.reason or np.abs(gap).max() < 1e-6 or steps > 10 * station.rate_hz:
            return None
        most = 0.3 / station.rate_hz
        last[index] = Command(last[index].joints + np.clip(gap, -most, most), last[index].finger_travel)
        return last

    station.lead(command)
    if operator.stop.reason:
        raise StoppedError(operator.stop.reason)
    if np.abs(station.gate.last[index].joints - joints).max() > 0.02:
        raise CalibrationError(
            f"{station.arms[index].name} cannot turn joint by joint from here without leaving its limits; give it "
            "another park pose, in the middle of its joints' ranges"
        )
