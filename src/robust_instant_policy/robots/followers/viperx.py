"""ALOHA's follower: a ViperX 300 with nine Dynamixel servos on one serial bus.

Shoulder and elbow have two servos each; the second ("shadow") listens to the commands of the first and turns the other
way. Joints are in position mode; the gripper is in current-based position mode, so that it holds with a limited force.
"""

from __future__ import annotations

import contextlib

import numpy as np

from robust_instant_policy.errors import RobotError
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.state import ArmState, Command
from robust_instant_policy.robots import dynamixel as dxl
from robust_instant_policy.robots.cell import Section

# IDs as Trossen Robotics ships the arm.
SERVOS = {
    1: "waist", 2: "shoulder", 3: "shoulder shadow", 4: "elbow", 5: "elbow shadow", 6: "forearm roll",
    7: "wrist angle", 8: "wrist rotate", 9: "gripper",
}  # fmt: skip
JOINTS, SHADOWS, GRIPPER = (1, 2, 4, 6, 7, 8), {3: 2, 5: 4}, 9
ALL = (*JOINTS, GRIPPER)
MODEL_NUMBERS = {1120: "XM540-W270", 1020: "XM430-W350"}
REVERSED = 0x01  # bit of the drive mode

# Angles of the gripper's servo (ALOHA's constants of its follower arms).
GRIPPER_OPEN_RAD, GRIPPER_CLOSED_RAD = 1.4910, -0.6213
GRIPPER_CURRENT = 200  # of the goal current, units of 2.69 mA: about the 25 N with which the simulated gripper holds
MOST_CURRENT = 1193  # the XM430's own limit
MIN_GRIP_RAD = 0.1  # between the angles of the open and the closed gripper
WATCHDOG = 5  # units of 20 ms: servos that hear nothing for 100 ms stop where they are
ERROR_EVERY = 5  # states between two readings of the hardware error registers
BAUD = 1_000_000
HELD_BACK_RAD = 0.1, 0.6  # between goal and position of an arm in whose way something is; more is a wrong reading


def make(arm: Arm, section: Section, rate_hz: float) -> ViperX:
    """Options: ``port``, ``baud``, ``timeout_ms``, ``gripper_current``, ``gripper_open``, ``gripper_closed`` (rad)."""
    bus = dxl.Bus(
        section.text("port"),
        section.whole("baud", BAUD, least=1),
        SERVOS,
        section.number("timeout_ms", dxl.TIMEOUT_MS, 1.0, 1e3),
    )
    current = section.whole("gripper_current", GRIPPER_CURRENT, least=1, most=MOST_CURRENT)
    closed = section.number("gripper_closed", GRIPPER_CLOSED_RAD, -np.pi, np.pi)
    opened = section.number("gripper_open", GRIPPER_OPEN_RAD, -np.pi, np.pi)
    if abs(opened - closed) < MIN_GRIP_RAD:
        raise section.error("gripper_open", f"must be another angle than gripper_closed, {closed:g}")
    return ViperX(arm.name, bus, arm.finger_travel, current, closed, opened)


class ViperX:
    """See `robots.follower.Follower`."""

    def __init__(
        self, name: str, bus: dxl.Bus, finger_travel: float, gripper_current: int, closed: float, opened: float
    ):
        self.name, self._bus = name, bus
        self._travel, self._current, self._closed, self._open = finger_travel, gripper_current, closed, opened
        self._readings, self._clock = 0, 0.0
        self._faults: tuple[str, ...] = ()
        self._tick: int | None = None
        self._watched = False

    def connect(self) -> None:
        self._bus.open()
        try:
            self._check_servos()
            self._set_up()
        except RobotError:
            self._bus.close()
            raise

    def state(self) -> ArmState:
        values = self._bus.sync_read(ALL, dxl.TICK, dxl.PRESENT_CURRENT, dxl.PRESENT_VELOCITY, dxl.PRESENT_POSITION)
        if self._readings % ERROR_EVERY == 0:
            self._faults = tuple(self._bus.hardware_errors(tuple(SERVOS)))
        self._readings += 1
        tick = int(values[0, 0])
        self._clock += 0.0 if self._tick is None else (tick - self._tick) % dxl.TICK_TURN * 1e-3
        self._tick = tick
        angles = dxl.to_angle(values[:, 3])
        return ArmState(
            joints=angles[:-1],
            speeds=values[:-1, 2] * dxl.VELOCITY_UNIT,
            finger_travel=float((angles[-1] - self._closed) / (self._open - self._closed) * self._travel),
            grip_load=min(abs(float(values[-1, 1])) / self._current, 1.0),
            clock=self._clock,
            faults=self._faults,
        )

    def command(self, command: Command) -> None:
        if not self._watched:
            self._bus.sync_write(ALL, dxl.BUS_WATCHDOG, [WATCHDOG] * len(ALL))
            self._watched = True
        gripper = self._closed + (self._open - self._closed) * command.finger_travel / self._travel
        goals = dxl.to_position(np.append(command.joints, gripper))
        self._bus.sync_write(ALL, dxl.GOAL_POSITION, goals.tolist())

    def stop(self) -> None:
        # The servos hold their last goal, one step ahead of where they are. Where something holds an arm back, its
        # present position becomes the goal, so that it does not push on; a frozen or impossible reading is not used.
        with contextlib.suppress(RobotError):
            self._unwatch()
            goals, ticks, positions = self._bus.sync_read(JOINTS, dxl.GOAL_POSITION, dxl.TICK, dxl.PRESENT_POSITION).T
            away = np.abs(positions - goals).max() * 2 * np.pi / dxl.TURN
            if ticks[0] != self._tick and HELD_BACK_RAD[0] < away < HELD_BACK_RAD[1]:
                self._bus.sync_write(JOINTS, dxl.GOAL_POSITION, positions.tolist())

    def disconnect(self) -> None:
        self.stop()
        self._bus.close()

    def _unwatch(self) -> None:
        """Switch the watchdog off, which also frees servos that it stopped."""
        self._bus.sync_write(ALL, dxl.BUS_WATCHDOG, [0] * len(ALL))
        self._watched = False

    def _check_servos(self) -> None:
        missing = []
        for servo, name in SERVOS.items():
            model = self._bus.ping(servo)
            if model is None:
                missing.append(f"{servo} ({name})")
            elif model not in MODEL_NUMBERS:
                found = dxl.MODEL_NAMES.get(model, f"model {model}")
                raise RobotError(f"{self._bus.port}: servo {servo} ({name}) is a {found}; is it another arm's port?")
        if missing:
            raise RobotError(
                f"{self._bus.port}: no answer from servo {', '.join(missing)}; check power, cables, and the baud rate"
            )
        errors = self._bus.hardware_errors(tuple(SERVOS))
        if errors:
            raise RobotError(f"{self._bus.port}: {'; '.join(errors)}")

    def _set_up(self) -> None:
        """Operating modes, shadows and limits as ALOHA has them, then torque, with the present position as the goal.

        A servo that is already set up is left as it is: its torque would have to be switched off.
        """
        bus = self._bus
        for shadow, first in SHADOWS.items():
            if bus.read(shadow, dxl.SHADOW_ID) != first:
                self._change(shadow, dxl.SHADOW_ID, first)
            if bus.read(shadow, dxl.DRIVE_MODE) & REVERSED == bus.read(first, dxl.DRIVE_MODE) & REVERSED:
                raise RobotError(
                    f"{bus.port}: servos {first} and {shadow} turn the same way and would work against each other; set "
                    "the drive mode of one of them to reverse with Dynamixel Wizard"
                )
        for servo in ALL:
            mode = dxl.CURRENT_POSITION_MODE if servo == GRIPPER else dxl.POSITION_MODE
            if bus.read(servo, dxl.OPERATING_MODE) != mode:
                self._change(servo, dxl.OPERATING_MODE, mode)
        self._unwatch()
        bus.write(GRIPPER, dxl.GOAL_CURRENT, self._current)
        for servo in ALL:
            bus.write(servo, dxl.PROFILE_VELOCITY, 0)  # the commands themselves are smooth
            bus.write(servo, dxl.PROFILE_ACCELERATION, 0)
        # A gripper that holds something presses towards its goal: the present position would end its force.
        servos = JOINTS if bus.read(GRIPPER, dxl.TORQUE) else ALL
        positions = bus.sync_read(servos, dxl.PRESENT_POSITION)[:, 0]
        bus.sync_write(servos, dxl.GOAL_POSITION, positions.tolist())
        for servo in SERVOS:
            bus.write(servo, dxl.TORQUE, 1)

    def _change(self, servo: int, register: dxl.Register, value: int) -> None:
        """Write to a register that is locked while the torque is on. Refused where an arm would fall."""
        if self._bus.read(servo, dxl.TORQUE):
            raise RobotError(
                f"{self._bus.port}: servo {servo} ({SERVOS[servo]}) is set up for something else and holds the arm; "
                "put the arm into its rest pose, switch its power off and on, and run again"
            )
        self._bus.write(servo, register, value)
