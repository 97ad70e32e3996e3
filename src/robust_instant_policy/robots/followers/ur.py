"""A UR5e (or another e-Series arm) through `ur_rtde`, with a Robotiq gripper on its own port.

The library runs in a process of its own, see `robots.rtde`. It uploads a script to the controller and sends it targets
over RTDE. The controller's own watchdog stops the script when no target arrives for 100 ms; its safety system is always
active.
"""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import time
from importlib.util import find_spec
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from robust_instant_policy.errors import MissingExtraError, RobotError
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.state import ArmState, Command
from robust_instant_policy.robots.cell import Section

if find_spec("rtde_control") is None:
    if sys.version_info >= (3, 13):
        raise RobotError("ur_rtde has no release for Python 3.13; use Python 3.11 or 3.12 for UR arms")
    raise MissingExtraError("ur-rtde", "robots")

CONNECTING_S, STARTING_S = 30.0, 8.0  # for the process and its connections; for the controller's script
STOPPING_S = 1.0  # after which the process is ended, and the controller's watchdog stops the arm
ENDING_S = 3.0  # for the process to disconnect
MARGIN_S = 0.01  # of an answer after the gripper's
LATENCY_S = 0.1  # of a state: servoJ looks ahead, and both ways of RTDE have a period
GRIPPER_TIMEOUT_S = 0.09
GRIPPER_FORCE = 100  # of 255


def make(arm: Arm, section: Section, rate_hz: float) -> UR:
    """Options: ``address`` of the controller; ``gripper_force``, 0 to 255; ``timeout_s`` of the gripper; ``latency_s``
    by which states may trail commands."""
    address = section.text("address")
    force = section.whole("gripper_force", GRIPPER_FORCE, most=255)
    timeout_s = section.number("timeout_s", GRIPPER_TIMEOUT_S, 0.01, 10.0)
    latency_s = section.number("latency_s", LATENCY_S, 0.0, 1.0)
    return UR(arm.name, address, (arm.finger_travel, force, timeout_s), 1 / rate_hz, latency_s)


class UR:
    """See `robots.follower.Follower`. ``gripper`` is its travel, metres, its force, 0 to 255, and its timeout, s."""

    def __init__(self, name: str, address: str, gripper: tuple[float, int, float], step_s: float, latency_s: float):
        self.name, self._address, self._latency_s = name, address, latency_s
        self._gripper, self._step_s = gripper, step_s
        self._timeout_s = gripper[-1] + MARGIN_S
        self._process: subprocess.Popen | None = None
        self._serving, self._number = False, 0

    def connect(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            options = json.dumps([theirs.fileno(), self.name, self._address, self._step_s, self._gripper])
            self._process = subprocess.Popen(
                [sys.executable, "-m", "robust_instant_policy.robots.rtde", options],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,  # the library's own words
                pass_fds=[theirs.fileno()],
                start_new_session=True,  # Ctrl-C is this process's
            )
        self._wire = Connection(ours.detach())
        try:
            self._ask(CONNECTING_S, "connect")
        except RobotError:
            self.disconnect()
            raise

    def state(self) -> ArmState:
        joints, speeds, travel, load, clock, faults = self._ask(self._timeout_s, "state")
        return ArmState(np.array(joints), np.array(speeds), travel, load, clock, tuple(faults), self._latency_s)

    def command(self, command: Command) -> None:
        if not self._serving:
            self._serving = True
            self._ask(STARTING_S, "start")
        self._ask(self._timeout_s, "command", command.joints.tolist(), command.finger_travel)

    def stop(self) -> None:
        if self._serving:
            self._serving = False
            try:
                self._ask(STOPPING_S + self._timeout_s, "stop")
            except RobotError:
                self._end(0.0)

    def disconnect(self) -> None:
        self.stop()
        self._end(ENDING_S)

    def _ask(self, seconds: float, request: str, *arguments: object) -> Any:
        """The result of a request; raises `RobotError` for an error, and for an answer that does not come in time."""
        if self._process is None:
            raise RobotError(f"{self.name} is not connected")
        self._number += 1
        end = time.monotonic() + seconds
        try:
            self._wire.send_bytes(json.dumps([self._number, request, *arguments]).encode())
            while self._wire.poll(max(end - time.monotonic(), 0.0)):
                number, result, error = json.loads(self._wire.recv_bytes())
                if number < self._number:
                    continue  # it came too late
                if error:
                    raise RobotError(error)
                return result
        except (EOFError, OSError):
            raise RobotError(
                f"{self.name}: the connection to {self._address} was lost, and the UR library with it; check the "
                "network cable"
            ) from None
        raise RobotError(
            f"{self.name}: the controller at {self._address} does not answer within {seconds:.2g} s; check the network "
            "cable"
        )

    def _end(self, seconds: float) -> None:
        """Let the process disconnect for so long."""
        if self._process is not None:
            self._wire.close()  # it ends then
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(seconds)
            self._process.kill()
            self._process.wait()
            self._process = None
