"""The nine servos of a ViperX 300 on a pseudo-terminal, which the driver opens like a USB adapter's port."""

import contextlib
import os
import pty
import select
import threading
import time
import tty

import dynamixel_sdk
import numpy as np

from robust_instant_policy.motion.state import Command
from robust_instant_policy.robots import dynamixel as dxl
from robust_instant_policy.robots.emulation.faults import FaultSwitch
from robust_instant_policy.robots.emulation.twin import SharedTwin
from robust_instant_policy.robots.followers.viperx import (
    GRIPPER,
    GRIPPER_CLOSED_RAD,
    GRIPPER_CURRENT,
    GRIPPER_OPEN_RAD,
    JOINTS,
    SERVOS,
    SHADOWS,
)

XM540, XM430 = 1120, 1020
SMALL = (8, 9)  # IDs of the smaller servos
REGISTERS = 1024
PING, WRITE, STATUS, SYNC_READ, SYNC_WRITE = 0x01, 0x03, 0x55, 0x82, 0x83
BROADCAST = 0xFE
RANGE_ERROR, ACCESS_ERROR = 0x04, 0x07
LOCKED_BELOW = 64  # registers of the EEPROM, which cannot be written with the torque on
# The emulation shares the processor with its client: timeouts are twenty times those of real servos, the watchdog's
# a hundred times.
EMULATED_TIMEOUT_MS, WATCHDOG_UNIT_S = 600.0, 2.0
WATCHDOG_EXPIRED = 0xFF
OVERLOAD = 0x20


class ServoBus:
    """Serves Protocol 2.0 for arm ``index`` of ``twin``. See `server.Device`."""

    def __init__(self, twin: SharedTwin, index: int, finger_travel: float):
        self._twin, self._index, self._travel = twin, index, finger_travel
        self.fault = FaultSwitch()
        self._master, slave = pty.openpty()
        tty.setraw(self._master)
        tty.setraw(slave)
        self._slave = slave
        self._crc = dynamixel_sdk.PacketHandler(2.0).updateCRC
        self._memory = {servo: bytearray(REGISTERS) for servo in SERVOS}
        self._heard = time.monotonic()
        self.limp = False  # whether any servo lost its torque after it had it
        for servo in SERVOS:
            self._put(servo, dxl.MODEL, XM430 if servo in SMALL else XM540)
            self._put(servo, dxl.DRIVE_MODE, int(servo in SHADOWS))
            self._put(servo, dxl.SHADOW_ID, SHADOWS.get(servo, 255))
            self._put(servo, dxl.OPERATING_MODE, 5 if servo == GRIPPER else 3)
        self._measure()
        self._woken, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    @property
    def options(self) -> dict[str, str | float]:
        return {"port": os.ttyname(self._slave), "timeout_ms": EMULATED_TIMEOUT_MS}

    def unplug(self) -> None:
        """Pull the cable: the port is gone."""
        self.fault.set("unplugged")
        if self._thread.is_alive():
            os.write(self._wake, b"!")
            self._thread.join(1.0)

    def _serve(self) -> None:
        """Answer until the bus is unplugged. The files are closed here: another one may get their numbers at once."""
        buffer = b""
        while self._woken not in select.select([self._master, self._woken], [], [])[0]:
            buffer += os.read(self._master, 4096)
            while True:
                start = buffer.find(b"\xff\xff\xfd\x00")
                if start < 0 or len(buffer) < start + 7:
                    break
                length = int.from_bytes(buffer[start + 5 : start + 7], "little")
                packet, rest = buffer[start : start + 7 + length], buffer[start + 7 + length :]
                if len(packet) < 7 + length:
                    break
                buffer = rest
                if self._crc(0, list(packet), len(packet) - 2) == int.from_bytes(packet[-2:], "little"):
                    with contextlib.suppress(OSError):
                        self._answer(packet[4], packet[7], packet[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"))
        for file in (self._slave, self._master, self._woken, self._wake):
            os.close(file)

    def _answer(self, target: int, instruction: int, data: bytes) -> None:
        if self.fault("silent"):
            return
        self._expire_watchdog()
        self._heard = time.monotonic()
        word = int.from_bytes(data[:2], "little")
        if instruction == PING:
            for servo in self._memory if target == BROADCAST else (target,):
                self._reply(servo, bytes(self._memory[servo][:2]) + b"\x2d")
        elif instruction == SYNC_READ:
            self._measure()
            length = int.from_bytes(data[2:4], "little")
            for servo in data[4:]:
                self._reply(servo, bytes(self._memory[servo][word : word + length]))
        elif instruction == WRITE:
            self._reply(target, b"", self._write(target, word, data[2:]))
        elif instruction == SYNC_WRITE:
            length = int.from_bytes(data[2:4], "little")
            for at in range(4, len(data), length + 1):
                self._write(data[at], word, data[at + 1 : at + 1 + length])
            if word == dxl.GOAL_POSITION.address:
                self._move()

    def _reply(self, servo: int, data: bytes, error: int = 0) -> None:
        if servo not in self._memory:
            return
        error |= dxl.ALERT if self._get(servo, dxl.HARDWARE_ERROR) else 0
        body = data.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        packet = b"\xff\xff\xfd\x00" + bytes([servo]) + (len(body) + 4).to_bytes(2, "little") + bytes([STATUS, error])
        packet += body
        packet += self._crc(0, list(packet), len(packet)).to_bytes(2, "little")
        os.write(self._master, self.fault.garble(packet))

    def _write(self, servo: int, address: int, data: bytes) -> int:
        """Store a value as the servo would; returns the error of its status packet."""
        if servo not in self._memory:
            return 0
        torque = self._get(servo, dxl.TORQUE)
        if address < LOCKED_BELOW and torque:
            return ACCESS_ERROR
        if address == dxl.TORQUE.address and self._get(servo, dxl.HARDWARE_ERROR):
            return ACCESS_ERROR
        if address == dxl.GOAL_POSITION.address and self._get(servo, dxl.BUS_WATCHDOG) == WATCHDOG_EXPIRED:
            return RANGE_ERROR
        if address == dxl.GOAL_POSITION.address and not 0 <= int.from_bytes(data, "little", signed=True) < dxl.TURN:
            return RANGE_ERROR
        self.limp |= address == dxl.TORQUE.address and torque == 1 and data[0] == 0
        shadows = [shadow for shadow, first in SHADOWS.items() if first == servo and address >= LOCKED_BELOW]
        for one in (servo, *shadows):
            self._memory[one][address : address + len(data)] = data
        return 0

    def _move(self) -> None:
        """Pass the goals of the servos with torque on to the twin."""
        state = self._twin.state(self._index)
        joints = state.joints.copy()
        for place, servo in enumerate(JOINTS):
            stuck = self.fault("blocked") and place == 1
            if self._get(servo, dxl.TORQUE) and not self._get(servo, dxl.HARDWARE_ERROR) and not stuck:
                joints[place] = dxl.to_angle(np.array(self._get(servo, dxl.GOAL_POSITION)))
        goal = float(dxl.to_angle(np.array(self._get(GRIPPER, dxl.GOAL_POSITION))))
        share = (goal - GRIPPER_CLOSED_RAD) / (GRIPPER_OPEN_RAD - GRIPPER_CLOSED_RAD)
        self._twin.command(self._index, Command(joints, float(np.clip(share, 0.0, 1.0)) * self._travel))

    def _measure(self) -> None:
        """Bring the registers of the present state up to date."""
        if self.fault("overload"):
            for servo in (2, 3):
                self._put(servo, dxl.HARDWARE_ERROR, OVERLOAD)
                self._put(servo, dxl.TORQUE, 0)  # the servo's own shutdown
        if self.fault("frozen"):
            return
        state = self._twin.state(self._index)
        share = state.finger_travel / self._travel
        angles = np.append(state.joints, GRIPPER_CLOSED_RAD + share * (GRIPPER_OPEN_RAD - GRIPPER_CLOSED_RAD))
        positions = dict(zip((*JOINTS, GRIPPER), dxl.to_position(angles).tolist(), strict=True))
        positions |= {shadow: positions[first] for shadow, first in SHADOWS.items()}
        tick = int(time.monotonic() * 1e3) % dxl.TICK_TURN
        for servo, position in positions.items():
            self._put(servo, dxl.PRESENT_POSITION, 2**31 - 1 if self.fault("nan") else position)
            self._put(servo, dxl.TICK, tick)
        self._put(GRIPPER, dxl.PRESENT_CURRENT, round(state.grip_load * GRIPPER_CURRENT))

    def _expire_watchdog(self) -> None:
        silence = time.monotonic() - self._heard
        for servo in SERVOS:
            units = self._get(servo, dxl.BUS_WATCHDOG)
            if 0 < units < 128 and silence > units * WATCHDOG_UNIT_S:
                self._put(servo, dxl.BUS_WATCHDOG, WATCHDOG_EXPIRED)

    def _get(self, servo: int, register: dxl.Register) -> int:
        data = self._memory[servo][register.address : register.address + register.size]
        return int.from_bytes(data, "little", signed=register.signed)

    def _put(self, servo: int, register: dxl.Register, value: int) -> None:
        data = value.to_bytes(register.size, "little", signed=register.signed)
        self._memory[servo][register.address : register.address + register.size] = data
