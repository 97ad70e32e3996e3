"""The last check before a command leaves, and the watch over what the arms measure.

Everything that moves an arm goes through a `Gate`: executed plans (`admit` refuses) and a person's leader (`limited`
slows down). `judge` looks at the measured states.
"""

import math
import time
from collections import deque
from collections.abc import Sequence

import numpy as np

from robust_instant_policy.errors import StoppedError, UnreachableError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.guard import ROUNDING_M, Space, check_joint_range
from robust_instant_policy.motion.limits import Limits, exceeded
from robust_instant_policy.motion.state import ArmState, Command, is_gripping

TOLERANCE = 1.05  # of speeds and accelerations that were planned at the limit
STALE_S = 0.06  # without a new reading; arms must stop within 0.1 s, and it is seen up to a control step later
SLOW_RAD_S, HELD_SHARE, HELD_S = 0.3, 1 / 3, 0.5  # a joint that is slow must be this near, after this time
BLOCKED_S = 1.5  # that a gripper may take to open
BLOCKED_SHARE = 0.3  # of its travel that it may lack then
SHARES = (1.0, 0.5, 0.25, 0.1)  # of the way from braking to the wanted step, tried where a limit is near
KEPT = 1000  # last commands, with which a state of some time ago can be compared
STOPPING_ROWS = 4  # of the way to rest after a step, that are checked


class Gate:
    """Checks commands for A arms at ``rate_hz``, and their states.

    `start` must be called with measured states before the first command. A state is stale when its clock stands still
    for ``stale_s`` seconds. A change of the system's time has no effect.
    """

    def __init__(self, arms: Sequence[Arm], limits: Limits, rate_hz: float, stale_s: float = STALE_S):
        self._stale_s = stale_s
        self._arms, self._limits, self._rate = arms, limits, rate_hz
        self._space = Space(arms, limits)
        self._speed = np.array([arm.joint_speed for arm in arms])[:, None] / rate_hz
        self._acceleration = np.array([arm.joint_acceleration for arm in arms])[:, None] / rate_hz**2
        self._tool = np.array([arm.tool_speed for arm in arms]) / rate_hz
        self._fingers = np.array([arm.finger_speed for arm in arms]) / rate_hz
        self._last: list[Command] = []
        self._sent: deque[FloatArray] = deque(maxlen=KEPT)

    def start(self, states: Sequence[ArmState]) -> None:
        """Take the measured joints as the last command; raises `StoppedError` if the arms are not ready.

        A gripper whose command was to close, or that presses on something, keeps the command to close: a command of the
        measured width would end its force.
        """
        now = time.monotonic()
        self._clocks, self._fresh, self._opening = [-math.inf] * len(states), [now] * len(states), [0] * len(states)
        before = [command.finger_travel for command in self._last] or [arm.finger_travel for arm in self._arms]
        self._last = [
            Command(state.joints, 0.0 if told <= 0.0 or is_gripping(state, arm.finger_travel) else state.finger_travel)
            for arm, state, told in zip(self._arms, states, before, strict=True)
        ]
        self._change = np.zeros((len(states), len(states[0].joints)))
        self._held = np.zeros_like(self._change)
        self._sent = deque([np.stack([state.joints for state in states])], KEPT)
        self.judge(states)

    @property
    def last(self) -> Sequence[Command]:
        """The last command of each arm."""
        return self._last

    def admit(self, commands: Sequence[Command]) -> Sequence[Command]:
        """Return ``commands``; raises `UnreachableError` if one is not a number, out of range, too fast or a jump."""
        joints = np.stack([command.joints for command in commands])
        fingers = np.array([command.finger_travel for command in commands])
        last = np.stack([command.joints for command in self._last])
        change = joints - last
        opening = fingers - [command.finger_travel for command in self._last]
        for index, arm in enumerate(self._arms):
            if not (np.isfinite(joints[index]).all() and np.isfinite(fingers[index])):
                raise UnreachableError(f"{arm.name}: a command is not a number; nothing was sent")
            if not -ROUNDING_M <= fingers[index] <= arm.finger_travel + ROUNDING_M:
                what = "the fingers are told to open by"
                raise UnreachableError(exceeded(arm.name, what, fingers[index], arm.finger_travel, "m", "gripper"))
            check_joint_range(joints[index : index + 1], arm, self._rate)
            moved = self._moved(index, last, change)
            for values, limit, order, what, unit, key in (
                (change[index], arm.joint_speed, 1, "a joint is told to move at", "rad/s", "joint_speed"),
                (change[index] - self._change[index], arm.joint_acceleration, 2, "a joint is told to accelerate by",
                 "rad/s²", "joint_acceleration"),
                (moved, arm.tool_speed, 1, "its tool is told to move at", "m/s", "tool_speed"),
                (opening[index], arm.finger_speed, 1, "a finger is told to move at", "m/s", "gripper"),
            ):  # fmt: skip
                value = float(np.abs(values).max()) * self._rate**order
                if value > limit * TOLERANCE:
                    raise UnreachableError(exceeded(arm.name, what, value, limit, unit, key))
        self._take(commands, change)
        return commands

    def limited(self, wanted: Sequence[Command]) -> list[Command]:
        """What the arms may do towards ``wanted``: within speeds, accelerations and ranges, or not at all.

        Where the next step, or coming to rest after it, would bring a tool out of the workspace or a link to the table,
        to another link or to the other arm, all arms brake. A tool that is outside the workspace comes nearer to it or
        stays.
        """
        last = np.stack([command.joints for command in self._last])
        joints = np.stack([command.joints for command in wanted])
        fingers = np.array([command.finger_travel for command in wanted])
        if not (np.isfinite(joints).all() and np.isfinite(fingers).all()):
            raise StoppedError("a leader reports positions that are not numbers; check its cables and calibration")
        low, high = np.stack([arm.kinematics.joint_range for arm in self._arms]).transpose(2, 0, 1)
        change = _braked(joints.clip(low, high) - last, self._change, self._speed, self._acceleration)
        change = self._nearer(last, self._within_tool_speed(last, change))
        travel = np.array([arm.finger_travel for arm in self._arms])
        before = np.array([command.finger_travel for command in self._last])
        fingers = before + np.clip(fingers.clip(0.0, travel) - before, -self._fingers, self._fingers)
        commands = [Command(row, float(opening)) for row, opening in zip(last + change, fingers, strict=True)]
        self._take(commands, change)
        return commands

    def _take(self, commands: Sequence[Command], change: FloatArray) -> None:
        """``commands`` are the last ones, ``change (A, J)`` of joints after those before."""
        self._last, self._change = list(commands), change
        self._sent.append(np.stack([command.joints for command in commands]))

    def _moved(self, index: int, last: FloatArray, change: FloatArray) -> float:
        """Metres by which a ``change (A, J)`` of the joints ``last (A, J)`` moves the tool of arm ``index``."""
        pose = self._arms[index].kinematics.tool_pose
        return float(np.linalg.norm(pose(last[index] + change[index])[:3, 3] - pose(last[index])[:3, 3]))

    def _within_tool_speed(self, last: FloatArray, change: FloatArray) -> FloatArray:
        """``change (A, J)``, nearer to that of braking where it moves a tool too fast."""
        brake, change = _slower(self._change, self._acceleration), change.copy()
        for index, most in enumerate(self._tool):
            moved = self._moved(index, last, change)
            if moved > most:
                least = self._moved(index, last, brake)
                share = max(most - least, 0.0) / (moved - least) if moved > least else 0.0
                change[index] = brake[index] + share * (change[index] - brake[index])
        return change

    def _nearer(self, last: FloatArray, change: FloatArray) -> FloatArray:
        """The largest step from that of braking towards ``change (A, J)`` from which all arms can come to rest within
        the limits of space."""
        brake = _slower(self._change, self._acceleration)
        most = self._space.outside(last[None])[0] + ROUNDING_M
        for share in SHARES:
            step = brake + share * (change - brake)
            way = last + _stopping(step, self._acceleration)
            try:
                if (self._space.outside(way) <= most).all():
                    self._space.check(way, self._rate, to_home=True, start=last)
                    return step
            except UnreachableError:
                continue
        return brake

    def judge(self, states: Sequence[ArmState]) -> None:
        """Raise `StoppedError` for states in which the arms must stop: faults, values that are no numbers, old states,
        joints far from their command, a gripper that does not open."""
        for index, (arm, state, told) in enumerate(zip(self._arms, states, self._last, strict=True)):
            if state.faults:
                raise StoppedError(f"{arm.name} reports: {'; '.join(state.faults)}")
            if not (np.isfinite(state.joints).all() and np.isfinite(state.finger_travel)):
                raise StoppedError(f"{arm.name} measures positions that are not numbers; check its cables")
            now = time.monotonic()
            if state.clock != self._clocks[index]:
                self._clocks[index], self._fresh[index] = state.clock, now
            if now - self._fresh[index] > self._stale_s:
                raise StoppedError(f"{arm.name} sends the same state for more than {self._stale_s:g} s: it is frozen")
            error = self._error(index, state)
            if error.max() > self._limits.following_error:
                joint = int(np.argmax(error))
                what = f"joint {joint + 1} is away from its command by"
                limit = self._limits.following_error
                blocked = exceeded(arm.name, what, error[joint], limit, "rad", "following_error")
                raise StoppedError(f"{blocked}; is something in its way, or is it overloaded?")
            self._hold(index, error, arm.name)
            lacks = told.finger_travel - state.finger_travel > BLOCKED_SHARE * arm.finger_travel
            self._opening[index] = self._opening[index] + 1 if lacks else 0
            if self._opening[index] > BLOCKED_S * self._rate:
                raise StoppedError(
                    f"{arm.name}: the gripper is blocked: told to open to {1e3 * told.finger_travel:.0f} mm, it stands "
                    f"at {1e3 * state.finger_travel:.0f} mm; free it and check its cable"
                )

    def _error(self, index: int, state: ArmState) -> FloatArray:
        """Differences ``(J,)`` of the measured joints from that command of the state's latency which is nearest."""
        recent = list(self._sent)[-1 - math.ceil(state.latency_s * self._rate) :]
        errors = np.abs(np.array(recent)[:, index] - state.joints)
        nearest: FloatArray = errors[errors.max(axis=1).argmin()]
        return nearest

    def _hold(self, index: int, error: FloatArray, name: str) -> None:
        """Raise `StoppedError` for a joint whose ``error (J,)`` lasts while its command hardly moves: it is held."""
        limit = HELD_SHARE * self._limits.following_error
        slow = np.abs(self._change[index]) * self._rate < SLOW_RAD_S
        self._held[index] = np.where(slow & (error > limit), self._held[index] + 1, 0)
        if self._held[index].max() > HELD_S * self._rate:
            joint = int(np.argmax(self._held[index]))
            what = f"joint {joint + 1} rests away from its command by"
            held = exceeded(name, what, error[joint], limit, "rad", "a third of following_error")
            raise StoppedError(f"{held}; is something in its way, or is it overloaded?")


def _braked(wanted: FloatArray, before: FloatArray, speed: FloatArray, acceleration: FloatArray) -> FloatArray:
    """The change ``(A, J)`` of the next step towards ``wanted``, after a step of ``before``, that can still stop there.

    ``speed`` and ``acceleration`` are limits per step. From a distance d a joint can stop if its step is at most
    sqrt(2 a d + (a / 2)²) - a / 2.
    """
    distance = np.abs(wanted)
    with np.errstate(invalid="ignore"):
        stopping = np.sqrt(2 * acceleration * distance + acceleration**2 / 4) - acceleration / 2
    most = np.fmin(np.fmin(speed, distance), np.where(np.isfinite(acceleration), stopping, np.inf))
    return np.clip(np.sign(wanted) * most, before - acceleration, before + acceleration)


def _slower(change: FloatArray, acceleration: FloatArray) -> FloatArray:
    """The change ``(A, J)`` of a step that brakes after one of ``change``; limits are per step."""
    return np.sign(change) * np.maximum(np.abs(change) - acceleration, 0.0)


def _stopping(change: FloatArray, acceleration: FloatArray) -> FloatArray:
    """Changes ``(N, A, J)`` of position, from that after a step of ``change (A, J)`` to rest, N at most
    `STOPPING_ROWS`."""
    rows, total = [change], change
    while change.any():
        change = _slower(change, acceleration)
        total = total + change
        rows.append(total)
    kept = np.unique(np.linspace(0, len(rows) - 1, STOPPING_ROWS).round().astype(int))
    return np.array(rows)[kept]
