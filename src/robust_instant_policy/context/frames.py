"""Frames to write a step's numbers in, and the choice of the one in which the demonstrations agree best.

"4 cm above the cup" is the same numbers in every demonstration in the cup's frame, and different ones in the world
frame. Which frame suits changes over a task (first the cup, then the saucer). Candidates are the world, each keypoint,
rigid frames fitted to keypoints that keep their distances, and frames interpolated between two of these, for the motion
from one to the other. The Viterbi algorithm finds the sequence of frames with the smallest spread over the
demonstrations plus a cost for each transition.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from robust_instant_policy.geometry import FloatArray, fit_rigid, fit_upright, invert_pose, make_pose, transform_points

RIGID_SPREAD_M = 0.010  # keypoints whose distance varies less than this belong to the same object
DEMOS_TO_TELL_OBJECTS = 3  # with fewer, all distances look constant
DEMOS_FOR_MEDIANS = 5  # with fewer, an outlier cannot be identified
OUTLIER_M = 0.006  # residual at which a keypoint's influence on a fitted pose is halved
SHAPE_ROUNDS = 2  # iterations of fitting the demonstrations' keypoints to each other

# Costs of the choice of frames, in units of the logarithm of the spread.
SPREAD_FLOOR_M = 0.002  # differences of spread below this are noise
KEY_STEP_WEIGHT = 3.0  # weight of the first and last step and of gripper changes; 1 elsewhere
FEW_POINTS_COST = 0.5  # divided by the number of keypoints: prefer frames on many
TILT_COST = 0.1  # prefer upright frames
DISTANCE_COST_PER_M = 4.0  # divided by the number of demonstrations: prefer frames near the gripper
WORLD_DISTANCE_M = 0.25  # distance of the world frame from the gripper in that cost
INTERPOLATED_COST = 0.1  # prefer frames that are not interpolated
INTERPOLATED_COST_FEW_DEMOS = 1.0  # divided by the number of demonstrations: with few, some fit by chance
TRANSITION_COST = 1.0  # of a change of frame between two steps
ENDPOINT_TRANSITION_COST = 0.5  # of a transition between an interpolated frame and its endpoint
SAME_ENDPOINTS_TRANSITION_COST = 0.05  # of a transition between frames interpolated between the same endpoints

INTERPOLATION_SHARES = tuple(eighths / 8 for eighths in range(1, 8))
MAX_INTERPOLATED_OBJECTS = 3  # interpolated frames lie between these and the world

MAD_TO_STD = 1.4826

Kind = Literal["world", "keypoint", "upright", "rigid", "between"]


@dataclass(frozen=True, eq=False)
class Frame:
    """A coordinate system that can be found in any scene from its keypoints ``(K, 3)``.

    ``world`` is the world itself; ``keypoint`` keeps the world's axes with its origin at the keypoint; ``upright``
    also turns about the vertical with the keypoints ``members``, ``rigid`` in all directions. ``shape (N, 3)`` are
    the members' positions in the frame. ``between`` is interpolated: its origin at ``share`` of the segment from the
    first of ``ends`` to the second, its rotation at ``turn`` of the angle between them.
    """

    kind: Kind
    members: tuple[int, ...] = ()
    shape: FloatArray | None = None
    ends: tuple[Frame, Frame] | None = None
    share: float = 0.0
    turn: float = 0.0

    def pose(self, keypoints: FloatArray) -> FloatArray:
        """The frame's pose ``(4, 4)`` in the scene of ``keypoints (K, 3)``."""
        if self.kind == "world":
            return np.eye(4)
        if self.ends is not None:
            return _between(self.ends[0].pose(keypoints), self.ends[1].pose(keypoints), self.share, self.turn)
        points = keypoints[list(self.members)]
        if self.kind == "keypoint":
            return make_pose(np.eye(3), points[0])
        assert self.shape is not None
        return robust_fit(self.shape, points, upright=self.kind == "upright")

    def __str__(self) -> str:
        if self.kind == "world":
            return "world"
        if self.ends is not None:
            return f"{self.share:.0%} of the way from ({self.ends[0]}) to ({self.ends[1]}), turned {self.turn:.0%}"
        names = " ".join(str(member) for member in self.members)
        return f"keypoint {names}" if self.kind == "keypoint" else f"{self.kind} on keypoints {names}"

    def continues(self, other: Frame) -> bool:
        """Whether both are the same frame, or interpolated between the same ends with the same rule for rotation."""
        return self is other or (
            self.ends is not None and self.ends == other.ends and self._constant_turn == other._constant_turn
        )

    @property
    def _constant_turn(self) -> float | None:
        """``turn``, where it does not grow with ``share``."""
        return None if self.turn == self.share else self.turn


WORLD = Frame("world")


def robust_fit(shape: FloatArray, points: FloatArray, upright: bool) -> FloatArray:
    """Pose ``(4, 4)`` that maps ``shape (N, 3)`` onto ``points (N, 3)``, robust to a minority of outliers.

    The best of all minimal subsets, refined by iteratively reweighted least squares.
    """
    size = 2 if upright else 3
    fit = fit_upright if upright else fit_rigid
    if len(shape) > size:
        subsets = np.array(list(combinations(range(len(shape)), size)))
        starts = fit(shape[subsets], points[subsets], np.ones(subsets.shape))
        residuals = np.linalg.norm(_moved(starts, shape) - points, axis=-1)
        pose = starts[np.argmin((residuals**2 / (residuals**2 + OUTLIER_M**2)).sum(axis=-1))]
        for _ in range(5):
            residual = np.linalg.norm(transform_points(pose, shape) - points, axis=-1)
            pose = fit(shape, points, 1 / (1 + (residual / OUTLIER_M) ** 2) ** 2)
        return pose
    return fit(shape, points, np.ones(len(shape)))


def _between(first: FloatArray, second: FloatArray, share: float, turn: float) -> FloatArray:
    """The pose between two poses ``(..., 4, 4)`` whose axes differ by a turn about the vertical only."""
    relative = np.swapaxes(first[..., :3, :3], -1, -2) @ second[..., :3, :3]
    angle = np.asarray(turn * np.arctan2(relative[..., 1, 0], relative[..., 0, 0]))
    pose = _turned(angle)
    pose[..., :3, :3] = first[..., :3, :3] @ pose[..., :3, :3]
    pose[..., :3, 3] = (1 - share) * first[..., :3, 3] + share * second[..., :3, 3]
    return pose


def _turned(angle: FloatArray) -> FloatArray:
    """Poses ``(..., 4, 4)`` at the origin, turned about the vertical."""
    pose = np.zeros((*angle.shape, 4, 4))
    pose[..., 0, 0] = pose[..., 1, 1] = np.cos(angle)
    pose[..., 1, 0], pose[..., 0, 1] = np.sin(angle), -np.sin(angle)
    pose[..., 2, 2] = pose[..., 3, 3] = 1.0
    return pose


def _moved(poses: FloatArray, points: FloatArray) -> FloatArray:
    return points @ np.swapaxes(poses[..., :3, :3], -1, -2) + poses[..., None, :3, 3]


def candidate_frames(keypoints: FloatArray) -> list[Frame]:
    """Frames worth trying for demonstrations with ``keypoints (I, K, 3)``.

    Keypoints belong together when their distance is nearly the same in most demonstrations. Each keypoint gives a
    frame of its own, and upright and rigid frames on all that belong with it and on the nearest few of them. Frames
    are interpolated between the world and the objects, each the largest such frame.
    """
    num_demos, num_points = keypoints.shape[:2]
    frames = [WORLD, *(Frame("keypoint", (k,)) for k in range(num_points))]
    distances = np.linalg.norm(keypoints[:, :, None] - keypoints[:, None], axis=-1)
    varies = spread(distances)
    closeness = np.median(distances, axis=0)
    groups: dict[tuple[int, ...], None] = {}
    for k in range(num_points):
        if num_demos >= DEMOS_TO_TELL_OBJECTS:
            together = [j for j in range(num_points) if j == k or varies[k, j] < RIGID_SPREAD_M]
        else:
            together = list(range(num_points))
        near = sorted(together, key=lambda j: closeness[k, j])
        whole = len(near) if num_demos >= DEMOS_TO_TELL_OBJECTS else 0
        for size in {2, 3, 5, whole}:
            if 2 <= size <= len(near):
                groups[tuple(sorted(near[:size]))] = None
    for members in groups:
        if len(members) >= 2:
            frames.append(Frame("upright", members, _mean_shape(keypoints[:, list(members)], upright=True)))
        if len(members) >= 3:
            frames.append(Frame("rigid", members, _mean_shape(keypoints[:, list(members)], upright=False)))
    if num_demos >= DEMOS_TO_TELL_OBJECTS:
        for ends in combinations([WORLD, *_objects(frames)], 2):
            members = ends[0].members + ends[1].members
            for share in INTERPOLATION_SHARES:
                frames.extend(Frame("between", members, None, ends, share, turn) for turn in (0.0, share, 1.0))
    return frames


def _objects(frames: Sequence[Frame]) -> list[Frame]:
    """The upright frames on the most keypoints that share none, at most `MAX_INTERPOLATED_OBJECTS`."""
    objects: list[Frame] = []
    for frame in sorted(frames, key=lambda frame: -len(frame.members)):
        taken = {member for other in objects for member in other.members}
        if frame.kind == "upright" and taken.isdisjoint(frame.members):
            objects.append(frame)
    return objects[:MAX_INTERPOLATED_OBJECTS]


def poses_in(frames: Sequence[Frame], keypoints: FloatArray) -> FloatArray:
    """Pose of each of ``frames`` in each scene of ``keypoints (I, K, 3)``: ``(F, I, 4, 4)``."""
    known: dict[Frame, FloatArray] = {}  # interpolated frames share their ends

    def poses(frame: Frame) -> FloatArray:
        if frame not in known:
            if frame.ends is None:
                known[frame] = np.stack([frame.pose(points) for points in keypoints])
            else:
                first, second = frame.ends
                known[frame] = _between(poses(first), poses(second), frame.share, frame.turn)
        return known[frame]

    return np.stack([poses(frame) for frame in frames])


def _mean_shape(points: FloatArray, upright: bool) -> FloatArray:
    """The centred shape ``(N, 3)`` of which ``points (I, N, 3)`` are noisy, moved copies."""
    distances = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
    typical = int(np.argmin(np.abs(distances - np.median(distances, axis=0)).sum(axis=(1, 2))))
    shape = points[typical]
    for _ in range(SHAPE_ROUNDS):
        shape = shape - shape.mean(axis=0)
        poses = [robust_fit(shape, own, upright) for own in points]
        back = [transform_points(invert_pose(pose), own) for pose, own in zip(poses, points, strict=True)]
        shape = np.median(back, axis=0)
    return shape - shape.mean(axis=0)


def spread(values: FloatArray) -> FloatArray:
    """Standard deviation over the first axis; from `DEMOS_FOR_MEDIANS` values on from the median absolute deviation."""
    if len(values) < DEMOS_FOR_MEDIANS:
        return values.std(axis=0)
    return MAD_TO_STD * np.median(np.abs(values - np.median(values, axis=0)), axis=0)


def choose_frames(
    frames: Sequence[Frame], poses: FloatArray, points: FloatArray, key_steps: Sequence[int]
) -> list[int]:
    """Which of ``frames`` each step is written in.

    ``poses (F, I, 4, 4)`` are the frames in each demonstration's scene, ``points (I, T, P, 3)`` the gripper's points.
    Minimises the summed log spread of the points in their frames plus a cost for each transition (Viterbi).
    """
    inverse_rotation = np.swapaxes(poses[..., :3, :3], -1, -2)
    offset = points[None] - poses[:, :, None, None, :3, 3]
    local = np.einsum("fixy,fitpy->fitpx", inverse_rotation, offset)
    scatter = np.stack([np.sqrt((spread(values) ** 2).sum(axis=-1).mean(axis=-1)) for values in local])  # (F, T)
    distance = np.median(np.linalg.norm(offset, axis=-1).min(axis=-1), axis=1)  # (F, T)
    distance[[frame.kind == "world" for frame in frames]] = WORLD_DISTANCE_M
    cost = np.log(scatter + SPREAD_FLOOR_M) + DISTANCE_COST_PER_M / points.shape[0] * distance
    for own, frame in zip(cost, frames, strict=True):
        own += FEW_POINTS_COST / max(len(frame.members), 1) * (frame.kind != "world")
        own += TILT_COST * (frame.kind == "rigid")
        own += (INTERPOLATED_COST + INTERPOLATED_COST_FEW_DEMOS / points.shape[0]) * (frame.kind == "between")
    weight = np.ones(points.shape[1])
    weight[list(key_steps)] = KEY_STEP_WEIGHT
    cost = cost * weight

    transition = np.array([[_transition_cost(frame, other) for other in frames] for frame in frames])
    total = cost[:, 0]
    origin = np.zeros((len(frames), points.shape[1]), dtype=np.intp)
    for step in range(1, points.shape[1]):
        reached = total[:, None] + transition
        origin[:, step] = reached.argmin(axis=0)
        total = reached.min(axis=0) + cost[:, step]
    chosen = [int(np.argmin(total))]
    for step in range(points.shape[1] - 1, 0, -1):
        chosen.append(int(origin[chosen[-1], step]))
    return chosen[::-1]


def _transition_cost(frame: Frame, other: Frame) -> float:
    """The cost of writing one step in ``frame`` and the next in ``other``."""
    if frame is other:
        return 0.0
    if frame.continues(other):
        return SAME_ENDPOINTS_TRANSITION_COST
    to_endpoint = (frame.ends is not None and other in frame.ends) or (other.ends is not None and frame in other.ends)
    return ENDPOINT_TRANSITION_COST if to_endpoint else TRANSITION_COST
