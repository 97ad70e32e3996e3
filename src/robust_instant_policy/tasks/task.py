"""The contract between tasks and everything above them. Tasks know no method; methods know no task."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.controller import Controller
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.scene_truth import SceneTruth
from robust_instant_policy.trajectory import Trajectory

Image = NDArray[np.uint8]
FrameSink = Callable[[Image], None]


def bounded_seed(seed: int, bits: int) -> int:
    """``seed`` where it fits into ``bits`` bits, else a number of up to 64 of them that is drawn with it."""
    if seed < 1 << bits:
        return seed
    return int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]) >> (64 - bits)


@dataclass(frozen=True)
class Execution:
    """What happened when a trajectory was executed.

    ``failure`` says in words why it failed and is empty on success; ``seconds`` is simulated (or real) time;
    ``tracking_error`` the largest distance in metres between the commanded and the reached palm point.
    """

    success: bool
    failure: str
    seconds: float
    tracking_error: float


@dataclass(frozen=True, eq=False)
class Attempt:
    """One try of a demonstrator; ``images (T, H, W, 3)`` uint8, one for each of its steps, where asked for."""

    demonstration: Demonstration
    success: bool
    failure: str
    images: Image | None = field(default=None, repr=False)


class Task(Protocol):
    """A scene, a robot in it, and a person who can show what to do.

    ``description`` says what is to be done, in one sentence, and ``goal`` what is true once it is done
    ("the cube is in the goal"). ``end_effectors`` names the grippers that a trajectory of this task is for, in the
    order of its columns. ``workspace (2, 3)`` are the lower and upper corner, in metres, of the volume in
    which the arm works; keypoints outside it mean nothing. ``record_hz`` and ``execute_hz`` are the rates of
    demonstrations and of the waypoints played back, ``video_hz`` that of the frames `execute` hands out.
    """

    name: str
    description: str
    goal: str
    end_effectors: tuple[str, ...]
    record_hz: float
    execute_hz: float
    video_hz: float
    workspace: FloatArray

    def reset(self, seed: int) -> Observation:
        """Draw the scene of ``seed`` and photograph it; the same seed gives the same scene and image."""
        ...

    def execute(self, trajectory: Trajectory, on_frame: FrameSink | None = None) -> Execution:
        """Run ``trajectory`` in the scene of the last `reset`; ``on_frame`` receives video frames.

        Raises `UnreachableError`, before anything moves, for a trajectory the arm cannot follow safely.
        """
        ...

    def follow(self, controller: Controller, max_seconds: float, on_frame: FrameSink | None = None) -> Execution:
        """Let ``controller`` move the robot, from home, in the scene of the last `reset`, for ``max_seconds`` at most.

        A waypoint that the arm cannot follow safely ends the episode where it is, and is its ``failure``.
        """
        ...

    def demonstrate(self, seed: int, with_images: bool = False, every: int = 1) -> Attempt:
        """Let the demonstrator try the scene of ``seed``, in its own manner for that seed.

        What is kept is every ``every``-th step of what was recorded, the last one included, with its image where
        images are asked for: rendering them is what takes the time.
        """
        ...

    def scene_truth(self) -> SceneTruth:
        """What the pixels of the last `reset` show: for measuring perception, never for a policy."""
        ...

    def close(self) -> None: ...
