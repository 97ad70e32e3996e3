"""The controller of a UR5e with a Hand-E, as `ur_rtde` and the gripper's text protocol see it.

RTDE on port 30004 (Universal Robots, "Real-Time Data Exchange guide"), the dashboard on 29999, scripts on 30001 to
30003, the gripper on 63352. The script that `ur_rtde` uploads is not interpreted: what it does with the registers is
done here. Each controller has a loopback address of its own, since the library's ports are fixed.
"""

import contextlib
import secrets
import socket
import socketserver
import struct
import threading
import time
from collections.abc import Callable

import numpy as np

from robust_instant_policy.motion.state import Command
from robust_instant_policy.robots.emulation.faults import FaultSwitch
from robust_instant_policy.robots.emulation.twin import SharedTwin

RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORTS, GRIPPER_PORT = 30004, 29999, (30001, 30002, 30003), 63352
RATE_HZ = 125.0
VERSION = (5, 11, 0, 0)

# Types of the variables for which `ur_rtde` asks, by prefix, and their formats; all others are six doubles.
TYPES = {
    "DOUBLE": ("timestamp", "output_double", "input_double"),
    "INT32": ("robot_mode", "output_int", "input_int"),
    "UINT32": ("runtime_state", "robot_status_bits", "safety_status_bits"),
}
FORMATS = {"DOUBLE": "d", "INT32": "i", "UINT32": "I", "VECTOR6D": "6d"}

# Commands of the script that `ur_rtde` uploads, in the first integer register.
SERVO_J, SET_WATCHDOG, STOP_SCRIPT = 11, 35, 255
CONTINUOUS = {24, 11, 9, 10, 6, 25, 26, 27, 38, 58, *range(66, 72)}  # not answered with "done"
READY, DONE = 1, 2
RUNNING, STOPPED = 2, 1  # runtime states
NORMAL_BIT, PROTECTIVE_BIT = 0x01, 0x04  # of the safety status
POWER_BIT, PROGRAM_BIT = 0x01, 0x02  # of the robot status
# The emulation shares the processor with its client: times are longer than a controller's.
SLACK = 100  # factor of the watchdog's time
TIMEOUT_S, LATENCY_S = 0.9, 0.1  # of the gripper's answers; of states


class Controller:
    """Serves arm ``index`` of ``twin``. See `server.Device`."""

    def __init__(self, twin: SharedTwin, index: int, finger_travel: float, pace: float):
        self._twin, self._index, self._travel, self._pace = twin, index, finger_travel, pace
        self.fault, self.limp = FaultSwitch(), False
        self._address = f"127.{64 + secrets.randbelow(128)}.{secrets.randbelow(256)}.{1 + secrets.randbelow(254)}"
        self._lock, self._start = threading.Lock(), time.monotonic()
        self._running, self._script_state, self._watchdog_s, self._heard = False, READY, 0.0, 0.0
        state = twin.state(index)
        self._joints, self._stamp = state.joints, 0.0
        self._gripper = {"ACT": 1, "GTO": 1, "STA": 3, "OBJ": 3, "FLT": 0, "SPE": 255, "FOR": 150,
                         "POS": 0, "PRE": 0}  # fmt: skip
        self._connections: set[socket.socket] = set()
        self._servers = [
            self._listen(RTDE_PORT, self._serve_rtde),
            self._listen(DASHBOARD_PORT, self._serve_dashboard),
            self._listen(GRIPPER_PORT, self._serve_gripper),
            *(self._listen(port, self._serve_script) for port in SCRIPT_PORTS),
        ]

    @property
    def options(self) -> dict[str, str | float]:
        return {"address": self._address, "timeout_s": TIMEOUT_S, "latency_s": min(self._pace * LATENCY_S, 1.0)}

    def unplug(self) -> None:
        """Pull the network cable: all connections end, and none can be made."""
        self.fault.set("unplugged")
        self._cut()
        for server in self._servers:
            server.shutdown()
            server.server_close()
        self._cut()  # what was made meanwhile

    def _cut(self) -> None:
        for connection in list(self._connections):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)

    def _listen(self, port: int, serve: Callable[[socket.socket], None]) -> socketserver.ThreadingTCPServer:
        connections = self._connections

        class Handler(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                self.request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                connections.add(self.request)
                with contextlib.suppress(OSError, EOFError):
                    serve(self.request)
                connections.discard(self.request)

        server = socketserver.ThreadingTCPServer((self._address, port), Handler)
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()
        return server

    def _serve_rtde(self, connection: socket.socket) -> None:
        outputs: list[str] = []
        inputs: list[list[str]] = []
        streaming = threading.Event()
        sending = threading.Lock()

        def send(kind: str, payload: bytes) -> None:
            with sending:
                connection.sendall(struct.pack(">HB", len(payload) + 3, ord(kind)) + payload)

        def stream() -> None:
            with contextlib.suppress(OSError):
                while streaming.is_set():
                    if not self.fault("silent"):
                        data = b"\x01" + b"".join(map(self._packed, outputs))
                        send("U", self.fault.garble(data))
                    time.sleep(1 / RATE_HZ)

        try:
            while True:
                size, kind = struct.unpack(">HB", _exactly(connection, 3))
                payload = _exactly(connection, size - 3)
                if self.fault("silent"):
                    continue
                if kind == ord("v"):
                    send("v", struct.pack(">4I", *VERSION))
                elif kind == ord("O"):
                    outputs[:] = payload[8:].decode().strip(",\0").split(",")
                    send("O", b"\x01" + ",".join(map(_type, outputs)).encode())
                elif kind == ord("I"):
                    inputs.append(payload.decode().strip(",\0").split(","))
                    send("I", bytes([len(inputs)]) + ",".join(map(_type, inputs[-1])).encode())
                elif kind == ord("S"):
                    send("S", b"\x01")
                    streaming.set()
                    threading.Thread(target=stream, daemon=True).start()
                elif kind == ord("U"):
                    self._take(inputs[payload[0] - 1], payload[1:])
                else:  # protocol version, pause, text
                    send(chr(kind), b"\x01")
        finally:
            streaming.clear()

    def _take(self, names: list[str], data: bytes) -> None:
        """Input registers arrived: what the uploaded script does with them."""
        kinds = [FORMATS[_type(name)] for name in names]
        values = struct.unpack(">" + "".join(kinds), data)
        registers = dict(zip(names, values, strict=True))
        with self._lock:
            self._heard = time.monotonic()
            command = registers.get("input_int_register_0")
            if command is None or not self._running:
                return
            self._script_state = READY if command in CONTINUOUS or command == 0 else DONE
            if command == SET_WATCHDOG:
                frequency = registers["input_double_register_0"]
                self._watchdog_s = SLACK / frequency if frequency > 0 else 0.0
            elif command == STOP_SCRIPT:
                self._running, self._watchdog_s = False, 0.0
        if command == SERVO_J and not self._protective():
            self._move(np.array([registers[f"input_double_register_{joint}"] for joint in range(6)]))

    def _move(self, joints: np.ndarray) -> None:
        state = self._twin.state(self._index)
        if self.fault("blocked"):
            joints[1] = state.joints[1]
        travel = (1 - self._gripper["PRE"] / 255) * self._travel
        self._twin.command(self._index, Command(joints, travel))

    def _packed(self, name: str) -> bytes:
        """The present value of an output variable."""
        kind = FORMATS[_type(name)]
        count = int(kind[:-1] or 1)
        with self._lock:
            if self._running and self._watchdog_s and time.monotonic() - self._heard > self._watchdog_s:
                self._running = False  # the action of the watchdog is to stop the program
            protective = self._protective()
            if protective:
                self._running = False
            if not self.fault("frozen"):
                self._joints, self._stamp = self._twin.state(self._index).joints, time.monotonic() - self._start
            values: dict[str, object] = {
                "timestamp": [self._stamp],
                "actual_q": np.full(6, np.nan) if self.fault("nan") else self._joints,
                "robot_mode": [7],
                "safety_status_bits": [PROTECTIVE_BIT if protective else NORMAL_BIT],
                "robot_status_bits": [POWER_BIT | (PROGRAM_BIT if self._running else 0)],
                "runtime_state": [RUNNING if self._running else STOPPED],
                "output_int_register_0": [self._script_state],
            }
        return struct.pack(">" + kind, *values.get(name, [0] * count))  # type: ignore[misc]

    def _protective(self) -> bool:
        return self.fault("protective-stop") or self.fault("overload")

    def _serve_script(self, connection: socket.socket) -> None:
        """A program that arrives starts to run; it ends with its last line, ``end``."""
        text = b""
        while data := connection.recv(65536):
            text += data
            if text.rstrip().endswith(b"end"):
                text = b""
                with self._lock:
                    self._running, self._script_state, self._watchdog_s = not self._protective(), READY, 0.0

    def _serve_dashboard(self, connection: socket.socket) -> None:
        connection.sendall(b"Connected: Universal Robots Dashboard Server\n")
        for line in connection.makefile("r"):
            answers = {
                "polyscopeversion": "URSoftware 5.11.0.108249 (Sep 24 2021)",
                "get serial number": "20200000000",
                "is in remote control": "true",
                "robotmode": "Robotmode: RUNNING",
                "safetystatus": f"Safetystatus: {'PROTECTIVE_STOP' if self._protective() else 'NORMAL'}",
                "running": f"Program running: {str(self._running).lower()}",
                "stop": "Stopped",
                "quit": "Disconnected",
            }
            if line.strip().lower() == "stop":
                self._running = False
            connection.sendall((answers.get(line.strip().lower(), "could not understand") + "\n").encode())

    def _serve_gripper(self, connection: socket.socket) -> None:
        for line in connection.makefile("r"):
            if self.fault("silent"):
                continue
            words = line.split()
            if words[:1] == ["GET"]:
                state = self._twin.state(self._index)
                self._gripper["POS"] = round(255 * (1 - state.finger_travel / self._travel))
                self._gripper["OBJ"] = 2 if state.grip_load > 0.5 else 3
                connection.sendall(f"{words[1]} {self._gripper.get(words[1], 0)}\n".encode())
            elif words[:1] == ["SET"]:
                for name, value in zip(words[1::2], words[2::2], strict=False):
                    self._gripper["PRE" if name == "POS" else name] = int(value)
                connection.sendall(b"ack\n")


def _type(name: str) -> str:
    return next((kind for kind, starts in TYPES.items() if name.startswith(starts)), "VECTOR6D")


def _exactly(connection: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        more = connection.recv(count - len(data))
        if not more:
            raise EOFError
        data += more
    return data
