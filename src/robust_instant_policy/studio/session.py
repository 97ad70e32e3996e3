"""Runs a cell in real time, in one thread: arms follow a person or play a plan; demonstrations are stored."""

import queue
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from robust_instant_policy.datasets import DatasetWriter
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import RipError, UsageError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.arm import Motion
from robust_instant_policy.studio.cell import Cell
from robust_instant_policy.studio.follower import Follower
from robust_instant_policy.studio.take import Step, edited
from robust_instant_policy.trajectory import Trajectory

FRAME_HZ = 30.0  # at which the page is told of new poses
JUDGE_HZ = 3.0  # at which the task's success is looked at
LONGEST_LAG_S = 0.1  # of the cell behind the clock; what is missing after that is left out
LONGEST_TAKE_S = 180.0
SHORTEST_TAKE_S = 0.5

Job = Callable[[], None]


@dataclass(frozen=True)
class Status:
    """``phase`` is "empty" (no cell), "ready" (a scene in which nothing moved), "recording", "playing" or "done".

    ``seconds`` were recorded; ``is_full`` says that they are the most that may be; ``refusal`` why a target is not
    followed, empty where it is; ``failure`` is as in `Cell`; ``closed`` are the gripper states that were asked for.
    """

    phase: str = "empty"
    seconds: float = 0.0
    is_full: bool = False
    refusal: str = ""
    failure: str | None = None
    closed: tuple[bool, ...] = ()


class Watcher(Protocol):
    """Receives the events of a session; all methods are called in its thread."""

    def on_scene(self, cell: Cell, observation: Observation) -> None:
        """There is a new scene."""
        ...

    def on_frame(self, poses: Mapping[str, FloatArray], tools: FloatArray, targets: FloatArray, status: Status) -> None:
        """Something moved: poses of bodies, measured tool poses and targets ``(A, 4, 4)``."""
        ...

    def on_kept(self, demonstration: Demonstration, folder: Path, count: int) -> None:
        """A demonstration was added to ``folder``, which now has ``count``."""
        ...

    def on_message(self, text: str, is_error: bool = True) -> None: ...


class Session:
    """`run` returns after `stop`; all other methods must be called in its thread, by `post`."""

    def __init__(self, watcher: Watcher):
        self.cell: Cell | None = None
        self.observation: Observation | None = None
        self.seed: int | None = None
        self.status = Status()
        self.watcher = watcher
        self._jobs: queue.SimpleQueue[Job] = queue.SimpleQueue()
        self._stopped = False
        self._take: list[Step] = []
        self._moved: dict[str, FloatArray] = {}
        self._steps: deque[Step] = deque()  # that are still to be done
        self._targets = np.zeros((0, 4, 4))
        self._closed = np.zeros(0, dtype=bool)
        self._follower: Follower  # of a cell with arms, from the first scene on
        self._on_played: Callable[[str | None], None] | None = None

    def post(self, job: Job) -> None:
        """Have ``job`` called in the session's thread; an error of it becomes a message."""
        self._jobs.put(job)

    def stop(self) -> None:
        """Have `run` return after the jobs that were posted; may be called by a signal handler."""
        self._stopped = True
        self.post(lambda: None)

    def run(self) -> None:
        """Run the cell, and the jobs, until `stop`."""
        due = shown = judged = time.monotonic()
        while not self._stopped:
            now = time.monotonic()
            due = max(due, now - LONGEST_LAG_S)
            self._work(max(due - now, 0.0))
            if self.cell is None or not self.cell.arms:
                due = time.monotonic() + 1 / FRAME_HZ
                continue
            if due <= now:
                self._tick()
                due += 1 / self.cell.control_hz
            if (now := time.monotonic()) - judged > 1 / JUDGE_HZ:
                judged = now
                self._set(failure=self.cell.failure())
            if now - shown > 1 / FRAME_HZ:
                shown = now
                self._show()
        self._work(0.0)

    def close(self) -> None:
        if self.cell is not None:
            self.cell.close()
            self.cell, self.seed, self.status = None, None, Status()

    def open(self, cell: Cell) -> None:
        """Replace the cell; `new_scene` draws its first scene. Raises `UsageError` while recording."""
        self.require_no_recording()
        self.close()
        self.cell = cell

    def new_scene(self, seed: int) -> None:
        """Draw the scene of ``seed``; raises `UsageError` while recording."""
        self.require_no_recording()
        self._moved.clear()
        self._draw(seed)

    def require_no_recording(self) -> None:
        """Raise `UsageError` where going on would lose a recording."""
        if self.status.phase == "recording":
            raise UsageError("a demonstration is being recorded; keep it (Enter) or discard it (X) first")

    def move(self, body: str, pose: FloatArray) -> None:
        """Put a body of a scene in which nothing moved so far to ``pose (4, 4)``."""
        if self.status.phase != "ready":
            raise UsageError("objects are moved before the arm; choose a new scene, or discard")
        self._moved[body] = pose
        assert self.cell is not None
        self.observation = self.cell.move(body, pose)
        self.watcher.on_scene(self.cell, self.observation)

    def aim(self, arm: int, pose: FloatArray) -> None:
        """Let an arm follow the target ``pose (4, 4)``."""
        if self._is_operated():
            self._targets[arm] = pose

    def nudge(self, arm: int, way: FloatArray, turn: FloatArray) -> None:
        """Shift an arm's target by ``way (3,)`` metres and turn it by the matrix ``turn (3, 3)``, in the world."""
        if self._is_operated():
            self._targets[arm, :3, 3] += way
            self._targets[arm, :3, :3] = turn @ self._targets[arm, :3, :3]

    def release(self) -> None:
        """End of a drag: targets that could not be followed go back to the grippers."""
        if self.status.refusal:
            self._targets = self._follower.motion.poses[-1].copy()
            self._set(refusal="")

    def grip(self, arm: int) -> None:
        """Close an open gripper, open a closed one."""
        if self._is_operated():
            self._closed[arm] = not self._closed[arm]

    def undo(self, seconds: float) -> None:
        """Go back to the moment ``seconds`` before the end of what was recorded."""
        if self.status.phase != "recording" or self.cell is None:
            raise UsageError("nothing is being recorded")
        take = self._take
        del take[max(len(take) - round(seconds * self.cell.control_hz), 0) :]
        self._reset(self.seed)
        if take:
            self._take = take
            for step in take:
                self.cell.advance(step.command)
            joints = step.command.reshape(1, len(self.cell.arms), -1)
            self._follower.resume(Motion(joints[..., :-1], joints[..., -1], step.poses[None], step.closed[None]))
            self._stay()
            self._set(phase="recording", seconds=len(take) / self.cell.control_hz, failure=self.cell.failure())
        self._show()

    def discard(self) -> None:
        """Begin again in the same scene."""
        self._draw(self.seed)

    def keep(self, folder: Path) -> None:
        """Add what was recorded to the demonstrations in ``folder``; raises `UsageError` if the task is not done."""
        cell = self.cell
        if cell is None or self.observation is None or self.status.phase != "recording":
            raise UsageError("nothing is being recorded; move the gripper first")
        if failure := cell.failure():
            raise UsageError(f"not kept: {failure}; go on, undo or discard")
        every, rate_hz = cell.record_every, cell.control_hz / cell.record_every
        chosen = self._take[(len(self._take) - 1) % every :: every]  # the last step among them
        if len(chosen) < SHORTEST_TAKE_S * rate_hz:
            raise UsageError(f"not kept: less than {SHORTEST_TAKE_S:g} s were recorded")
        poses, closed = (np.array([getattr(step, name) for step in chosen]) for name in ("poses", "closed"))
        poses, closed = edited(poses, closed, rate_hz)
        demonstration = Demonstration(
            self.observation,
            Trajectory.from_poses(poses, closed, cell.triangle),
            rate_hz,
            cell.task,
            None if self._moved else self.seed,
            {"demonstrator": "studio"},
        )
        with DatasetWriter(folder, task=cell.task, description=cell.description, rate_hz=rate_hz) as writer:
            writer.add(demonstration)
            count = writer.num_episodes
        self._set(phase="done", is_full=False)
        self.watcher.on_kept(demonstration, folder, count)

    def play(self, motion: Motion, on_played: Callable[[str | None], None]) -> None:
        """Let the arms run ``motion``, which begins at home; ``on_played`` receives `Cell.failure` at the end.

        Raises `UsageError` while recording.
        """
        self.require_no_recording()
        if self.status.phase != "ready":
            self.discard()
        self._steps.extend(_steps_of(motion))
        self._on_played = on_played
        self._follower.resume(motion)
        self._set(phase="playing")

    def rehearse(self, motion: Motion, is_stopped: Callable[[], bool]) -> str | None:
        """Run ``motion``, which begins at home, at once and from the beginning of the scene, until ``is_stopped``.

        Returns `Cell.failure`. Raises `UsageError` while recording.
        """
        self.require_no_recording()
        self._draw(self.seed)
        assert self.cell is not None
        self._set(phase="playing")
        self._show()
        for command in motion.commands:
            if is_stopped() or self._stopped:
                break
            self.cell.advance(command)
        return self.cell.failure()

    def abort(self) -> bool:
        """Stop the motion that is being played where the arms are; returns whether there was one."""
        if self.status.phase != "playing":
            return False
        motion = self._follower.motion
        done = max(len(motion.poses) - len(self._steps), 1)
        self._follower.resume(
            Motion(motion.joints[:done], motion.fingers[:done], motion.poses[:done], motion.closed[:done])
        )
        self._on_played = None
        self._played()
        return True

    def _work(self, seconds: float) -> None:
        """Call the jobs that are there, waiting ``seconds`` for the first."""
        try:
            job = self._jobs.get(timeout=seconds) if seconds else self._jobs.get_nowait()
            while True:
                try:
                    job()
                except RipError as error:
                    self.watcher.on_message(str(error))
                except Exception as error:  # a fault of one action must not end the session
                    traceback.print_exc()
                    self.watcher.on_message(f"unexpected {type(error).__name__}: {error}; see the terminal")
                job = self._jobs.get_nowait()
        except queue.Empty:
            pass

    def _draw(self, seed: int | None) -> None:
        self._reset(seed)
        assert self.cell is not None
        assert self.observation is not None
        self.watcher.on_scene(self.cell, self.observation)
        self._show()

    def _reset(self, seed: int | None) -> None:
        cell = self.cell
        if cell is None or seed is None:
            raise UsageError("there is no scene; choose a task")
        self.observation, self.seed = cell.reset(seed), seed
        for body, pose in self._moved.items():
            self.observation = cell.move(body, pose)
        self._take, self._on_played = [], None
        self._steps.clear()
        self._closed = np.zeros(len(cell.arms), dtype=bool)
        if cell.arms:
            self._follower = Follower(cell.arms, cell.control_hz)
            self._targets = self._follower.motion.poses[-1].copy()
        self.status = Status("ready", closed=tuple(self._closed), failure=cell.failure())

    def _is_operated(self) -> bool:
        has_arms = self.cell is not None and len(self.cell.arms) > 0
        return has_arms and self.status.phase in ("ready", "recording", "done")

    def _tick(self) -> None:
        """One control step."""
        assert self.cell is not None
        phase = self.status.phase
        if self.status.is_full:
            return  # the cell waits for the recording to be kept, cut or discarded
        if not self._steps and phase == "playing":
            self._played()
            return
        if not self._steps:
            motion, refusal = self._follower.towards(self._targets, self._closed)
            if refusal != self.status.refusal:
                self._set(refusal=refusal)
            if motion is not None:
                if phase == "ready":  # a demonstration begins open, at home
                    phase = "recording"
                    self._steps.extend(_steps_of(Motion.at_home(self.cell.arms)))
                self._steps.extend(_steps_of(motion))
        if phase == "ready":
            return  # the scene waits, so that a recording can be replayed from its beginning
        end = self._follower.motion
        step = self._steps.popleft() if self._steps else Step(end.commands[-1], end.poses[-1], end.closed[-1])
        self.cell.advance(step.command)
        if phase == "recording":
            self._take.append(step)
            seconds = len(self._take) / self.cell.control_hz
            self._set(phase=phase, seconds=seconds, is_full=seconds >= LONGEST_TAKE_S)

    def _stay(self) -> None:
        """Aim at the end of the last motion."""
        end = self._follower.motion
        self._targets, self._closed = end.poses[-1].copy(), end.closed[-1].copy()

    def _played(self) -> None:
        assert self.cell is not None
        self._steps.clear()
        self._stay()
        self._set(phase="done", failure=self.cell.failure())
        done, self._on_played = self._on_played, None
        if done is not None:
            done(self.status.failure)

    def _set(self, **changes: Any) -> None:
        self.status = replace(self.status, **changes)

    def _show(self) -> None:
        assert self.cell is not None
        self._set(closed=tuple(map(bool, self._closed)))
        self.watcher.on_frame(self.cell.poses(), self.cell.tool_poses(), self._targets, self.status)


def _steps_of(motion: Motion) -> Iterator[Step]:
    return map(Step, motion.commands, motion.poses, motion.closed)
