"""The arms of a cell behind one gate, and the loop that moves them.

        ┌──────────── every 1 / rate_hz ────────────┐
states ─▶ Gate.judge ─▶ next command ─▶ Gate.admit ─▶ followers
             │                              │
             └───── StoppedError, RobotError ──┴──▶ all followers stop and hold
"""

from __future__ import annotations

import contextlib
import gc
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from robust_instant_policy.errors import CellError, RobotError, StoppedError, UnreachableError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.arm import Arm, Motion
from robust_instant_policy.motion.gate import STALE_S, Gate
from robust_instant_policy.motion.guard import minimum_jerk
from robust_instant_policy.motion.state import ArmState, Command
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.device import connected
from robust_instant_policy.robots.follower import Follower
from robust_instant_policy.robots.followers import make_follower
from robust_instant_policy.robots.models import arm_of
from robust_instant_policy.robots.path import MeasuredPath, tool_points
from robust_instant_policy.robots.priority import CONTROL, real_time
from robust_instant_policy.robots.signals import StopRequest

BRAKING_S = 0.24  # time in which a motion is brought to rest on request
BLENDING_S = 0.5  # time in which the difference between measured joints and the motion's first ones fades out
START_RAD = 0.1  # largest such difference
Step = tuple[float, Sequence[Command], Sequence[ArmState]]  # time, what was sent, and the states after it
HOLDING = "the arms hold their position"
EMULATED_STALE_S = 0.5, 0.4  # greatest age of a state, at pace 1 and at any pace: emulations share a busy processor


@dataclass(frozen=True)
class Played:
    """The measured path of a motion, and why it was ``stopped``, empty where it came to its end.

    Where a device does not answer, ``holds`` is False: only its own watchdog can have stopped the arm.
    """

    path: MeasuredPath
    stopped: str
    holds: bool = True

    def require_end(self) -> None:
        """Raises `StoppedError` for a motion that was stopped."""
        if self.stopped:
            known = HOLDING if self.holds else "look at the arms: those that answer hold, the others by their watchdogs"
            raise StoppedError(f"{self.stopped}; {known}")


class Station:
    """The arms of a cell; a context manager that connects them, and at its end stops and disconnects them."""

    def __init__(self, config: CellConfig):
        self.config, self.rate_hz = config, config.rate_hz
        self.arms = tuple(arm_of(arm, config.path.parent) for arm in config.arms)
        self.followers: tuple[Follower, ...] = tuple(
            make_follower(arm, one.driver, config.rate_hz) for arm, one in zip(self.arms, config.arms, strict=True)
        )
        if len({len(arm.home) for arm in self.arms}) > 1:
            counts = ", ".join(f"{arm.name} {len(arm.home)}" for arm in self.arms)
            raise CellError(f"{config.path}: the arms of a cell must have as many joints as each other, not {counts}")
        most, least = EMULATED_STALE_S
        stale_s = STALE_S if config.emulation is None else max(most / config.pace, least)
        self.sent_at = 0.0  # of the last command, seconds of `time.monotonic`
        self.gate = Gate(self.arms, config.limits, config.rate_hz, stale_s)

    def __enter__(self) -> Station:
        with contextlib.ExitStack() as stack:
            for follower in self.followers:
                stack.enter_context(connected(follower))
            self._connected = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        with self._connected:
            self.stop()

    def states(self) -> list[ArmState]:
        """What the arms measure now."""
        return [follower.state() for follower in self.followers]

    def stop(self) -> None:
        """All arms come to rest and hold, also those after one that fails to."""
        with contextlib.ExitStack() as stack:
            for follower in reversed(self.followers):
                stack.callback(follower.stop)

    def play(self, motion: Motion, stop: StopRequest) -> Played:
        """Execute a motion that `motion.guard` has checked, from where the arms are now.

        A request to ``stop`` brakes the motion on its path; anything that is wrong stops the arms at once.
        """
        braking, blending = (max(round(seconds * self.rate_hz), 1) for seconds in (BRAKING_S, BLENDING_S))
        steps: list[Step] = []
        last = len(motion.joints) - 1
        most = np.array([arm.finger_speed for arm in self.arms]) / self.rate_hz
        position, stride, step, offset = -1.0, 1.0, 0, np.zeros(motion.joints.shape[1:])

        def command(states: Sequence[ArmState]) -> list[Command] | None:
            nonlocal position, stride, step, offset
            if step == 0:
                offset = self._start_offset(motion, states)
            if stop.reason:
                stride = stride - 1 / braking if step else 0.0
            if position >= last or stride <= 0:
                return None
            position, step = min(position + stride, float(last)), step + 1
            joints, fingers = _between(motion, position)
            joints = joints + minimum_jerk(np.maximum(1 - step / blending, 0.0)) * offset
            before = np.array([one.finger_travel for one in self.gate.last])  # the fingers may begin elsewhere, too
            fingers = before + np.clip(fingers - before, -most, most)
            return [Command(one, float(travel)) for one, travel in zip(joints, fingers, strict=True)]

        stopped, holds = "", True
        try:
            self._loop(command, self.gate.admit, steps.append)
        except (RobotError, UnreachableError) as error:
            stopped, holds = str(error), isinstance(error, StoppedError | UnreachableError)
        path = _path_of(steps, self.rate_hz, self.arms)
        return Played(path, stopped or stop.reason, holds)  # a request may have come after the last command

    def lead(self, command: Callable[[Sequence[ArmState]], Sequence[Command] | None]) -> None:
        """Let the arms follow ``command(states)``, slowed down by `Gate.limited`, until it returns None."""
        self._loop(command, self.gate.limited, lambda _: None)

    def _start_offset(self, motion: Motion, states: Sequence[ArmState]) -> FloatArray:
        """Measured joints ``(A, J)`` minus the first ones of ``motion``; raises `StoppedError` where they are far."""
        offset = np.stack([state.joints for state in states]) - motion.joints[0]
        worst = np.abs(offset).max(axis=1)
        arm = int(np.argmax(worst))
        if worst[arm] > START_RAD:
            raise StoppedError(
                f"{self.arms[arm].name} is {worst[arm]:.2f} rad away from where the motion begins, at most {START_RAD} "
                "are accepted; park it again"
            )
        return offset

    def _loop(
        self,
        command: Callable[[Sequence[ArmState]], Sequence[Command] | None],
        checked: Callable[[Sequence[Command]], Sequence[Command]],
        keep: Callable[[Step], object],
    ) -> None:
        states = self.states()
        self.gate.start(states)
        try:
            with _undisturbed():
                period, due = 1 / (self.rate_hz * self.config.pace), time.monotonic()
                while (wanted := command(states)) is not None:
                    due = max(due + period, time.monotonic())  # a missed deadline is not caught up with
                    time.sleep(max(due - time.monotonic(), 0.0))
                    now = self.sent_at = time.monotonic()
                    sent = checked(wanted)
                    for follower, one in zip(self.followers, sent, strict=True):
                        follower.command(one)
                    states = self.states()
                    keep((now, sent, states))
                    self.gate.judge(states)
        finally:
            self.stop()  # also after the last command: the servos' watchdog would not let them go on later


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """No garbage collection, which may take longer than a control step, and a real-time priority for this thread."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        with real_time(CONTROL):
            yield
    finally:
        if collecting:
            gc.enable()


def _path_of(steps: Sequence[Step], rate_hz: float, arms: Sequence[Arm]) -> MeasuredPath:
    shape = (len(steps), len(arms), len(arms[0].home) + 1)
    commanded = np.array([[[*one.joints, one.finger_travel] for one in sent] for _, sent, _ in steps]).reshape(shape)
    measured = np.array([[[*one.joints, one.finger_travel] for one in states] for *_, states in steps]).reshape(shape)
    loads = np.array([[one.grip_load for one in states] for *_, states in steps]).reshape(shape[:2])
    seconds = np.array([at for at, *_ in steps])
    told, moved = (tool_points(joints[..., :-1], arms) for joints in (commanded, np.nan_to_num(measured)))
    return MeasuredPath(rate_hz, commanded, measured, told, moved, loads, seconds - seconds[:1])


def _between(motion: Motion, position: float) -> tuple[FloatArray, FloatArray]:
    """Joints ``(A, J)`` and finger travel ``(A,)`` at a fractional index of ``motion``."""
    row, share = int(position), position - int(position)
    after = min(row + 1, len(motion.joints) - 1)
    joints: FloatArray = motion.joints[row] + share * (motion.joints[after] - motion.joints[row])
    return joints, motion.fingers[row] + share * (motion.fingers[after] - motion.fingers[row])
