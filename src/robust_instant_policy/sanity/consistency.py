"""Does what the images show around the gripper repeat from demonstration to demonstration?

At some moment of a task the gripper is always at the same place of the same thing. So the solid space that an image
shows around the gripper, seen in the gripper's own frame, must repeat across demonstrations, whatever the task; a
wrong camera, image or pairing makes it random. No threshold in metres is needed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robust_instant_policy.geometry import FloatArray, GripperTriangle
from robust_instant_policy.sanity.view import View
from robust_instant_policy.trajectory import Trajectory, downsample

MOMENTS = 30  # of a demonstration, gripper changes kept
HALF_WIDTH_M = 0.1  # of the square in which the surroundings are sampled, in the plane of the fingers
CELLS = 11  # samples along a side
AHEAD_M = (0.0, 0.03)  # of the fingertips, along the approach
SURFACE_M = 0.005  # this far in front of a surface still counts as inside
MIN_FILLED = 0.8  # share of demonstrations that must show something at a moment
MIN_DEMONSTRATIONS = 3  # with fewer nothing can repeat

_SIDE = np.linspace(-HALF_WIDTH_M, HALF_WIDTH_M, CELLS)
_SAMPLES = np.stack(np.meshgrid(_SIDE, _SIDE, AHEAD_M, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Consistency:
    """``score`` from 0 (unrelated) to 1 (the same every time), the mean over the arms; NaN with too few
    demonstrations. ``likeness (I,)`` says how like the others' each demonstration's surroundings are, 0 to 1."""

    score: float
    likeness: FloatArray


def gripper_poses(trajectories: Sequence[Trajectory]) -> list[FloatArray]:
    """Tool poses ``(T, A, 4, 4)`` of every trajectory, the same number T for all.

    They are taken at `MOMENTS` moments in time, and, since a person takes more or less time for the same way, at as
    many distances along each gripper's path before its end.
    """
    thinned = [downsample(trajectory, "masked", MOMENTS) for trajectory in trajectories]
    count = min(len(trajectory) for trajectory in thinned)
    ways = [_way(trajectory) for trajectory in trajectories]
    before_end = np.linspace(np.min([way[-1] for way in ways], axis=0), 0.0, MOMENTS)  # (MOMENTS, A)
    result = []
    for trajectory, thin, way in zip(trajectories, thinned, ways, strict=True):
        steps = np.round(np.linspace(0, len(thin) - 1, count)).astype(np.intp)
        arms = range(trajectory.num_arms)
        at = np.stack([np.searchsorted(way[:, arm], (way[-1] - before_end)[:, arm]) for arm in arms], axis=1)
        triplets = np.concatenate([thin.triplets[steps], trajectory.triplets[at.clip(max=len(way) - 1), arms]])
        result.append(GripperTriangle.from_triplets(triplets).poses(triplets))
    return result


def _way(trajectory: Trajectory) -> FloatArray:
    """How far each gripper went until each step ``(T, A)``, metres."""
    middles = trajectory.triplets[:, :, 1:].mean(axis=2)
    return np.linalg.norm(np.diff(middles, axis=0, prepend=middles[:1]), axis=-1).cumsum(axis=0)


def surroundings(view: View, poses: FloatArray) -> FloatArray:
    """What is solid around the gripper ``(T, A, N)``, 0 or 1, at ``poses (T, A, 4, 4)``."""
    points = _SAMPLES @ np.swapaxes(poses[..., :3, :3], -1, -2) + poses[..., None, :3, 3]
    behind, raised = view.behind_surface(points.reshape(-1, 3))
    solid = raised & (np.nan_to_num(behind, nan=-1.0) >= -SURFACE_M)
    return solid.reshape(points.shape[:-1]).astype(np.float64)


def repetition(views: Sequence[View], poses: Sequence[FloatArray]) -> Consistency:
    """How well what ``views`` show around the gripper at its ``poses`` (one ``(T, A, 4, 4)`` a view) repeats.

    Round things are touched from any side: the gripper's own frame, or one with the first demonstration's axes at the
    gripper's place, whichever repeats better.
    """
    common = [pose.copy() for pose in poses]
    for pose in common:
        pose[..., :3, :3] = poses[0][..., :3, :3]
    both = (consistency([surroundings(v, p) for v, p in zip(views, some, strict=True)]) for some in (poses, common))
    return max(both, key=lambda found: np.nan_to_num(found.score))


def consistency(solid: Sequence[FloatArray]) -> Consistency:
    """How well ``solid``, the `surroundings` of each demonstration, repeat at the best moment of each arm.

    With occupancies o_i of n demonstrations at one moment, the score is the share of their power that is common:
    (n |mean o|² / mean |o|² - 1) / (n - 1), which is 1 for equal ones and about 0 for unrelated sparse ones.
    """
    count = len(solid)
    if count < MIN_DEMONSTRATIONS:
        return Consistency(float("nan"), np.ones(count))
    stack = np.stack(solid)  # (I, T, A, N)
    power = (stack**2).sum(axis=-1).mean(axis=0)
    common = (stack.mean(axis=0) ** 2).sum(axis=-1)
    score = (count * common / np.maximum(power, 1e-9) - 1) / (count - 1)
    score[(stack.any(axis=-1).mean(axis=0)) < MIN_FILLED] = 0.0
    best = score.argmax(axis=0)
    likeness = np.zeros(count)
    for arm, moment in enumerate(best):
        usual = stack[:, moment, arm]
        others = (usual.sum(axis=0) - usual) / (count - 1)
        near = stack[:, max(moment - 1, 0) : moment + 2, arm]  # a demonstration may be a moment early or late
        norms = np.linalg.norm(near, axis=-1) * np.linalg.norm(others, axis=-1)[:, None]
        likeness += ((near * others[:, None]).sum(axis=-1) / np.maximum(norms, 1e-9)).max(axis=1) / len(best)
    return Consistency(float(score.max(axis=0).clip(0).mean()), likeness)
