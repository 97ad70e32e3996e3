"""The process that talks to a UR controller through `ur_rtde`, and to a Robotiq gripper on its own port.

If a connection breaks, the library may end the whole process (an exception leaves one of its threads) or block for
minutes. So it runs in a process of its own, which the follower can end:

followers.ur ── [number, request, arguments] ──▶ this process ── RTDE, dashboard, text lines ──▶ controller, gripper
             ◀── [number, result, error] ───────

Messages are JSON. If the pipe closes, the process that commands the arm has ended: the arm is stopped. If this process
ends, the controller's own watchdog stops the arm.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

from robust_instant_policy.errors import RobotError
from robust_instant_policy.robots.priority import CONTROL, take_real_time

RECEIVE_HZ = 125.0
WATCHDOG_HZ = 10.0  # the controller stops the script when targets arrive more rarely
LOOKAHEAD_S, GAIN = 0.1, 300.0  # of servoJ, the maker's defaults
STOP_DECELERATION = 2.0  # rad/s², of stopJ
REASON_S = 0.03  # after which a state tells why a target was not taken
SCRIPT_S = 5.0  # for the script to start
END_S = 2.0  # that the library may take to stop and disconnect when the process ends
GRIPPER_PORT = 63352
VARIABLES = [
    "timestamp",
    "actual_q",
    "actual_qd",
    "robot_mode",
    "safety_status_bits",
    "robot_status_bits",
    "runtime_state",
]
SAFETY_BITS = {
    2: "protective stop; see the teach pendant for the reason, clear it there, and run again",
    4: "safeguard stop; close the safeguard and reset it",
    7: "emergency stop; release the button and switch the arm on again",
    8: "emergency stop; release the button and switch the arm on again",
    9: "violation of a safety limit; see the teach pendant",
    10: "fault of the safety system; see the teach pendant",
}


class Controller:
    """A controller and its gripper. The methods are the requests; they raise `RobotError`."""

    def __init__(self, name: str, address: str, gripper: RobotiqGripper, step_s: float):
        self._name, self._address, self._gripper, self._step = name, address, gripper, step_s
        self._receive: Any = None
        self._control: Any = None

    def connect(self) -> None:
        import rtde_control
        import rtde_receive

        self._check_dashboard()
        try:
            self._receive = rtde_receive.RTDEReceiveInterface(self._address, RECEIVE_HZ, VARIABLES)
            self._control = rtde_control.RTDEControlInterface(self._address, RECEIVE_HZ)
        except (RuntimeError, ValueError) as error:
            raise RobotError(
                f"{self._name}: the controller at {self._address} refuses RTDE: {error}; is it in remote control?"
            ) from None
        self._gripper.connect()

    def state(self) -> tuple[Sequence[float], Sequence[float], float, float, float, Sequence[str]]:
        """Joints and their speeds, the gripper's travel and load, clock and faults, as in `ArmState`."""
        receive = self._receive
        if not receive.isConnected():
            raise RobotError(f"{self._name}: the RTDE connection to {self._address} was lost; check the network cable")
        travel, load = self._gripper.read()
        return (
            receive.getActualQ(),
            receive.getActualQd(),
            travel,
            load,
            receive.getTimestamp(),
            _faults(receive.getSafetyStatusBits()),
        )

    def start(self) -> None:
        """Run the script, and its watchdog, from the first target of a motion to the stop."""
        control, end = self._control, time.monotonic() + SCRIPT_S
        if not control.isProgramRunning():
            control.reuploadScript()
        while not control.isProgramRunning():
            if time.monotonic() > end:
                raise RobotError(f"{self._name}: the control script does not start; see the teach pendant's log")
            time.sleep(0.01)
        if not control.setWatchdog(WATCHDOG_HZ):
            raise RobotError(f"{self._name}: the controller's watchdog cannot be set; see the teach pendant's log")

    def command(self, joints: list[float], finger_travel: float) -> None:
        if not self._control.servoJ(joints, 0.0, 0.0, self._step, LOOKAHEAD_S, GAIN):
            time.sleep(REASON_S)
            faults = "; ".join(_faults(self._receive.getSafetyStatusBits()))
            raise RobotError(
                f"{self._name}: the controller no longer takes targets: {faults or 'see the teach pendant'}"
            )
        self._gripper.command(finger_travel)

    def stop(self) -> None:
        """Brake, and end the script with its watchdog; the controller holds the arm."""
        control = self._control
        for call in (control.servoStop, lambda: control.stopJ(STOP_DECELERATION), control.stopScript):
            with contextlib.suppress(RuntimeError):
                call()

    def disconnect(self) -> None:
        for interface in (self._control, self._receive):
            if interface is not None:
                with contextlib.suppress(RuntimeError):
                    interface.disconnect()
        self._gripper.disconnect()

    def _check_dashboard(self) -> None:
        import dashboard_client

        dashboard = dashboard_client.DashboardClient(self._address)
        try:
            dashboard.connect(1000)
        except (RuntimeError, ValueError):
            raise RobotError(
                f"{self._name}: no controller at {self._address}; check the address on the teach pendant (Settings, "
                "System, Network) and the cable"
            ) from None
        mode, safety = dashboard.robotmode(), dashboard.safetystatus()
        dashboard.disconnect()
        if "RUNNING" not in mode:
            raise RobotError(f"{self._name}: {mode}; switch the arm on and release its brakes on the teach pendant")
        if "NORMAL" not in safety and "REDUCED" not in safety:
            raise RobotError(f"{self._name}: {safety}; clear it on the teach pendant, then run again")


def _faults(bits: int) -> tuple[str, ...]:
    return tuple(words for bit, words in SAFETY_BITS.items() if bits >> bit & 1)


class RobotiqGripper:
    """A Robotiq gripper behind the UR's controller: text lines on port 63352 (Robotiq's URCap).

    Positions are 0 (open) to 255 (closed). Raises `RobotError` when it does not answer within ``timeout_s``.
    """

    def __init__(self, address: str, travel: float, force: int, timeout_s: float):
        self._address, self._travel, self._force, self._timeout_s = address, travel, force, timeout_s
        self._socket: socket.socket | None = None
        self._told = -1

    def connect(self) -> None:
        try:
            self._socket = socket.create_connection((self._address, GRIPPER_PORT), timeout=1.0)
            self._socket.settimeout(self._timeout_s)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError:
            raise RobotError(
                f"no gripper at {self._address}:{GRIPPER_PORT}; install Robotiq's URCap and activate the gripper"
            ) from None
        if self._ask("GET STA") != ["STA 3"]:
            raise RobotError("the gripper is not activated; activate it on the teach pendant (Installation, Gripper)")

    def read(self) -> tuple[float, float]:
        """Travel of each finger in metres, and 1 where the fingers stopped at something, else 0."""
        answers = self._ask("GET POS", "GET OBJ", "GET FLT")
        try:
            position, stopped, fault = (int(line.split()[1]) for line in answers)
        except (IndexError, ValueError):
            raise RobotError(f"the gripper at {self._address} answers {answers}, not three numbers") from None
        if fault:
            raise RobotError(f"the gripper reports fault {fault}; see its manual, and activate it again")
        return (1 - position / 255) * self._travel, float(stopped in (1, 2))

    def command(self, travel: float) -> None:
        position = round(255 * (1 - min(max(travel / self._travel, 0.0), 1.0)))
        if position != self._told:
            self._ask(f"SET POS {position} SPE 255 FOR {self._force} GTO 1")
            self._told = position

    def disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _ask(self, *lines: str) -> list[str]:
        """One answer for each line."""
        if self._socket is None:
            raise RobotError("the gripper is not connected")
        try:
            self._socket.sendall("".join(f"{line}\n" for line in lines).encode())
            answers = b""
            while answers.count(b"\n") < len(lines):
                more = self._socket.recv(1024)
                if not more:
                    raise OSError("the connection was closed")
                answers += more
        except OSError as error:
            raise RobotError(f"the gripper at {self._address} does not answer ({error}); check its cable") from None
        return answers.decode(errors="replace").splitlines()


def main(pipe: int, name: str, address: str, step_s: float, gripper: tuple[float, int, float]) -> None:
    """Answer the requests that come over ``pipe``; ``gripper`` is the travel, force and timeout of its class."""
    gc.disable()
    take_real_time(CONTROL)  # the library's threads inherit it
    wire, serving = Connection(pipe), False
    controller = Controller(name, address, RobotiqGripper(address, *gripper), step_s)
    requests: dict[str, Callable[..., object]] = {
        one.__name__: one for one in (controller.connect, controller.state, controller.start, controller.command,
                                      controller.stop)
    }  # fmt: skip
    with contextlib.suppress(EOFError, OSError):
        while True:
            number, request, *arguments = json.loads(wire.recv_bytes())
            serving = request == "start" or (serving and request != "stop")
            result, words = None, ""
            try:
                result = requests[request](*arguments)
            except RobotError as error:
                words = str(error)
            except RuntimeError as error:  # of the library, also from its attempts to connect again
                words = f"{name}: the connection to {address} was lost ({error}); check the network cable"
            wire.send_bytes(json.dumps([number, result, words]).encode())
    signal.setitimer(signal.ITIMER_REAL, END_S)  # which ends this process
    if serving:
        controller.stop()
    controller.disconnect()
    os._exit(0)  # the library's destructors would connect again


if __name__ == "__main__":
    main(*json.loads(sys.argv[1]))
