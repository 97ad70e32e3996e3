"""Demonstrations as text for a language model, and its answers as trajectories: what both layouts share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from robust_instant_policy.checks import checked_array
from robust_instant_policy.context.alignment import AlignedDemonstrations
from robust_instant_policy.context.step_frames import StepFrames
from robust_instant_policy.context.things import DEMOS_TO_TELL_THINGS, WORLD
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.query import Query
from robust_instant_policy.trajectory import Trajectory

REACH_MM = 5000.0  # an answer with a larger number is refused: no arm reaches that far

INSTRUCTION = (
    "Each example maps numbers to numbers. Find the rule and complete the last example. "
    "Answer with the missing numbers only, in the same layout, without any other words."
)

CLOSE_VOTE = 0.5  # below which a scene lies between two ways
CLOSE_NOTE = (
    "the scene lies between those in which the demonstrations do different things; the better supported way is "
    "followed (vote {:.2f}, 1 is as clear as the demonstrations)"
)
FAR_OUTSIDE = 0.5  # of the range that the demonstrations show, by which a scene lies beyond it
OUTSIDE_NOTE = (
    "distances or sizes on which the plan's frames depend lie outside of the demonstrations by {:.0%} of their range; "
    "the plan is an extrapolation"
)
GUESS_NOTE = (
    "the frames are a guess: one or two demonstrations do not tell what a motion depends on; show three or more"
)

Layout = Literal["sequence", "factorised"]
Frames = Literal["world", "adaptive"]


@dataclass(frozen=True, eq=False)
class Prompt(ABC):
    """Serialised demonstrations; made by `write_prompt`.

    ``keypoints (I, K, 3)``, metres, are those of the demonstrations ``shown`` (indices), ``aligned`` are all of them,
    ``frames`` the frame of each step. ``variation (T,)``, metres, evenly spread over a trajectory, is the
    demonstrations' standard deviation in these frames; None in the world frame, where scenes vary too, and of one
    demonstration.
    """

    keypoints: FloatArray
    aligned: AlignedDemonstrations
    frames: StepFrames
    variation: FloatArray | None
    shown: tuple[int, ...]

    @property
    def curvature(self) -> FloatArray:
        """How sharply the gripper is expected to turn ``(B,)``, metres, see `AlignedDemonstrations.curvature`."""
        return self.aligned.curvature()

    @property
    def ways(self) -> tuple[Prompt, ...]:
        """One prompt for each way to act that the demonstrations show; itself where all do the same."""
        return (self,)

    def decide(self, keypoints: FloatArray) -> tuple[int, float]:
        """Which of ``ways`` applies in the scene of ``keypoints (K, 3)``, and how clearly: 1 is as in the
        demonstrations, 0 a tie."""
        return 0, 1.0

    def for_scene(self, keypoints: FloatArray) -> Prompt:
        """The prompt of the way that applies in the scene of ``keypoints (K, 3)``."""
        return self.ways[self.decide(keypoints)[0]]

    def outside(self, keypoints: FloatArray) -> float:
        """How far the scene of ``keypoints (K, 3)`` lies outside of the demonstrations in what the frames depend on; 0
        within them, 1 by as much as they vary (`StepFrames.outside`)."""
        return self.frames.outside(self.keypoints, self.checked(keypoints))

    def notes(self) -> tuple[str, ...]:
        """For the user, one line each: what was inferred that may be wrong."""
        guess = len(self.shown) < DEMOS_TO_TELL_THINGS and any(frame.things != (WORLD,) for frame in self.frames.used)
        ranks = () if self.frames.ranking is None else (str(self.frames.ranking),)
        return (*ranks, *((GUESS_NOTE,) if guess else ()))

    def scene_notes(self, keypoints: FloatArray) -> tuple[str, ...]:
        """The same about the scene of ``keypoints (K, 3)``."""
        (way, vote) = self.decide(keypoints)
        outside = self.ways[way].outside(keypoints)
        close = () if vote >= CLOSE_VOTE else (CLOSE_NOTE.format(vote),)
        return (*close, *((OUTSIDE_NOTE.format(outside),) if outside > FAR_OUTSIDE else ()))

    @abstractmethod
    def queries(self, keypoints: FloatArray) -> list[Query]:
        """What to ask for a scene with ``keypoints (K, 3)``, metres."""

    @abstractmethod
    def read(self, query_index: int, text: str) -> FloatArray | None:
        """The numbers of an answer to that query; None where they cannot be read for certain."""

    @abstractmethod
    def trajectory(self, answers: Sequence[FloatArray], keypoints: FloatArray) -> Trajectory:
        """The trajectory of one answer to each query, as `read`, in the scene of ``keypoints (K, 3)``."""

    def checked(self, keypoints: FloatArray) -> FloatArray:
        """``keypoints`` as an array; raises `InvalidValueError` unless they are ``(K, 3)`` and finite."""
        return checked_array("keypoints", keypoints, str(self.keypoints.shape[1:]))
