"""The numbers of a trajectory, each step of each arm in a frame of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.context.choice import choose_frames
from robust_instant_policy.context.codec import MM
from robust_instant_policy.context.frames import WORLD_FRAME, Frame, FrameUse, runs
from robust_instant_policy.context.joins import joined, shown_jumps
from robust_instant_policy.context.prediction import ShownHands
from robust_instant_policy.context.things import DEMOS_TO_TELL_THINGS, WORLD, Thing, locate
from robust_instant_policy.context.ways import Ranking
from robust_instant_policy.geometry import FloatArray, invert_pose, transform_points
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX

LEAST_RANGE = 0.001  # metres of a distance, or of a relative size: a smaller range that was shown counts as this one


@dataclass(frozen=True, eq=False)
class StepFrames:
    """``arms[a][t]`` is the frame in which step t of arm a is written.

    The numbers of a step are, for each arm: the point between the fingertips, then the gripper point and the first
    fingertip relative to it (millimetres, in the step's frame), and the gripper state. ``jumps`` are those of each arm
    that were demonstrated (`shown_jumps`); none are needed where no frame changes. ``error``, metres, is that with
    which frames that are fitted to the other demonstrations predict one at the gripper change that they explain worst;
    NaN for too few demonstrations, or without gripper changes.
    """

    arms: tuple[tuple[Frame, ...], ...]
    ranking: Ranking | None = None
    jumps: tuple[FloatArray, ...] = ()
    error: float = float("nan")

    @classmethod
    def world(cls, num_steps: int, num_arms: int) -> StepFrames:
        return cls(((WORLD_FRAME,) * num_steps,) * num_arms)

    @classmethod
    def adaptive(
        cls,
        keypoints: FloatArray,
        actions: FloatArray,
        key_steps: Sequence[int],
        things: Sequence[Thing],
        ranking: Ranking | None = None,
        second: NDArray[np.bool_] | None = None,
    ) -> StepFrames:
        """The frames in which demonstrations with ``keypoints (I, K, 3)``, named by ``ranking``, and aligned ``actions
        (I, T, 10·A)`` predict each other best; ``key_steps`` count more. For those of a ``second (I,)`` way see
        `ShownHands`."""
        scene, hands = locate([WORLD, *things], keypoints), hands_of(actions)
        arms = [ShownHands(hands[:, :, arm], second) for arm in range(hands.shape[2])]
        frames = tuple(tuple(choose_frames(things, scene, own, key_steps)) for own in arms)
        between = list(key_steps)[1:-1] if len(hands) >= DEMOS_TO_TELL_THINGS else []
        error = max((own[step].error for own in frames for step in between), default=float("nan"))
        return cls(frames, ranking, tuple(shown_jumps(own.points) for own in arms), error)

    @property
    def num_arms(self) -> int:
        return len(self.arms)

    @property
    def used(self) -> tuple[Frame, ...]:
        """The frames of different words."""
        return tuple({str(frame): frame for arm in self.arms for frame in arm}.values())

    def uses(self, keypoints: FloatArray) -> tuple[FrameUse, ...]:
        """Each run of frames that continue each other, in the scene of ``keypoints (K, 3)``."""
        (poses,) = self.poses(keypoints[None])
        return tuple(
            FrameUse(own[stop - 1].words_from(own[start]), arm, start, stop - 1, poses[stop - 1, arm])
            for arm, own in enumerate(self.arms)
            for start, stop in runs(own)
        )

    def outside(self, demonstrated: FloatArray, keypoints: FloatArray) -> float:
        """How far ``keypoints (K, 3)`` lie outside of the ``demonstrated (I, K, 3)`` scenes in what frames extrapolate.

        These are the distances between the two ends of an origin and of a line, and the sizes of things. The largest
        excess, as a share of the range that was shown.
        """
        ends = {frame.ends for frame in self.used}
        ends |= {tuple(end.thing for end in frame.axes.ends) for frame in self.used}
        pairs = list(dict.fromkeys(pair for own in ends for pair in combinations(own, 2)))
        sizes = {thing for frame in self.used for thing, _ in frame.growth}
        every = self.named(np.stack([*demonstrated, keypoints]))
        scene = locate([thing for own in [*pairs, tuple(sizes)] for thing in own], every)
        values = [np.linalg.norm(scene[a].position - scene[b].position, axis=1) for a, b in pairs]
        values += [scene[thing].size for thing in sizes]
        return float(max((_excess(own[:-1], own[-1]) for own in values), default=0.0))

    def poses(self, keypoints: FloatArray) -> FloatArray:
        """Pose of each step's frame ``(I, T, A, 4, 4)`` in the scenes of ``keypoints (I, K, 3)``."""
        frames = [frame for of_step in zip(*self.arms, strict=True) for frame in of_step]
        things = [thing for frame in frames for thing in frame.things]
        scenes = (locate(things, points[None]) for points in self.named(keypoints))
        poses = np.stack([[frame.pose_in(scene)[0] for frame in frames] for scene in scenes])
        return poses.reshape(len(keypoints), -1, self.num_arms, 4, 4)

    def named(self, keypoints: FloatArray) -> FloatArray:
        """``keypoints (I, K, 3)`` in the order in which the frames count them, see `Ranking.renamed`."""
        return keypoints if self.ranking is None else self.ranking.renamed(keypoints)

    def encode(self, poses: FloatArray, actions: FloatArray) -> FloatArray:
        """The numbers ``(I, T, 10·A)`` of ``actions (I, T, 10·A)`` where the frames have `poses`."""
        local = transform_points(invert_pose(poses), hands_of(actions))
        gripper, left, right = np.moveaxis(local, -2, 0)
        centre = (left + right) / 2
        numbers = actions.reshape(*actions.shape[:2], self.num_arms, ACTION_DIM).copy()
        numbers[..., :STATE_INDEX] = MM * np.concatenate([centre, gripper - centre, left - centre], axis=-1)
        return numbers.reshape(actions.shape)

    def decode(self, keypoints: FloatArray, numbers: FloatArray) -> FloatArray:
        """The actions ``(T', 10·A)`` that the first T' steps' ``numbers`` mean in the scene of ``keypoints (K, 3)``.

        The inverse of `encode`, but without the jumps where frames change (`joins`).
        """
        rows = numbers.reshape(len(numbers), self.num_arms, ACTION_DIM).copy()
        (poses,) = self.poses(keypoints[None])
        points = transform_points(poses[: len(rows)], _points(rows / MM))
        rows[..., :STATE_INDEX] = points.reshape(*rows.shape[:2], STATE_INDEX)
        states = rows[..., STATE_INDEX] > 0.5
        switches = np.flatnonzero((states[1:] != states[:-1]).any(axis=1))
        key_steps = {0, len(rows) - 1, *switches, *(switches + 1)}
        for arm, (own, shown) in enumerate(zip(self.arms, self.jumps, strict=False)):
            if changes := [start for start, _ in runs(own[: len(rows)])[1:]]:
                errors = np.array([frame.error for frame in own[: len(rows)]])
                hands = joined(hands_of(rows[:, arm])[:, 0], errors, key_steps, changes, shown[: len(rows) - 1])
                rows[:, arm, :STATE_INDEX] = hands.reshape(len(rows), STATE_INDEX)
        return rows.reshape(len(numbers), -1)

    def variation(self, numbers: FloatArray) -> FloatArray | None:
        """Standard deviation ``(T,)``, metres, of a point's coordinate over the ``numbers (I, T, 10·A)``; None of one
        demonstration."""
        if len(numbers) == 1:
            return None
        points = _points(numbers.reshape(*numbers.shape[:2], self.num_arms, ACTION_DIM))
        return np.sqrt(points.var(axis=0, ddof=1).mean(axis=(1, 2, 3))) / MM

    def inputs(self, poses: FloatArray, keypoints: FloatArray) -> FloatArray:
        """``keypoints (I, K, 3)``, millimetres ``(I, T, A, 3·K)``, in each step's frame, where these have `poses`."""
        shown = transform_points(invert_pose(poses), self.named(keypoints)[:, None, None])
        return MM * shown.reshape(*poses.shape[:3], -1)


def _excess(shown: FloatArray, value: float) -> float:
    """By how much ``value`` lies outside of the range of the ``shown (I,)`` values, as a share of it."""
    low, high = float(shown.min()), float(shown.max())
    return max(low - value, value - high, 0.0) / max(high - low, LEAST_RANGE)


def hands_of(actions: FloatArray) -> FloatArray:
    """The gripper's three points ``(..., A, 3, 3)`` of ``actions (..., 10·A)``."""
    points = actions.reshape(*actions.shape[:-1], -1, ACTION_DIM)[..., :STATE_INDEX]
    return points.reshape(*points.shape[:-1], 3, 3)


def _points(numbers: FloatArray) -> FloatArray:
    """Gripper point and fingertips ``(..., 3, 3)`` in a frame, from an arm's numbers ``(..., 10)`` in it."""
    centre, gripper, left = np.moveaxis(numbers[..., :STATE_INDEX].reshape(*numbers.shape[:-1], 3, 3), -2, 0)
    return np.stack([centre + gripper, centre + left, centre - left], axis=-2)
