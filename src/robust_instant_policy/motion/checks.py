"""The checks of every motion before an arm moves. Each raises `UnreachableError` for the first step that fails."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from robust_instant_policy.errors import UnreachableError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.kinematics import JointPath
from robust_instant_policy.trajectory import Trajectory

MAX_JOINT_CHANGE_RAD = 0.6  # between commands 20 ms apart; more happens only at a jump across a singularity
REACH_TOLERANCE_M = 5e-3  # largest accepted position error of the inverse kinematics
TABLE_TOLERANCE_M = 0.012  # deepest accepted fingertip target below the table plane z = 0
TRIPLET_TOLERANCE_M = 0.05  # largest accepted rms misfit between a triplet and the gripper's triangle
MIN_GRIPPER_DISTANCE_M = 0.06  # between the lines from gripper point to fingertips of two grippers
LINE_SAMPLES = 7  # points on each of these lines


def gripper_poses(trajectory: Trajectory, arms: Sequence[Arm]) -> FloatArray:
    """Tool poses ``(T, A, 4, 4)`` of triplets that fit the grippers and stay above the table."""
    if trajectory.num_arms != len(arms):
        names = " and ".join(arm.name for arm in arms)
        raise UnreachableError(f"the trajectory is for {trajectory.num_arms} grippers, this task has {names}")
    poses = np.stack([arm.triangle.poses(trajectory.triplets[:, i]) for i, arm in enumerate(arms)], axis=1)
    points = np.stack([arm.triangle.triplets(poses[:, i]) for i, arm in enumerate(arms)], axis=1)
    misfit = np.sqrt(((points - trajectory.triplets) ** 2).sum(axis=-1).mean(axis=-1))
    what = "three points that miss the gripper's shape by {:.0f} mm"
    _refuse(misfit > TRIPLET_TOLERANCE_M, what, misfit * 1e3, arms)
    depth = -points[..., 2].min(axis=-1)
    _refuse(depth > TABLE_TOLERANCE_M, "fingertips {:.0f} mm inside the table", depth * 1e3, arms)
    return poses


def check_clearance(poses: FloatArray, arms: Sequence[Arm], steps: np.ndarray) -> None:
    """Refuse tool ``poses (N, A, 4, 4)`` with two grippers too close to each other; forearms are not checked."""
    share = np.linspace(0.0, 1.0, LINE_SAMPLES)[:, None]
    lines = [
        poses[:, i, None, :3, 3] - share * arm.triangle.length * poses[:, i, None, :3, 2] for i, arm in enumerate(arms)
    ]
    for one, other in combinations(range(len(arms)), 2):
        apart = np.linalg.norm(lines[one][:, :, None] - lines[other][:, None], axis=-1).min(axis=(1, 2))
        what = f"a position {{:.0f}} mm from the {arms[other].name} one"
        _refuse((apart < MIN_GRIPPER_DISTANCE_M)[:, None], what, 1e3 * apart[:, None], arms[one : one + 1], steps)


def check_reach(paths: Sequence[JointPath], arms: Sequence[Arm], steps: np.ndarray) -> None:
    """Refuse poses with too large an error of the inverse kinematics."""
    position = np.stack([path.position_error for path in paths], axis=1)
    rotation = np.stack([path.rotation_error for path in paths], axis=1)
    what = "a pose it cannot reach (position error {:.0f} mm)"
    _refuse(position > REACH_TOLERANCE_M, what, position * 1e3, arms, steps)
    what = "a pose it cannot reach (orientation error {:.0f} degrees)"
    _refuse(rotation > [arm.turn_tolerance for arm in arms], what, np.rad2deg(rotation), arms, steps)


def check_joint_changes(change: FloatArray, arms: Sequence[Arm], steps: np.ndarray) -> None:
    """Refuse joint ``change (N, A)`` rad per control step so large that the solution of the kinematics jumps."""
    what = "a jump of a joint by {:.0f} degrees"
    _refuse(change > MAX_JOINT_CHANGE_RAD, what, np.rad2deg(change), arms, steps)


def _refuse(
    bad: np.ndarray, what: str, amount: np.ndarray, arms: Sequence[Arm], steps: np.ndarray | None = None
) -> None:
    """Raise an error for the first true value of ``bad (N, A)`` bool, with ``what`` formatted by ``amount (N, A)``."""
    if bad.any():
        first, arm = np.argwhere(bad)[0]
        step = first if steps is None else int(steps[first])
        reason = what.format(amount[first, arm])
        raise UnreachableError(f"step {step} of the trajectory asks the {arms[arm].name} gripper for {reason}")
