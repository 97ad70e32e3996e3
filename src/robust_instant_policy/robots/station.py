"""The arms of a cell behind one gate, and the loop that moves them.

        ┌──────────── every 1 / rate_hz ────────────┐
states ─▶ Gate.judge ─▶ next command ─▶ Gate.admit ─▶ followers
             │                              │
             └──── StoppedError, RobotError ┴──▶ all followers stop and hold
"""

from __future__ import annotations

import contextlib
import gc
import time
from collections.abc import Callable, Sequence
from types import TracebackType

import numpy as np

from robust_instant_policy.errors import StoppedError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.arm import Motion
from robust_instant_policy.motion.gate import Gate
from robust_instant_policy.motion.state import ArmState, Command
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.follower import Follower
from robust_instant_policy.robots.followers import make_follower
from robust_instant_policy.robots.models import arm_of
from robust_instant_policy.robots.path import MeasuredPath
from robust_instant_policy.robots.signals import StopRequest

BRAKING_STEPS = 12  # control steps in which a motion that goes well is brought to rest


class Ticker:
    """Absolute deadlines at a rate, on a clock that a change of the system's time does not touch."""

    def __init__(self, rate_hz: float):
        self._period = 1 / rate_hz
        self._next = time.monotonic()

    def wait(self) -> float:
        """Sleep until the next deadline and return the time, seconds. A missed deadline is not caught up with."""
        self._next += self._period
        now = time.monotonic()
        if self._next > now:
            time.sleep(self._next - now)
            return time.monotonic()
        self._next = now
        return now


class Station:
    """The arms of a cell; a context manager that connects them, and at its end stops and disconnects them."""

    def __init__(self, config: CellConfig):
        self.config, self.rate_hz = config, config.rate_hz
        self.arms = tuple(arm_of(arm, config.path.parent) for arm in config.arms)
        self.followers: tuple[Follower, ...] = tuple(
            make_follower(arm, one.driver, config.rate_hz) for arm, one in zip(self.arms, config.arms, strict=True)
        )
        self.gate = Gate(self.arms, config.limits, config.rate_hz)

    def __enter__(self) -> Station:
        with contextlib.ExitStack() as stack:
            for follower in self.followers:
                follower.connect()
                stack.callback(follower.disconnect)
            self._connected = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stop()
        self._connected.close()

    def states(self) -> list[ArmState]:
        """What the arms measure now."""
        return [follower.state() for follower in self.followers]

    def stop(self) -> None:
        """All arms come to rest and hold."""
        for follower in self.followers:
            follower.stop()

    def play(self, motion: Motion, stop: StopRequest) -> MeasuredPath:
        """Execute a motion that `motion.guard` has checked, from where the arms are now.

        A request to ``stop`` brakes the motion on its path and raises `StoppedError`; so does anything that is wrong,
        after the arms were stopped. The path until then is the error's ``path``.
        """
        log = _Log(len(motion.joints) + BRAKING_STEPS, motion.joints.shape[1:])
        position, stride, last = -1.0, 1.0, len(motion.joints) - 1

        def command() -> list[Command] | None:
            nonlocal position, stride
            if stop.reason:
                stride -= 1 / BRAKING_STEPS
            if position >= last or stride <= 0:
                return None
            position = min(position + stride, float(last))
            return _between(motion, position)

        try:
            self._loop(lambda states: command(), self.gate.admit, log)
        except Exception as error:
            error.path = log.path(self._pace)  # type: ignore[attr-defined]
            raise
        if stop.reason:
            stopped = StoppedError(f"stopped ({stop.reason}); the arms hold their position")
            stopped.path = log.path(self._pace)  # type: ignore[attr-defined]
            raise stopped
        return log.path(self._pace)

    def lead(self, command: Callable[[Sequence[ArmState]], Sequence[Command] | None]) -> None:
        """Let the arms follow ``command(states)``, slowed down by `Gate.limited`, until it returns None."""
        self._loop(command, self.gate.limited, None)

    @property
    def _pace(self) -> float:
        """Rate of the loop, Hz of the machine's clock: an emulated cell may be faster than time."""
        return self.rate_hz * self.config.pace

    def _loop(
        self,
        command: Callable[[Sequence[ArmState]], Sequence[Command] | None],
        checked: Callable[[Sequence[Command]], Sequence[Command] | None],
        log: _Log | None,
    ) -> None:
        states = self.states()
        self.gate.start(states)
        collecting = gc.isenabled()
        gc.disable()  # a collection may take longer than a control step
        try:
            ticker = Ticker(self._pace)
            while (wanted := command(states)) is not None:
                now = ticker.wait()
                sent = checked(wanted) or wanted
                for follower, one in zip(self.followers, sent, strict=True):
                    follower.command(one)
                states = self.states()
                if log is not None:
                    log.add(now, sent, states)
                self.gate.judge(states)
        except BaseException:
            self.stop()
            raise
        finally:
            if collecting:
                gc.enable()


class _Log:
    """Rows of a `MeasuredPath`, in memory that is reserved before the motion."""

    def __init__(self, rows: int, shape: tuple[int, ...]):
        arms, joints = shape
        self._commanded = np.empty((rows, arms, joints + 1))
        self._measured = np.empty_like(self._commanded)
        self._loads, self._seconds, self._count = np.empty((rows, arms)), np.empty(rows), 0

    def add(self, now: float, commands: Sequence[Command], states: Sequence[ArmState]) -> None:
        row = self._count
        for arm, (told, state) in enumerate(zip(commands, states, strict=True)):
            self._commanded[row, arm, :-1], self._commanded[row, arm, -1] = told.joints, told.finger_travel
            self._measured[row, arm, :-1], self._measured[row, arm, -1] = state.joints, state.finger_travel
            self._loads[row, arm] = state.grip_load
        self._seconds[row] = now
        self._count += 1

    def path(self, rate_hz: float) -> MeasuredPath:
        n = self._count
        seconds = self._seconds[:n] - self._seconds[0] if n else np.zeros(0)
        return MeasuredPath(rate_hz, self._commanded[:n], self._measured[:n], self._loads[:n], seconds)


def _between(motion: Motion, position: float) -> list[Command]:
    """The commands at a fractional index of ``motion``."""
    row, share = int(position), position - int(position)
    after = min(row + 1, len(motion.joints) - 1)
    joints: FloatArray = motion.joints[row] + share * (motion.joints[after] - motion.joints[row])
    fingers = motion.fingers[row] + share * (motion.fingers[after] - motion.fingers[row])
    return [Command(one, float(travel)) for one, travel in zip(joints, fingers, strict=True)]
