"""Waypoint timing: from a trajectory to joint commands at the control rate.

home ──lead-in──▶ waypoint 0 ──1/rate──▶ waypoint 1 ──▶ … ──▶ last ──settle──▶ success is judged
                                 └ dwell where a gripper's state changes

All arms of a task share one clock: the slowest arm determines the duration of a segment.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.arm import Arm, Motion
from robust_instant_policy.motion.checks import check_clearance, check_joint_changes, check_reach, gripper_poses
from robust_instant_policy.trajectory import Trajectory

LEAD_IN_SPEED_M_S = 0.35  # from home to the first waypoint
GRIPPER_SECONDS = 0.45  # to open or close completely, with a margin
SETTLE_SECONDS = 0.5  # at the last waypoint, before success is judged
CLOSED = 0.5  # gripper states above this count as closed


def plan_waypoints(trajectory: Trajectory, arms: Sequence[Arm], execute_hz: float, rate_hz: float) -> Motion:
    """Motion from home along ``trajectory``'s waypoints at ``execute_hz``, and a dwell at gripper changes.

    Raises `UnreachableError` that names the first refused waypoint.
    """
    waypoints = gripper_poses(trajectory, arms)
    schedule = _Schedule(np.stack([arm.home_pose for arm in arms]), 1 / execute_hz)
    first = waypoints[0]
    over = first.copy()  # travel at the larger of the two heights, then descend
    over[:, 2, 3] = np.maximum(schedule.poses[-1][:, 2, 3], first[:, 2, 3])
    for poses in (over, first):
        schedule.go(poses, 0, LEAD_IN_SPEED_M_S)
    speed = min(arm.tool_speed for arm in arms)
    for step, (poses, closed) in enumerate(zip(waypoints, trajectory.gripper_state > CLOSED, strict=True)):
        if step:
            schedule.go(poses, step, speed / 2)  # the cubic is up to twice as fast as its mean
        if (closed != schedule.closed[-1]).any():
            schedule.dwell(GRIPPER_SECONDS, closed)
    schedule.dwell(SETTLE_SECONDS, schedule.closed[-1])

    end = schedule.times[-1]
    at = np.arange(0.0, end + 0.5 / rate_hz, 1 / rate_hz).clip(max=end)
    arriving = np.searchsorted(schedule.times, at, side="left").clip(max=len(schedule.times) - 1)
    leaving = (np.searchsorted(schedule.times, at, side="right") - 1).clip(min=0)
    path = _interpolate(np.array(schedule.times), np.array(schedule.poses), at)
    closed, steps = np.array(schedule.closed)[leaving], np.array(schedule.steps)[arriving]
    return plan_poses(path, closed, arms, rate_hz, steps)


def plan_onward(
    waypoints: ArrayLike, waypoint_hz: float, before: Motion, arms: Sequence[Arm], rate_hz: float
) -> Motion:
    """Motion from the end of ``before`` through ``waypoints (N, 10·A)``, one every ``1 / waypoint_hz`` seconds.

    Segments above the tool's speed limit take longer; there is no dwell on gripper changes.
    Raises `UnreachableError` like `plan_waypoints`.
    """
    trajectory = Trajectory.from_actions(waypoints)
    knots = np.concatenate([before.poses[-1:], gripper_poses(trajectory, arms)])
    distance = np.linalg.norm(np.diff(knots[:, :, :3, 3], axis=0), axis=2)
    slowest = (distance / [arm.tool_speed / 2 for arm in arms]).max(axis=1)
    seconds = np.maximum(1 / waypoint_hz, slowest)
    ends = np.cumsum(np.maximum(np.round(seconds * rate_hz), 1)).astype(int)
    at = np.arange(1, ends[-1] + 1)
    steps = np.searchsorted(ends, at)
    closed = trajectory.gripper_state[steps] > CLOSED
    return plan_poses(_interpolate(np.append(0, ends), knots, at), closed, arms, rate_hz, steps, before)


class _Schedule:
    """Tool poses ``(A, 4, 4)`` at increasing times, from ``start`` at time 0 with open grippers.

    ``interval`` is the time between waypoints in seconds; ``closed (A,)`` the gripper command from each time on;
    ``steps`` the waypoint index of each set of poses.
    """

    def __init__(self, start: FloatArray, interval: float):
        self._interval = interval
        self.times, self.poses, self.steps = [0.0], [start], [0]
        self.closed: list[np.ndarray] = [np.zeros(len(start), dtype=bool)]

    def go(self, poses: FloatArray, step: int, speed: float) -> None:
        """Move to ``poses`` in one interval, or longer if that would exceed ``speed`` m/s."""
        distance = float(np.linalg.norm(poses[:, :3, 3] - self.poses[-1][:, :3, 3], axis=1).max())
        self._add(poses, max(self._interval, distance / speed), step)

    def dwell(self, seconds: float, closed: np.ndarray) -> None:
        """Stay for ``seconds``, with the gripper command ``closed (A,)`` from the start."""
        self.closed[-1] = closed
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
    """Motion through tool ``poses (N, A, 4, 4)`` at ``rate_hz``, slowed down at the joints' speed limits.

    ``closed (N, A)`` is the gripper command, ``steps (N,)`` the next waypoint of each pose, for error messages.
    The motion starts at the end of the motion ``before``, or at home.
    """
    before = Motion.at_home(arms) if before is None else before
    steps = np.arange(len(poses)) if steps is None else steps
    check_clearance(poses, arms, steps)
    paths = [arm.kinematics.follow(poses[:, i], before.joints[-1, i]) for i, arm in enumerate(arms)]
    check_reach(paths, arms, steps)
    joints = np.stack([path.joints for path in paths], axis=1)
    change = np.abs(np.diff(joints, axis=0, prepend=before.joints[-1:])).max(axis=2)
    check_joint_changes(change, arms, steps)
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


def _interpolate(times: FloatArray, knots: FloatArray, at: FloatArray) -> FloatArray:
    """Poses ``(M, A, 4, 4)`` at times ``at (M,)`` through ``knots (K, A, 4, 4)``, without overshoot.

    Positions by monotone cubics (Fritsch and Carlson 1980), rotations by spherical linear interpolation.
    """
    poses = np.tile(np.eye(4), (len(at), knots.shape[1], 1, 1))
    poses[..., :3, 3] = PchipInterpolator(times, knots[..., :3, 3])(at)
    for arm in range(knots.shape[1]):
        poses[:, arm, :3, :3] = Slerp(times, Rotation.from_matrix(knots[:, arm, :3, :3]))(at).as_matrix()
    return poses


def _finger_ramp(closed: np.ndarray, travel: FloatArray, arms: Sequence[Arm], rate_hz: float) -> FloatArray:
    """Finger travel ``(N, A)`` that follows the gripper command from ``travel (A,)`` on, within the fingers' speed."""
    fingers = np.empty(closed.shape)
    most = np.array([arm.finger_speed for arm in arms]) / rate_hz
    wanted = np.where(closed, 0.0, [arm.finger_travel for arm in arms])
    for step, goal in enumerate(wanted):
        travel = travel + np.clip(goal - travel, -most, most)
        fingers[step] = travel
    return fingers
