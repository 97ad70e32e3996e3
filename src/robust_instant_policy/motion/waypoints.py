"""Waypoint timing: from a trajectory to joint commands at the control rate.

home ──lead-in──▶ waypoint 0 ──1/rate──▶ waypoint 1 ──▶ … ──▶ last ──settle──▶ success is judged
                                 └ dwell where a gripper's state changes

All arms of a task share one clock: the slowest arm determines the duration of a segment.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from robust_instant_policy.geometry import FloatArray, interpolate, make_pose
from robust_instant_policy.motion.arm import Arm, Motion
from robust_instant_policy.motion.checks import check_clearance, check_joint_changes, check_reach, gripper_poses
from robust_instant_policy.trajectory import Trajectory

LEAD_IN_SPEED_M_S = 0.35  # from home to the first waypoint
GRIPPER_SECONDS = 0.45  # to open or close completely, with a margin; longer for slow fingers
GRIPPER_MARGIN = 1.1  # of that time over the one that the fingers need; simulated fingers need 0.4 s at most
SETTLE_SECONDS = 0.5  # at the last waypoint, before success is judged
CLOSED = 0.5  # gripper states above this count as closed


def plan_waypoints(trajectory: Trajectory, arms: Sequence[Arm], execute_hz: float, rate_hz: float) -> Motion:
    """Motion from home along ``trajectory``'s waypoints at ``execute_hz``, and a dwell at gripper changes.

    Raises `UnreachableError` that names the first refused waypoint.
    """
    waypoints = gripper_poses(trajectory, arms)
    start = Motion.at_home(arms)
    schedule = _Schedule(start, 1 / execute_hz)
    first = waypoints[0]
    over = first.copy()  # travel at the larger of the two heights, then descend
    over[:, 2, 3] = np.maximum(start.poses[-1][:, 2, 3], first[:, 2, 3])
    for poses in (over, first):
        schedule.go(poses, 0, LEAD_IN_SPEED_M_S)
    schedule.visit(waypoints, trajectory.gripper_state > CLOSED, arms, already_at_first=True)
    schedule.dwell(SETTLE_SECONDS, schedule.closed[-1])
    path, closed, steps = schedule.sampled(rate_hz, from_step=0)
    return plan_poses(path, closed, arms, rate_hz, steps)


def plan_onward(
    waypoints: ArrayLike, waypoint_hz: float, before: Motion, arms: Sequence[Arm], rate_hz: float
) -> Motion:
    """Motion from the end of ``before`` through ``waypoints (N, 10·A)``, one every ``1 / waypoint_hz`` seconds.

    Segments above the tool's speed limit take longer, and there is the dwell of `plan_waypoints` at gripper changes,
    so that closed and open loop give the fingers the same time. Raises `UnreachableError` like `plan_waypoints`.
    """
    trajectory = Trajectory.from_actions(waypoints)
    schedule = _Schedule(before, 1 / waypoint_hz)
    schedule.visit(gripper_poses(trajectory, arms), trajectory.gripper_state > CLOSED, arms)
    path, closed, steps = schedule.sampled(rate_hz, from_step=1)
    return plan_poses(path, closed, arms, rate_hz, steps, before)


class _Schedule:
    """Tool poses ``(A, 4, 4)`` at increasing times, from the end of the motion ``before`` at time 0.

    ``interval`` is the time between waypoints in seconds; ``closed (A,)`` the gripper command from each time on;
    ``steps`` the waypoint index of each set of poses.
    """

    def __init__(self, before: Motion, interval: float):
        self._interval = interval
        self.times, self.poses, self.steps = [0.0], [before.poses[-1]], [0]
        self.closed: list[np.ndarray] = [before.closed[-1]]

    def visit(
        self, waypoints: FloatArray, closed: np.ndarray, arms: Sequence[Arm], already_at_first: bool = False
    ) -> None:
        """Move through ``waypoints (N, A, 4, 4)``, with a dwell at each where a state of ``closed (N, A)`` changes."""
        speed = min(arm.tool_speed for arm in arms) / 2  # the cubic is up to twice as fast as its mean
        dwell = max(GRIPPER_SECONDS, GRIPPER_MARGIN * max(arm.finger_travel / arm.finger_speed for arm in arms))
        for step, (poses, wanted) in enumerate(zip(waypoints, closed, strict=True)):
            if step or not already_at_first:
                self.go(poses, step, speed)
            if (wanted != self.closed[-1]).any():
                self.dwell(dwell, wanted)

    def go(self, poses: FloatArray, step: int, speed: float) -> None:
        """Move to ``poses`` in one interval, or longer if that would exceed ``speed`` m/s."""
        distance = float(np.linalg.norm(poses[:, :3, 3] - self.poses[-1][:, :3, 3], axis=1).max())
        self._add(poses, max(self._interval, distance / speed), step)

    def dwell(self, seconds: float, closed: np.ndarray) -> None:
        """Stay for ``seconds``, with the gripper command ``closed (A,)`` from the start."""
        self.closed[-1] = closed
        self._add(self.poses[-1], seconds, self.steps[-1])

    def sampled(self, rate_hz: float, from_step: int) -> tuple[FloatArray, np.ndarray, np.ndarray]:
        """Poses ``(M, A, 4, 4)``, gripper commands ``(M, A)`` and next waypoints ``(M,)``, at ``rate_hz`` from the time
        ``from_step / rate_hz`` on."""
        end = self.times[-1]
        at = np.arange(from_step, np.floor(end * rate_hz + 0.5 - 1e-9) + 1) / rate_hz
        at = at.clip(max=end)
        arriving = np.searchsorted(self.times, at, side="left").clip(max=len(self.times) - 1)
        leaving = (np.searchsorted(self.times, at, side="right") - 1).clip(min=0)
        path = _interpolate(np.array(self.times), np.array(self.poses), at)
        return path, np.array(self.closed)[leaving], np.array(self.steps)[arriving]

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
    slowed = interpolate(position, np.arange(len(poses)), joints.reshape(len(poses), -1))
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
    arms = np.moveaxis(knots[..., :3, :3], 1, 0)
    rotations = [Slerp(times, Rotation.from_matrix(own))(at).as_matrix() for own in arms]
    return make_pose(np.stack(rotations, axis=1), PchipInterpolator(times, knots[..., :3, 3])(at))


def _finger_ramp(closed: np.ndarray, travel: FloatArray, arms: Sequence[Arm], rate_hz: float) -> FloatArray:
    """Finger travel ``(N, A)`` that follows the gripper command from ``travel (A,)`` on, within the fingers' speed."""
    fingers = np.empty(closed.shape)
    most = np.array([arm.finger_speed for arm in arms]) / rate_hz
    wanted = np.where(closed, 0.0, [arm.finger_travel for arm in arms])
    for step, goal in enumerate(wanted):
        travel = travel + np.clip(goal - travel, -most, most)
        fingers[step] = travel
    return fingers
