"""A bus of Dynamixel servos (Protocol 2.0) through Robotis' own SDK.

Registers are those of the X series' control table (Robotis e-Manual, XM540-W270).
"""

import errno
import math
import termios
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robust_instant_policy.errors import RobotError, needs_extra
from robust_instant_policy.geometry import FloatArray

with needs_extra("robots"):
    import dynamixel_sdk as sdk
    import serial

TIMEOUT_MS = 30.0  # of a transaction; a USB adapter with its latency timer of 16 ms needs about 20
RETRY_TIMEOUTS = 2.1  # after so many of them no new try begins: the last one ends within 100 ms
TURN = 4096  # position units in one turn
ZERO = 2048  # position of angle 0
VELOCITY_UNIT = 0.229 * 2 * math.pi / 60  # rad/s
ALERT = 0x80  # bit of a status packet's error: the hardware error register is not 0


@dataclass(frozen=True)
class Register:
    """An entry of the control table: its address and size in bytes; ``signed`` ones are two's complement."""

    address: int
    size: int
    signed: bool = False


MODEL = Register(0, 2)
DRIVE_MODE = Register(10, 1)
OPERATING_MODE = Register(11, 1)
SHADOW_ID = Register(12, 1)
TORQUE = Register(64, 1)
HARDWARE_ERROR = Register(70, 1)
BUS_WATCHDOG = Register(98, 1)
GOAL_CURRENT = Register(102, 2, signed=True)
PROFILE_ACCELERATION = Register(108, 4)
PROFILE_VELOCITY = Register(112, 4)
GOAL_POSITION = Register(116, 4, signed=True)
TICK = Register(120, 2)  # milliseconds, wraps at 32768
PRESENT_CURRENT = Register(126, 2, signed=True)
PRESENT_VELOCITY = Register(128, 4, signed=True)
PRESENT_POSITION = Register(132, 4, signed=True)

POSITION_MODE, CURRENT_POSITION_MODE = 3, 5
TICK_TURN = 32768
MODEL_NAMES = {1020: "XM430-W350", 1030: "XM430-W210", 1060: "XL430-W250", 1120: "XM540-W270", 1130: "XM540-W150",
               1190: "XL330-M077", 1200: "XL330-M288"}  # fmt: skip
UNPLUGGED = (OSError, serial.SerialException, termios.error, TypeError)  # what pyserial raises then
HARDWARE_ERRORS = {
    0x01: "input voltage out of range; check the power supply",
    0x04: "overheated; let it cool down",
    0x08: "motor encoder fault; have it repaired",
    0x10: "electrical shock; check the cables",
    0x20: "overload; relieve the arm, then reboot the servo",
}


class Bus:
    """A serial bus; all methods raise `RobotError` when a servo does not answer within three timeouts.

    ``names`` of the servos' IDs appear in messages.
    """

    def __init__(self, port: str, baud: int, names: Mapping[int, str], timeout_ms: float = TIMEOUT_MS):
        self.port, self._baud, self._names = port, baud, dict(names)
        self._port, self._timeout_ms = _MonotonicPort(port), timeout_ms
        self._port.timeout_ms = timeout_ms
        self._packets = sdk.PacketHandler(2.0)

    def open(self) -> None:
        try:
            if not self._port.setBaudRate(self._baud):
                raise RobotError(f"{self.port}: {self._baud} baud is not a rate of these servos")
            self._port.ser.timeout = 0.002  # sleep while waiting for bytes
            self._port.ser.exclusive = True  # two programs must not command one arm
        except (OSError, serial.SerialException) as error:
            self.close()
            raise RobotError(f"cannot open {self.port}: {_hint(self.port, error)}") from None

    def close(self) -> None:
        if self._port.is_open:
            self._port.closePort()

    def ping(self, servo: int) -> int | None:
        """The model number of a servo, None if none answers."""
        model, result, _ = self._call(lambda: self._packets.ping(self._port, servo))
        return int(model) if result == sdk.COMM_SUCCESS else None

    def read(self, servo: int, register: Register) -> int:
        return int(self.sync_read([servo], register)[0, 0])

    def write(self, servo: int, register: Register, value: int) -> None:
        """Write and wait for the servo's answer; raises `RobotError` where it refuses the value."""
        data = list((value & ((1 << 8 * register.size) - 1)).to_bytes(register.size, "little"))

        def transaction() -> tuple[int, int, int]:
            result, error = self._packets.writeTxRx(self._port, servo, register.address, register.size, data)
            return error, result, servo

        error = self._repeated(transaction)
        if error & ~ALERT:
            words = self._packets.getRxPacketError(error)
            raise RobotError(
                f"{self.port}: {self._name(servo)} refuses a value of register {register.address}: {words}"
            )

    def sync_read(self, servos: Sequence[int], *registers: Register) -> np.ndarray:
        """Values ``(S, R)`` int64 of one block of ``registers``, in the order of their addresses, of all ``servos``."""
        start, last = registers[0], registers[-1]
        length = last.address + last.size - start.address
        rows = self._repeated(lambda: self._read_all(servos, start.address, length))
        return np.array(
            [
                [
                    int.from_bytes(row[at : at + one.size], "little", signed=one.signed)
                    for one in registers
                    for at in [one.address - start.address]
                ]
                for row in rows
            ]
        )

    def sync_write(self, servos: Sequence[int], register: Register, values: Sequence[int]) -> None:
        """Write to all ``servos`` in one packet, which none answers."""
        data: list[int] = []
        for servo, value in zip(servos, values, strict=True):
            data += [servo, *int(value).to_bytes(register.size, "little", signed=register.signed)]
        self._call(lambda: self._packets.syncWriteTxOnly(self._port, register.address, register.size, data, len(data)))

    def hardware_errors(self, servos: Sequence[int]) -> list[str]:
        """What the servos' error registers say, one line each."""
        lines = []
        for servo, (bits,) in zip(servos, self.sync_read(servos, HARDWARE_ERROR), strict=True):
            lines += [f"{self._name(servo)}: {words}" for bit, words in HARDWARE_ERRORS.items() if bits & bit]
        return lines

    def _read_all(self, servos: Sequence[int], address: int, length: int) -> tuple[list[bytes], int, int]:
        """The answers, the result, and the servo that it is about."""
        rows: list[bytes] = []
        result = self._packets.syncReadTx(self._port, address, length, list(servos), len(servos), False)
        for servo in servos:
            data = []
            if result == sdk.COMM_SUCCESS:
                data, result, _ = self._packets.readRx(self._port, servo, length)
                if result == sdk.COMM_SUCCESS and len(data) != length:
                    result = sdk.COMM_RX_CORRUPT
            if result != sdk.COMM_SUCCESS:
                break
            rows.append(bytes(data))
        return rows, result, servo

    def _repeated(self, transaction: Callable[[], tuple[Any, int, int]]) -> Any:
        """What a transaction returns, tried again while there is time; it returns a value, a result, and a servo."""
        start = time.monotonic()
        while True:
            value, result, servo = self._call(transaction)
            if result == sdk.COMM_SUCCESS:
                return value
            if (time.monotonic() - start) * 1e3 > RETRY_TIMEOUTS * self._timeout_ms:
                damaged = result == sdk.COMM_RX_CORRUPT
                what = "answers with damaged packets" if damaged else "does not answer"
                name = self._name(servo)
                raise RobotError(
                    f"{self.port}: {name} {what}; check its cable, the power supply, and that no other program uses "
                    "the port"
                )

    def _call(self, transaction: Callable):
        """A transaction with the SDK; a port that was unplugged raises `RobotError`."""
        if not self._port.is_open:
            raise RobotError(f"{self.port} is not open; connect first")
        try:
            self._port.is_using = False  # a transaction that raised left it set
            return transaction()
        except UNPLUGGED as error:
            raise RobotError(f"{self.port} was unplugged ({error}); plug it in and run again") from None

    def _name(self, servo: int) -> str:
        return f"servo {servo} ({self._names[servo]})" if servo in self._names else f"servo {servo}"


class _MonotonicPort(sdk.PortHandler):
    """The SDK's port with timeouts that a change of the system's clock does not touch."""

    timeout_ms = TIMEOUT_MS

    def getCurrentTime(self) -> float:
        return time.monotonic() * 1e3

    def setPacketTimeout(self, packet_length: int) -> None:
        self.setPacketTimeoutMillis(self.timeout_ms)


def to_angle(position: np.ndarray) -> FloatArray:
    """Position units as radians, 0 in the middle of a turn."""
    return (np.asarray(position, dtype=np.float64) - ZERO) * (2 * math.pi / TURN)


def to_position(angle: FloatArray) -> np.ndarray:
    """Radians as whole position units."""
    return np.rint(np.asarray(angle) * (TURN / (2 * math.pi)) + ZERO).astype(np.int64)


def _hint(port: str, error: Exception) -> str:
    if getattr(error, "errno", None) == errno.EACCES:
        return "no permission; add yourself to the group dialout (sudo usermod -aG dialout $USER) and log in again"
    if getattr(error, "errno", None) == errno.EWOULDBLOCK:
        return "another program uses it; end that one and run again"
    if getattr(error, "errno", None) == errno.ENOENT:
        return "it is not there; plug in the USB adapter, and see which ports exist with: ls /dev/serial/by-id"
    return str(error)
