"""The protocol of a task. Tasks are independent of methods, methods of tasks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.controller import Controller
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import MissingMethodError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.scene_truth import SceneTruth
from robust_instant_policy.trajectory import Trajectory

SEED_BITS = 62  # of seeds, and of those counted up from them, which stand in tables of 64-bit integers

Image = NDArray[np.uint8]
FrameSink = Callable[[Image], None]


# What a task may lack, and what it is needed for.
OPTIONAL_METHODS = {
    "demonstrate": "to record demonstrations and to replay them",
    "follow": "for methods in closed loop (dp, kat-dp, --replan)",
    "scene_truth": "to measure the errors of keypoints",
}


def offers(task: Task, method: str) -> bool:
    """Whether ``task`` has the one of `OPTIONAL_METHODS` called ``method``."""
    return callable(getattr(task, method, None))


def require(task: Task, method: str) -> None:
    """Raises `MissingMethodError` unless ``task`` `offers` ``method``."""
    if not offers(task, method):
        raise MissingMethodError(task.name, method, OPTIONAL_METHODS[method])


def bounded_seed(seed: int, bits: int = SEED_BITS) -> int:
    """``seed`` if it fits into ``bits`` bits, else a number of ``bits`` bits, up to 64, derived from it."""
    if seed < 1 << bits:
        return seed
    return int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]) >> (64 - bits)


@dataclass(frozen=True)
class Execution:
    """Result of executing a trajectory.

    ``failure`` is the reason of a failure, empty on success; ``seconds`` is simulated (or real) time;
    ``tracking_error`` is the largest distance in metres between the commanded and the reached gripper point.
    """

    success: bool
    failure: str = ""
    seconds: float = 0.0
    tracking_error: float = 0.0


@dataclass(frozen=True, eq=False)
class Attempt:
    """One attempt of a demonstrator; ``images (T, H, W, 3)`` uint8, one per step, if requested; ``grippers (T,
    A)`` are the measured gripper states, 0 open to 1 closed, where the task measures them."""

    demonstration: Demonstration
    success: bool
    failure: str = ""
    images: Image | None = field(default=None, repr=False)
    grippers: FloatArray | None = field(default=None, repr=False)


class Task(Protocol):
    """A scene, a robot, and a demonstrator.

    A task of one's own needs `reset` and `execute` only (docs/own-tasks.md): the attributes have the defaults of
    `own.DEFAULTS`, and what needs one of `OPTIONAL_METHODS` calls `require` or `offers` first.

    ``description`` is the task in one sentence, ``goal`` the condition of success ("the cube is in the goal").
    ``end_effectors`` names the grippers in the order of the columns of a trajectory. ``workspace (2, 3)`` are the lower
    and upper corner, in metres, of the volume in which the arm works; keypoints outside it are ignored (None: the whole
    image is used). ``record_hz`` and ``execute_hz`` are the rates of demonstrations and of
    executed waypoints, ``video_hz`` that of video frames.
    """

    name: str
    description: str
    goal: str
    end_effectors: tuple[str, ...]
    record_hz: float
    execute_hz: float
    video_hz: float
    workspace: FloatArray | None

    def reset(self, seed: int) -> Observation:
        """Draw the scene of ``seed`` and take its image; the same seed gives the same scene and image."""
        ...

    def execute(self, trajectory: Trajectory, on_frame: FrameSink | None = None) -> Execution:
        """Execute ``trajectory`` in the scene of the last `reset`; ``on_frame`` receives video frames.

        Raises `UnreachableError`, before the arm moves, for a trajectory that fails a check of `motion`.
        """
        ...

    def follow(self, controller: Controller, max_seconds: float, on_frame: FrameSink | None = None) -> Execution:
        """Run ``controller`` from the home pose in the scene of the last `reset`, for ``max_seconds`` at most.

        A waypoint that fails a check of `motion` ends the episode; the reason is its ``failure``.
        """
        ...

    def demonstrate(self, seed: int, with_images: bool = False, every: int = 1) -> Attempt:
        """Let the demonstrator try the scene of ``seed``; its variation depends on the seed, too.

        Keeps every ``every``-th recorded step, including the last one, ``with_images`` with an image for each;
        rendering images takes most of the time.
        """
        ...

    def scene_truth(self) -> SceneTruth:
        """Ground truth of the image of the last `reset`, to measure perception; not for policies."""
        ...

    def close(self) -> None: ...
