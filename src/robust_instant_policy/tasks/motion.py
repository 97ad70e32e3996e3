"""From waypoints to joint commands, with every check made before anything moves.

home ──lead-in──▶ waypoint 0 ──1/rate──▶ waypoint 1 ──▶ … ──▶ last ──settle──▶ judged
                                 └ where a gripper's state changes, the arms wait for the fingers

All arms of a task keep the same time: what slows one of them down slows down the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from robust_instant_policy.errors import UnreachableError
from robust_instant_policy.geometry import FloatArray, GripperTriangle
from robust_instant_policy.tasks.kinematics import Kinematics
from robust_instant_policy.trajectory import Trajectory

LEAD_IN_SPEED_M_S = 0.35  # from home to the first waypoint
GRIPPER_SECONDS = 0.45  # to open or close fully, with a margin
SETTLE_SECONDS = 0.5  # at the last waypoint, before success is judged

FLIP_RAD = 0.6  # a joint change between commands 20 ms apart that only a leap across a singularity makes
REACH_TOLERANCE_M = 5e-3
TABLE_TOLERANCE_M = 0.012  # fingertips commanded deeper than this into the table are refused
TRIPLET_TOLERANCE_M = 0.05  # rms misfit beyond which three points are no gripper
HANDS_APART_M = 0.06  # between the lines from palm to fingertips of two grippers
CLOSED = 0.5  # gripper states above this count as closed


@dataclass(frozen=True, eq=False)
class Arm:
    """What the executor has to know of an arm with a parallel gripper.

    ``name`` as the task calls it; ``home (J,)`` joint angles in rad; ``finger_travel`` of each finger from closed (0)
    to open, in metres, and ``finger_speed``, m/s; ``joint_speed`` rad/s and ``tool_speed`` m/s are limits;
    ``turn_tolerance``, rad, is how far the tool may be turned from what was asked for.
    """

    name: str
    kinematics: Kinematics
    home: FloatArray
    triangle: GripperTriangle
    finger_travel: float
    finger_speed: float
    joint_speed: float
    tool_speed: float
    turn_tolerance: float

    @property
    def home_pose(self) -> FloatArray:
        """Tool pose ``(4, 4)`` at home."""
        return self.kinematics.tool_pose(self.home)


@dataclass(frozen=True, eq=False)
class Motion:
    """Commands for A arms, one a control step: joint angles ``(N, A, J)`` rad, finger travel ``(N, A)`` m.

    ``poses (N, A, 4, 4)`` and ``closed (N, A)`` bool are the tool poses and gripper states meant by them.
    """

    joints: FloatArray
    fingers: FloatArray
    poses: FloatArray
    closed: np.ndarray

    @classmethod
    def at_home(cls, arms: Sequence[Arm]) -> Motion:
        """One step of standing still at home, hands open."""
        return cls(
            np.stack([arm.home for arm in arms])[None],
            np.array([[arm.finger_travel for arm in arms]]),
            np.stack([arm.home_pose for arm in arms])[None],
            np.zeros((1, len(arms)), dtype=bool),
        )

    @property
    def commands(self) -> FloatArray:
        """``(N, A·(J + 1))``: of one arm after the other the joint angles and the finger travel."""
        return np.concatenate([self.joints, self.fingers[..., None]], axis=-1).reshape(len(self.joints), -1)


def plan_waypoints(trajectory: Trajectory, arms: Sequence[Arm], execute_hz: float, rate_hz: float) -> Motion:
    """Motion from home along ``trajectory``'s waypoints at ``execute_hz``, with stops where a gripper acts.

    Raises `UnreachableError` naming the first waypoint that an arm cannot or must not go to.
    """
    waypoints = _tool_poses(trajectory, arms)
    schedule = _Schedule(np.stack([arm.home_pose for arm in arms]), 1 / execute_hz)
    first = waypoints[0]
    over = first.copy()  # travel at the height of the higher one, then go down
    over[:, 2, 3] = np.maximum(schedule.poses[-1][:, 2, 3], first[:, 2, 3])
    for poses in (over, first):
        schedule.go(poses, 0, LEAD_IN_SPEED_M_S)
    speed = min(arm.tool_speed for arm in arms)
    for step, (poses, shut) in enumerate(zip(waypoints, trajectory.gripper_state > CLOSED, strict=True)):
        if step:
            schedule.go(poses, step, speed / 2)  # the cubic is up to twice as fast as its mean
        if (shut != schedule.closed[-1]).any():
            schedule.wait(GRIPPER_SECONDS, shut)
    schedule.wait(SETTLE_SECONDS, schedule.closed[-1])

    end = schedule.times[-1]
    at = np.arange(0.0, end + 0.5 / rate_hz, 1 / rate_hz).clip(max=end)
    arriving = np.searchsorted(schedule.times, at, side="left").clip(max=len(schedule.times) - 1)
    leaving = (np.searchsorted(schedule.times, at, side="right") - 1).clip(min=0)
    path = _smooth(np.array(schedule.times), np.array(schedule.poses), at)
    closed, steps = np.array(schedule.closed)[leaving], np.array(schedule.steps)[arriving]
    return plan_poses(path, closed, arms, rate_hz, steps)


def plan_onward(
    waypoints: ArrayLike, waypoint_hz: float, before: Motion, arms: Sequence[Arm], rate_hz: float
) -> Motion:
    """Motion from the end of the one ``before`` through ``waypoints (N, 10·A)``, one every ``1 / waypoint_hz`` seconds.

    Legs longer than a tool may go in that time take longer; nobody waits for the fingers.
    Raises `UnreachableError` like `plan_waypoints`.
    """
    trajectory = Trajectory.from_actions(waypoints)
    knots = np.concatenate([before.poses[-1:], _tool_poses(trajectory, arms)])
    distance = np.linalg.norm(np.diff(knots[:, :, :3, 3], axis=0), axis=2)
    slowest = (distance / [arm.tool_speed / 2 for arm in arms]).max(axis=1)
    seconds = np.maximum(1 / waypoint_hz, slowest)
    ends = np.cumsum(np.maximum(np.round(seconds * rate_hz), 1)).astype(int)
    at = np.arange(1, ends[-1] + 1)
    steps = np.searchsorted(ends, at)
    closed = trajectory.gripper_state[steps] > CLOSED
    return plan_poses(_smooth(np.append(0, ends), knots, at), closed, arms, rate_hz, steps, before)


def _tool_poses(trajectory: Trajectory, arms: Sequence[Arm]) -> FloatArray:
    """Tool poses ``(T, A, 4, 4)``, known to be those of grippers above the table."""
    if trajectory.num_arms != len(arms):
        names = " and ".join(arm.name for arm in arms)
        raise UnreachableError(f"the trajectory is for {trajectory.num_arms} grippers, this task has {names}")
    poses = np.stack([arm.triangle.poses(trajectory.triplets[:, i]) for i, arm in enumerate(arms)], axis=1)
    points = np.stack([arm.triangle.triplets(poses[:, i]) for i, arm in enumerate(arms)], axis=1)
    misfit = np.sqrt(((points - trajectory.triplets) ** 2).sum(axis=-1).mean(axis=-1))
    what = "three points that are no gripper, {:.0f} mm off its shape"
    _refuse(misfit > TRIPLET_TOLERANCE_M, what, misfit * 1e3, arms)
    depth = -points[..., 2].min(axis=-1)
    _refuse(depth > TABLE_TOLERANCE_M, "fingers {:.0f} mm inside the table", depth * 1e3, arms)
    return poses


class _Schedule:
    """When the tools are to be where: poses ``(A, 4, 4)`` at increasing times, from ``start`` at time 0, hands open.

    ``interval`` is the time between waypoints in seconds; ``closed (A,)`` the gripper command from each time on,
    ``steps`` the waypoint that each set of poses belongs to.
    """

    def __init__(self, start: FloatArray, interval: float):
        self._interval = interval
        self.times, self.poses, self.steps = [0.0], [start], [0]
        self.closed: list[np.ndarray] = [np.zeros(len(start), dtype=bool)]

    def go(self, poses: FloatArray, step: int, speed: float) -> None:
        """Go on to ``poses`` in the time between waypoints, or slower where that would take more than ``speed`` m/s."""
        distance = float(np.linalg.norm(poses[:, :3, 3] - self.poses[-1][:, :3, 3], axis=1).max())
        self._add(poses, max(self._interval, distance / speed), step)

    def wait(self, seconds: float, shut: np.ndarray) -> None:
        """Stay for ``seconds``, with the hands commanded ``shut`` or open from the beginning of them."""
        self.closed[-1] = shut
        self._add(self.poses[-1], seconds, self.steps[-1])

    def _add(self, poses: FloatArray, seconds: float, step: int) -> None:
        self.times.append(self.times[-1] + seconds)
        self.poses.append(poses)
        self.closed.append(self.closed[-1])
        self.steps.append(step)


def plan_poses(
    poses: FloatArray,
    closed: np.ndarray,
    arms: Sequence[Arm],
    rate_hz: float,
    steps: np.ndarray | None = None,
    before: Motion | None = None,
) -> Motion:
    """Motion through tool ``poses (N, A, 4, 4)`` at ``rate_hz``, slowed down where a joint would be too fast.

    ``closed (N, A)`` is the gripper command, ``steps (N,)`` the waypoint that poses lead to, for the error messages.
    It starts where the motion ``before`` ends, or at home.
    """
    before = Motion.at_home(arms) if before is None else before
    steps = np.arange(len(poses)) if steps is None else steps
    _refuse_meeting(poses, arms, steps)
    paths = [arm.kinematics.follow(poses[:, i], before.joints[-1, i]) for i, arm in enumerate(arms)]
    short = np.stack([path.position_error for path in paths], axis=1)
    turned = np.stack([path.rotation_error for path in paths], axis=1)
    what = "a pose it cannot reach, it stays {:.0f} mm short"
    _refuse(short > REACH_TOLERANCE_M, what, short * 1e3, arms, steps)
    what = "a pose it cannot reach, it stays {:.0f} degrees off"
    _refuse(turned > [arm.turn_tolerance for arm in arms], what, np.rad2deg(turned), arms, steps)
    joints = np.stack([path.joints for path in paths], axis=1)
    change = np.abs(np.diff(joints, axis=0, prepend=before.joints[-1:])).max(axis=2)
    what = "an elbow or wrist that flips by {:.0f} degrees at once"
    _refuse(change > FLIP_RAD, what, np.rad2deg(change), arms, steps)
    count = np.maximum(np.ceil(change * rate_hz / [arm.joint_speed for arm in arms]).max(axis=1), 1).astype(int)
    position = np.repeat(np.arange(len(poses)), count) - 1 + np.concatenate([np.arange(1, n + 1) / n for n in count])
    columns = joints.reshape(len(poses), -1).T
    slowed = np.stack([np.interp(position, np.arange(len(poses)), column) for column in columns], axis=1)
    nearest = np.ceil(position - 1e-9).clip(0).astype(int)
    return Motion(
        slowed.reshape(-1, *joints.shape[1:]),
        _finger_ramp(closed[nearest], before.fingers[-1], arms, rate_hz),
        poses[nearest],
        closed[nearest],
    )


def _smooth(times: FloatArray, knots: FloatArray, at: FloatArray) -> FloatArray:
    """Poses ``(M, A, 4, 4)`` at times ``at (M,)`` through ``knots (K, A, 4, 4)``, without overshoot (monotone cubic;
    Fritsch and Carlson 1980)."""
    poses = np.tile(np.eye(4), (len(at), knots.shape[1], 1, 1))
    poses[..., :3, 3] = PchipInterpolator(times, knots[..., :3, 3])(at)
    for arm in range(knots.shape[1]):
        poses[:, arm, :3, :3] = Slerp(times, Rotation.from_matrix(knots[:, arm, :3, :3]))(at).as_matrix()
    return poses


def _finger_ramp(closed: np.ndarray, travel: FloatArray, arms: Sequence[Arm], rate_hz: float) -> FloatArray:
    """Finger travel ``(N, A)`` that follows the gripper command from ``travel (A,)`` on, no faster than hands can."""
    fingers = np.empty(closed.shape)
    most = np.array([arm.finger_speed for arm in arms]) / rate_hz
    wanted = np.where(closed, 0.0, [arm.finger_travel for arm in arms])
    for step, goal in enumerate(wanted):
        travel = travel + np.clip(goal - travel, -most, most)
        fingers[step] = travel
    return fingers


def _refuse_meeting(poses: FloatArray, arms: Sequence[Arm], steps: np.ndarray) -> None:
    """Refuse hands that would come too close to each other: between palm and fingertips nothing may be near."""
    share = np.linspace(0.0, 1.0, 7)[:, None]
    lines = [
        poses[:, i, None, :3, 3] - share * arm.triangle.length * poses[:, i, None, :3, 2] for i, arm in enumerate(arms)
    ]
    for one, other in combinations(range(len(arms)), 2):
        apart = np.linalg.norm(lines[one][:, :, None] - lines[other][:, None], axis=-1).min(axis=(1, 2))
        what = f"a place {{:.0f}} mm from the {arms[other].name} one"
        _refuse((apart < HANDS_APART_M)[:, None], what, 1e3 * apart[:, None], arms[one : one + 1], steps)


def _refuse(
    bad: np.ndarray, what: str, amount: np.ndarray, arms: Sequence[Arm], steps: np.ndarray | None = None
) -> None:
    """Raise for the first row of ``bad (N, A)`` bool that is not clean, in words, with its ``amount (N, A)``."""
    if bad.any():
        first, arm = np.argwhere(bad)[0]
        step = first if steps is None else int(steps[first])
        reason = what.format(amount[first, arm])
        raise UnreachableError(f"step {step} of the trajectory asks the {arms[arm].name} gripper for {reason}")
