"""A UR5e (or another e-Series arm) through `ur_rtde`, with a Robotiq gripper on its own port.

The library uploads a script to the controller and sends it targets over RTDE. The controller's own watchdog stops the
script when no target arrives for 100 ms; its safety system stays in charge at all times.
"""

from __future__ import annotations

import contextlib
import ctypes
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np

from robust_instant_policy.errors import MissingExtraError, RobotError
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.state import ArmState, Command
from robust_instant_policy.robots.cell import Section
from robust_instant_policy.robots.priority import CONTROL, real_time

try:
    import dashboard_client
    import rtde_control
    import rtde_receive
except ModuleNotFoundError as error:
    if sys.version_info >= (3, 13):
        raise RobotError("ur_rtde has no release for Python 3.13; use Python 3.11 or 3.12 for UR arms") from None
    raise MissingExtraError(error.name or "ur-rtde", "robots") from error

RECEIVE_HZ = 125.0
WATCHDOG_HZ = 10.0  # the controller stops the script when targets arrive more rarely
LOOKAHEAD_S, GAIN = 0.1, 300.0  # of servoJ, the maker's defaults
STOP_DECELERATION = 2.0  # rad/s², of stopJ
SCRIPT_SECONDS = 5.0  # for the script to start
STOP_SECONDS, DISCONNECT_SECONDS = 0.5, 2.0  # that the library may take
LATENCY_S = 0.1  # of a state: servoJ looks ahead, and both ways of RTDE have a period
GRIPPER_PORT, GRIPPER_TIMEOUT_S = 63352, 0.09
GRIPPER_FORCE = 100  # of 255
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


def make(arm: Arm, section: Section, rate_hz: float) -> UR:
    """Options: ``address`` of the controller; ``gripper_force``, 0 to 255; ``timeout_s`` of the gripper; ``latency_s``
    by which states may trail commands."""
    address = section.text("address")
    gripper = RobotiqGripper(
        address,
        arm.finger_travel,
        section.whole("gripper_force", GRIPPER_FORCE),
        section.number("timeout_s", GRIPPER_TIMEOUT_S, 0.01, 10.0),
    )
    return UR(arm.name, address, gripper, rate_hz, section.number("latency_s", LATENCY_S, 0.0, 1.0))


class UR:
    """See `robots.follower.Follower`."""

    def __init__(self, name: str, address: str, gripper: RobotiqGripper, rate_hz: float, latency_s: float):
        self.name, self._address, self._step, self._latency_s = name, address, 1 / rate_hz, latency_s
        self._gripper = gripper
        self._receive = self._control = None
        self._serving = False

    def connect(self) -> None:
        try:
            self._check_dashboard()
            with real_time(CONTROL):  # the library's threads, which would be late on a busy computer, inherit it
                self._receive = rtde_receive.RTDEReceiveInterface(self._address, RECEIVE_HZ, VARIABLES)
                self._control = rtde_control.RTDEControlInterface(self._address, RECEIVE_HZ)
            self._gripper.connect()
        except RobotError:
            self.disconnect()
            raise
        except (RuntimeError, ValueError) as error:
            self.disconnect()
            raise RobotError(
                f"{self.name}: the controller at {self._address} refuses RTDE: {error}; is it in remote control?"
            ) from None

    def state(self) -> ArmState:
        with self._errors():
            return self._state(self._require(self._receive))

    def command(self, command: Command) -> None:
        with self._errors():
            self._command(self._require(self._control), command)

    def _state(self, receive: rtde_receive.RTDEReceiveInterface) -> ArmState:
        if not receive.isConnected():
            raise RobotError(f"{self.name}: the RTDE connection to {self._address} was lost; check the network cable")
        travel, load = self._gripper.read()
        bits = receive.getSafetyStatusBits()
        return ArmState(
            joints=np.array(receive.getActualQ()),
            speeds=np.array(receive.getActualQd()),
            finger_travel=travel,
            grip_load=load,
            clock=receive.getTimestamp(),
            faults=_faults(bits),
            latency_s=self._latency_s,
        )

    def _command(self, control: rtde_control.RTDEControlInterface, command: Command) -> None:
        if not self._serving:
            self._start(control)
        if not control.servoJ(command.joints.tolist(), 0.0, 0.0, self._step, LOOKAHEAD_S, GAIN):
            faults = "; ".join(_faults(self._require(self._receive).getSafetyStatusBits()))
            raise RobotError(
                f"{self.name}: the controller no longer takes targets: {faults or 'see the teach pendant'}"
            )
        self._gripper.command(command.finger_travel)

    def stop(self) -> None:
        if self._control is None or not self._serving:
            return
        self._serving = False
        # Ending the script ends its watchdog, too; the controller holds the arm. Over a dead connection nothing ends,
        # and the watchdog stops the script.
        control = self._control
        for call in (control.servoStop, lambda: control.stopJ(STOP_DECELERATION), control.stopScript):
            if _bounded(call, STOP_SECONDS) is None:
                return

    def disconnect(self) -> None:
        self.stop()
        for interface in (self._control, self._receive):
            if interface is not None and not _bounded(interface.disconnect, DISCONNECT_SECONDS):
                # The destructor would do the same again, and end the whole process where the connection was lost.
                ctypes.pythonapi.Py_IncRef(ctypes.py_object(interface))
        self._control = self._receive = None
        self._gripper.disconnect()

    def _start(self, control: rtde_control.RTDEControlInterface) -> None:
        """Run the script, and its watchdog, from the first target of a motion to the stop."""
        end = time.monotonic() + SCRIPT_SECONDS
        if not control.isProgramRunning():
            control.reuploadScript()
        while not control.isProgramRunning():
            if time.monotonic() > end:
                raise RobotError(f"{self.name}: the control script does not start; see the teach pendant's log")
            time.sleep(0.01)
        if not control.setWatchdog(WATCHDOG_HZ):
            raise RobotError(f"{self.name}: the controller's watchdog cannot be set; see the teach pendant's log")
        self._serving = True

    def _check_dashboard(self) -> None:
        dashboard = dashboard_client.DashboardClient(self._address)
        try:
            dashboard.connect(1000)
        except (RuntimeError, ValueError):
            raise RobotError(
                f"{self.name}: no controller at {self._address}; check the address on the teach pendant (Settings, "
                "System, Network) and the cable"
            ) from None
        mode, safety = dashboard.robotmode(), dashboard.safetystatus()
        dashboard.disconnect()
        if "RUNNING" not in mode:
            raise RobotError(f"{self.name}: {mode}; switch the arm on and release its brakes on the teach pendant")
        if "NORMAL" not in safety and "REDUCED" not in safety:
            raise RobotError(f"{self.name}: {safety}; clear it on the teach pendant, then run again")

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        """The library raises std::exception, also from its attempts to connect again; it becomes RuntimeError."""
        try:
            yield
        except RuntimeError as error:
            raise RobotError(
                f"{self.name}: the connection to {self._address} was lost ({error}); check the network cable"
            ) from None

    def _require(self, interface):
        if interface is None:
            raise RobotError(f"{self.name} is not connected")
        return interface


def _faults(bits: int) -> tuple[str, ...]:
    return tuple(words for bit, words in SAFETY_BITS.items() if bits >> bit & 1)


def _bounded(call: Callable[[], object], seconds: float) -> bool | None:
    """Whether ``call`` succeeded, None if it did not come back in time: the library may wait for minutes on a
    connection that is dead."""
    succeeded = []

    def run() -> None:
        with contextlib.suppress(RuntimeError):
            call()
            succeeded.append(True)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(seconds)
    return None if thread.is_alive() else bool(succeeded)


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
        position = round(255 * (1 - np.clip(travel / self._travel, 0.0, 1.0)))
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
