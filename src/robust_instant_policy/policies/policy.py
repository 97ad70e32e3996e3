"""The protocol of a policy, and its `Plan`."""

from __future__ import annotations

import json
import math
import reprlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.checks import checked_array, checked_positive, is_finite
from robust_instant_policy.context.frames import FrameUse
from robust_instant_policy.controller import Controller
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import DatasetError, InvalidValueError, KeypointError, PlanningError
from robust_instant_policy.files import excerpt, read_json, write_whole
from robust_instant_policy.geometry import FloatArray, as_numbers
from robust_instant_policy.policies.timed_poses import TimedPoses
from robust_instant_policy.sanity import DemonstrationError, GeometryError
from robust_instant_policy.trajectory import Trajectory

# What ends a plan and not the run: refusals, and defects in the mathematics, which the row names.
UNPLANNABLE = (
    GeometryError,
    DemonstrationError,
    KeypointError,
    PlanningError,
    ArithmeticError,
    LookupError,
    ValueError,
)

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
    ``confidence`` is the number to gate on: a calibrated probability in [0, 1] that the plan is right (docs/trust.md),
    0 where a check found an error; None from a method that has none. ``evidence`` is what it was made from, see
    `confidence.Evidence`.
    ``keypoints (K, 3)``, metres, world, ``pixels (K, 2)`` (u, v) and ``keypoint_confidence (K,)`` in [0, 1] are what
    was recognised; ``frames`` are those in which it was planned; ``notes`` are for the user, one line each. ``cell`` is
    the digest of the real cell it was made for, with its calibration and grippers; empty for a plan of no real cell.
    ``seconds`` is how long the demonstrations took (their median), ``dwell`` how many seconds a gripper needs to open
    or close; None where only trajectories were known. `poses` makes timed gripper poses of them.
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
    evidence: Mapping[str, float] = field(default_factory=dict)
    frames: tuple[FrameUse, ...] = ()
    cell: str = ""
    seconds: float | None = None
    dwell: float | None = None

    @classmethod
    def of(cls, trajectory: Trajectory) -> Plan:
        """A plan to follow ``trajectory``, of which nothing else is known."""
        steps, dim = trajectory.actions.shape
        return cls(
            trajectory=trajectory,
            candidates=(trajectory,),
            weights=np.ones((1, steps)),
            scale=np.zeros((steps, dim)),
            hallucinated=np.zeros(1, dtype=bool),
            onset=np.full(1, -1),
            scores=np.zeros(1),
            confidence=None,
            keypoints=np.zeros((0, 3)),
            pixels=np.zeros((0, 2)),
            keypoint_confidence=np.zeros(0),
        )

    def poses(self, seconds: float | None = None, dwell: float | None = None) -> TimedPoses:
        """Gripper poses to execute one after the other, with times, at the demonstrations' pace.

        The motion takes ``seconds``, and stops for ``dwell`` seconds where a gripper opens or closes: there the pose
        is repeated, with the new opening. Raises `InvalidValueError` where neither the plan nor the call says so.
        """
        seconds, dwell = self.seconds if seconds is None else seconds, self.dwell if dwell is None else dwell
        if seconds is None or dwell is None:
            raise InvalidValueError("the plan does not know how long the demonstrations took; give seconds and dwell")
        return TimedPoses.of(self.trajectory, checked_positive("seconds", seconds), checked_positive("dwell", dwell))

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
            "evidence": dict(self.evidence),
            "frames": [{**vars(frame), "pose": frame.pose.tolist()} for frame in self.frames],
            "seconds": self.seconds,
            "dwell": self.dwell,
            "cell": self.cell,
        }
        write_whole(Path(path), (json.dumps(content, allow_nan=False) + "\n").encode())

    @classmethod
    def load(cls, path: str | Path) -> Plan:
        """Read a plan written by `save`; raises `DatasetError` in one line."""
        try:
            if not Path(path).exists():
                raise DatasetError(f"no plan at {path}")
            content = read_json(path, "a plan")
            if content["format"] != PLAN_FORMAT:
                found = reprlib.repr(content["format"])
                raise DatasetError(f"{path} has plan format {found}, this version reads {PLAN_FORMAT}")
            trajectory = _from_json(content["trajectory"])
            candidates = tuple(_from_json(candidate) for candidate in content["candidates"])
            sizes = {"Q": len(candidates), "T": len(trajectory), "D": trajectory.actions.shape[1]}
            sizes["K"] = len(content["keypoints"])
            return cls(
                trajectory=trajectory,
                candidates=candidates,
                confidence=_checked_confidence(content["confidence"]),
                usage=Usage(tuple(_stage(stage) for stage in content["usage"])),
                notes=_checked_notes(content["notes"]),
                evidence=_checked_evidence(content.get("evidence", {})),  # plans of version 0.1 have none
                frames=tuple(_frame(frame) for frame in content.get("frames", [])),
                seconds=_checked_time("seconds", content.get("seconds")),
                dwell=_checked_time("dwell", content.get("dwell")),
                cell=str(content.get("cell", "")),
                **{name: _array(content, name, sizes) for name in _ARRAYS},
            )
        except OSError as error:
            raise DatasetError(f"{path} cannot be read: {error.strerror}") from None
        except (KeyError, TypeError, ValueError, InvalidValueError) as error:
            raise DatasetError(f"{path} is not a plan: {excerpt(error)}") from None


_ARRAYS: dict[str, tuple[type, str]] = {  # type, and size of each axis: a letter or a number
    "weights": (np.float64, "QT"),
    "scale": (np.float64, "TD"),
    "hallucinated": (np.bool_, "Q"),
    "onset": (np.int64, "Q"),
    "scores": (np.float64, "Q"),
    "keypoints": (np.float64, "K3"),
    "pixels": (np.float64, "K2"),
    "keypoint_confidence": (np.float64, "K"),
}


def _array(content: dict, name: str, sizes: dict[str, int]) -> NDArray:
    dtype, axes = _ARRAYS[name]
    shape = tuple(sizes[axis] if axis in sizes else int(axis) for axis in axes)
    values = np.asarray(content[name])
    if dtype is not np.bool_ or values.dtype != np.bool_:
        values = as_numbers(name, content[name])
    if not np.isfinite(values).all():
        raise ValueError(f"{name} holds values that are not finite")
    if values.shape != shape and values.size + math.prod(shape) > 0:  # an empty array keeps no shape in JSON
        raise ValueError(f"{name} must be {shape}, got {values.shape}")
    return values.reshape(shape).astype(dtype)


def _stage(content: dict) -> Stage:
    stage = Stage(**content)
    if not isinstance(stage.name, str) or not all(
        is_finite(value) and value >= 0 for name, value in vars(stage).items() if name != "name"
    ):
        raise ValueError("its usage holds something other than a name and what a stage cost")
    return stage


def _frame(content: dict) -> FrameUse:
    frame = FrameUse(**{**content, "pose": checked_array("the pose of a frame", content["pose"], "(4, 4)")})
    steps = frame.arm, frame.first, frame.last
    if not isinstance(frame.words, str) or not all(isinstance(step, int) for step in steps):
        raise ValueError("its frames hold something other than words and steps")
    return frame


def _checked_evidence(value: object) -> dict[str, float]:
    if not isinstance(value, dict) or not all(map(is_finite, value.values())):
        raise ValueError("its evidence is not a map of numbers")
    return {name: float(number) for name, number in value.items()}


def _checked_time(name: str, value: object) -> float | None:
    return None if value is None else checked_positive(name, value)


def _checked_notes(notes: object) -> tuple[str, ...]:
    if not isinstance(notes, list) or not all(isinstance(note, str) for note in notes):
        raise ValueError("its notes are not a list of text")
    return tuple(notes)


def _checked_confidence(value: float | None) -> float | None:
    if value is not None and not (isinstance(value, int | float) and 0.0 <= value <= 1.0):
        raise ValueError(f"its confidence is {reprlib.repr(value)}, not a number from 0 to 1")
    return value


def _to_json(trajectory: Trajectory) -> dict[str, list]:
    return {"times": trajectory.times.tolist(), "actions": trajectory.actions.tolist()}


def _from_json(content: dict[str, list]) -> Trajectory:
    return Trajectory(as_numbers("actions", content["actions"]), as_numbers("times", content["times"]))


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

    @property
    def name(self) -> str: ...

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
