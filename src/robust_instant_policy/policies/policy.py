"""The protocol of a policy, and its `Plan`."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.controller import Controller
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import DatasetError, InvalidValueError
from robust_instant_policy.files import write_whole
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.trajectory import Trajectory

PLAN_FORMAT = 1  # raised when the layout of plan.json changes

# Called as work goes on: the stage's name, how much of it is done, and how much there is (0 when unknown).
Progress = Callable[[str, int, int], None]


def no_progress(stage: str, done: int, total: int) -> None:
    """The `Progress` of a caller who wants none."""


@dataclass(frozen=True)
class Stage:
    """What one stage of planning cost: wall seconds, and tokens where a language model was asked.

    ``cached_tokens`` is the part of ``prompt_tokens`` that the server had in its prefix cache.
    """

    name: str
    seconds: float
    prompt_tokens: int = 0
    cached_tokens: int = 0
    completion_tokens: int = 0


@dataclass(frozen=True)
class Usage:
    """The stages of one plan, in order."""

    stages: tuple[Stage, ...] = ()

    @property
    def seconds(self) -> float:
        return sum(stage.seconds for stage in self.stages)

    @property
    def tokens(self) -> int:
        """Tokens read and written, without cached ones."""
        return sum(stage.prompt_tokens - stage.cached_tokens + stage.completion_tokens for stage in self.stages)


class Stopwatch:
    """Collects the `Stage`s of a plan as they end."""

    def __init__(self) -> None:
        self.stages: list[Stage] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.stages.append(Stage(name, time.perf_counter() - start))


@dataclass(frozen=True, eq=False)
class Plan:
    """A trajectory to execute, and why to trust it.

    ``trajectory`` has T steps for A arms; ``candidates`` are the Q trajectories it was made from.
    ``weights (Q, T)`` in [0, 1] says how much each counted at each step of the plan (low = ignored).
    ``scale (T, 10·A)`` is the spread of the agreement: in metres for the nine coordinates of an arm's points, and for
    its gripper state, the tenth column, the weighted share of candidates with the other state, in [0, 1].
    ``hallucinated (Q,)`` names the candidates that leave the agreement, ``onset (Q,)`` the first step, of the
    candidate's own, at which each does (-1: never), and ``scores (Q,)`` how strong the evidence is.
    ``confidence`` in [0, 1] is the number to gate on, None from a method that has none.
    ``keypoints (K, 3)``, metres, world, ``pixels (K, 2)`` (u, v) and ``keypoint_confidence (K,)`` in [0, 1] are what
    was recognised; ``notes`` are for the user, one line each.
    """

    trajectory: Trajectory
    candidates: tuple[Trajectory, ...]
    weights: FloatArray
    scale: FloatArray
    hallucinated: NDArray[np.bool_]
    onset: NDArray[np.int64]
    scores: FloatArray
    confidence: float | None
    keypoints: FloatArray
    pixels: FloatArray
    keypoint_confidence: FloatArray
    usage: Usage = field(default_factory=Usage)
    notes: tuple[str, ...] = ()

    def save(self, path: str | Path) -> None:
        """Write the plan as JSON, whole or not at all. Raises `DatasetError` when that is not possible."""
        content = {
            "format": PLAN_FORMAT,
            "trajectory": _to_json(self.trajectory),
            "candidates": [_to_json(candidate) for candidate in self.candidates],
            **{name: getattr(self, name).tolist() for name in _ARRAYS},
            "confidence": self.confidence,
            "usage": [vars(stage) for stage in self.usage.stages],
            "notes": list(self.notes),
        }
        write_whole(Path(path), (json.dumps(content, allow_nan=False) + "\n").encode())

    @classmethod
    def load(cls, path: str | Path) -> Plan:
        """Read a plan written by `save`; raises `DatasetError` in one line."""
        try:
            content = json.loads(Path(path).read_text(), parse_constant=_no_number)
            if content["format"] != PLAN_FORMAT:
                raise DatasetError(f"{path} has plan format {content['format']}, this version reads {PLAN_FORMAT}")
            return cls(
                trajectory=_from_json(content["trajectory"]),
                candidates=tuple(_from_json(candidate) for candidate in content["candidates"]),
                confidence=_checked_confidence(content["confidence"]),
                usage=Usage(tuple(Stage(**stage) for stage in content["usage"])),
                notes=tuple(content["notes"]),
                **{name: np.array(content[name], dtype=dtype) for name, dtype in _ARRAYS.items()},
            )
        except FileNotFoundError:
            raise DatasetError(f"no plan at {path}") from None
        except OSError as error:
            raise DatasetError(f"{path} cannot be read: {error.strerror}") from None
        except (KeyError, TypeError, ValueError, InvalidValueError) as error:
            raise DatasetError(f"{path} is not a plan: {error}") from None


_ARRAYS: dict[str, type] = {
    "weights": np.float64,
    "scale": np.float64,
    "hallucinated": np.bool_,
    "onset": np.int64,
    "scores": np.float64,
    "keypoints": np.float64,
    "pixels": np.float64,
    "keypoint_confidence": np.float64,
}


def _no_number(word: str) -> float:
    raise ValueError(f"it holds {word} in place of a number")


def _checked_confidence(value: float | None) -> float | None:
    if value is not None and not (isinstance(value, int | float) and 0.0 <= value <= 1.0):
        raise ValueError(f"its confidence is {value!r}, not a number from 0 to 1")
    return value


def _to_json(trajectory: Trajectory) -> dict[str, list]:
    return {"times": trajectory.times.tolist(), "actions": trajectory.actions.tolist()}


def _from_json(content: dict[str, list]) -> Trajectory:
    return Trajectory(np.array(content["actions"]), np.array(content["times"]))


class Policy(Protocol):
    """Sees demonstrations once, then plans for new observations."""

    @property
    def name(self) -> str: ...

    def fit(self, demonstrations: Sequence[Demonstration]) -> Policy:
        """Returns itself."""
        ...

    def plan(self, observation: Observation) -> Plan:
        """Plan for a new scene; raises `KeypointError` or `PlanningError` where no plan can be trusted."""
        ...

    def executions(self, plan: Plan) -> tuple[Trajectory, ...]:
        """The trajectories that an evaluation executes for ``plan``, one after the other."""
        ...


@runtime_checkable
class ClosedLoopPolicy(Protocol):
    """Sees demonstrations once, then moves the robot in closed loop."""

    name: str

    @property
    def max_seconds(self) -> float:
        """How long one episode may take; known once demonstrations were seen."""
        ...

    def fit(self, demonstrations: Sequence[Demonstration]) -> ClosedLoopPolicy:
        """Returns itself."""
        ...

    def controller(self, observation: Observation) -> Controller:
        """The controller of one episode in the scene of ``observation``."""
        ...
