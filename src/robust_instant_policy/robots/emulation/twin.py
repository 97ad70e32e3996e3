"""The physics behind emulated devices."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import RobotError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.state import Command

LAG_STEPS = 1.5  # control steps by which a `LaggingTwin` follows its commands
KEPT_COMMANDS = 50_000


@dataclass(frozen=True, eq=False)
class TwinState:
    """Joints ``(J,)`` rad, finger travel in metres, and the gripper's force as a share of its limit."""

    joints: FloatArray
    finger_travel: float
    grip_load: float


class Twin(Protocol):
    """A scene with A arms that advances one control step at a time."""

    def advance(self, commands: Sequence[Command]) -> None: ...
    def states(self) -> Sequence[TwinState]: ...

    def photograph(self) -> Callable[[], Observation]:
        """The scene now, for a camera that takes its time: what is returned may be called while the twin advances."""
        ...

    def reset(self, seed: int) -> None:
        """Build the scene with a ``seed``; the arms are at home."""
        ...

    def failure(self) -> str:
        """Reason why the task is not done, empty if it is."""
        ...


class LaggingTwin:
    """Arms without a scene: joints and fingers follow their commands with a lag."""

    def __init__(self, homes: Sequence[FloatArray], travels: Sequence[float]):
        self._states = [TwinState(np.array(home), travel, 0.0) for home, travel in zip(homes, travels, strict=True)]

    def reset(self, seed: int) -> None:
        """There is no scene; the arms stay."""

    def advance(self, commands: Sequence[Command]) -> None:
        self._states = [
            TwinState(
                state.joints + (told.joints - state.joints) / LAG_STEPS,
                state.finger_travel + (told.finger_travel - state.finger_travel) / LAG_STEPS,
                0.0,
            )
            for state, told in zip(self._states, commands, strict=True)
        ]

    def states(self) -> Sequence[TwinState]:
        return self._states

    def photograph(self) -> Callable[[], Observation]:
        raise RobotError("this emulated cell has no scene and no camera; name a task in its table [emulation]")

    def failure(self) -> str:
        return "there is no task"


class SharedTwin:
    """A twin that the devices of several arms drive, each from its own thread.

    The twin advances when each arm has got a command since its last step, or one arm has got a second one: time
    passes as fast as commands come. ``commands (N, A, J + 1)`` are the executed ones, ``times (N,)`` their times,
    seconds of `time.monotonic`.
    """

    def __init__(self, twin: Twin):
        self.twin, self._lock = twin, threading.Lock()
        states = twin.states()
        self._told = [Command(state.joints, state.finger_travel) for state in states]
        self._waiting: set[int] = set()
        self._executed: list[FloatArray] = []
        self._times: list[float] = []

    def command(self, arm: int, command: Command) -> None:
        with self._lock:
            if arm in self._waiting:
                self._advance()
            self._told[arm] = command
            self._waiting.add(arm)
            if len(self._waiting) == len(self._told):
                self._advance()

    def reset(self, seed: int) -> None:
        with self._lock:
            self.twin.reset(seed)
            self._told = [Command(state.joints, state.finger_travel) for state in self.twin.states()]
            self._waiting.clear()

    def state(self, arm: int) -> TwinState:
        with self._lock:
            return self.twin.states()[arm]

    def photograph(self) -> Observation:
        with self._lock:
            picture = self.twin.photograph()
        return picture()

    def failure(self) -> str:
        with self._lock:
            return self.twin.failure()

    @property
    def commands(self) -> FloatArray:
        with self._lock:
            return np.array(self._executed)

    @property
    def times(self) -> FloatArray:
        with self._lock:
            return np.array(self._times)

    def _advance(self) -> None:
        self.twin.advance(self._told)
        self._executed.append(np.stack([np.append(one.joints, one.finger_travel) for one in self._told]))
        self._times.append(time.monotonic())
        del self._executed[:-KEPT_COMMANDS], self._times[:-KEPT_COMMANDS]
        self._waiting.clear()
