"""From waypoints to joint commands, with every check made before anything moves.

home ──lead-in──▶ waypoint 0 ──1/rate──▶ waypoint 1 ──▶ … ──▶ last ──settle──▶ judged
                                 └ where the gripper state changes, the arm waits for the fingers
"""

from __future__ import annotations

from dataclasses import dataclass

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
    """Commands, one a control step: joint angles ``(N, J)`` rad, finger travel ``(N,)`` m.

    ``poses (N, 4, 4)`` and ``closed (N,)`` bool are the tool poses and gripper states meant by them.
    """

    joints: FloatArray
    fingers: FloatArray
    poses: FloatArray
    closed: np.ndarray

    @classmethod
    def at_home(cls, arm: Arm) -> Motion:
        """One step of standing still at home, hand open."""
        return cls(arm.home[None], np.array([arm.finger_travel]), arm.home_pose[None], np.zeros(1, dtype=bool))


def plan_waypoints(trajectory: Trajectory, arm: Arm, execute_hz: float, rate_hz: float) -> Motion:
    """Motion from home along ``trajectory``'s waypoints at ``execute_hz``, with stops where the gripper acts.

    Raises `UnreachableError` naming the first waypoint that the arm cannot or must not go to.
    """
    waypoints = _tool_poses(trajectory, arm)
    schedule = _Schedule(arm.home_pose, 1 / execute_hz)
    first = waypoints[0]
    over = first.copy()  # travel at the height of the higher one, then go down
    over[2, 3] = max(schedule.pose[2, 3], first[2, 3])
    for pose in (over, first):
        schedule.go(pose, 0, LEAD_IN_SPEED_M_S)
    for step, (pose, shut) in enumerate(zip(waypoints, trajectory.gripper_state[:, 0] > CLOSED, strict=True)):
        if step:
            schedule.go(pose, step, arm.tool_speed / 2)  # the cubic is up to twice as fast as its mean
        if shut != schedule.shut:
            schedule.wait(GRIPPER_SECONDS, bool(shut))
    schedule.wait(SETTLE_SECONDS, schedule.shut)

    end = schedule.times[-1]
    at = np.arange(0.0, end + 0.5 / rate_hz, 1 / rate_hz).clip(max=end)
    arriving = np.searchsorted(schedule.times, at, side="left").clip(max=len(schedule.times) - 1)
    leaving = (np.searchsorted(schedule.times, at, side="right") - 1).clip(min=0)
    poses = _smooth(np.array(schedule.times), np.array(schedule.poses), at)
    closed, steps = np.array(schedule.closed)[leaving], np.array(schedule.steps)[arriving]
    return plan_poses(poses, closed, arm, rate_hz, steps)


def plan_onward(waypoints: ArrayLike, waypoint_hz: float, before: Motion, arm: Arm, rate_hz: float) -> Motion:
    """Motion from the end of the one ``before`` through ``waypoints (N, 10)``, one every ``1 / waypoint_hz`` seconds.

    Legs longer than the tool may go in that time take longer; nobody waits for the fingers.
    Raises `UnreachableError` like `plan_waypoints`.
    """
    trajectory = Trajectory.from_actions(waypoints)
    knots = np.concatenate([before.poses[-1:], _tool_poses(trajectory, arm)])
    distance = np.linalg.norm(np.diff(knots[:, :3, 3], axis=0), axis=1)
    seconds = np.maximum(1 / waypoint_hz, distance / (arm.tool_speed / 2))
    ends = np.cumsum(np.maximum(np.round(seconds * rate_hz), 1)).astype(int)
    at = np.arange(1, ends[-1] + 1)
    steps = np.searchsorted(ends, at)
    closed = trajectory.gripper_state[steps, 0] > CLOSED
    return plan_poses(_smooth(np.append(0, ends), knots, at), closed, arm, rate_hz, steps, before)


def _tool_poses(trajectory: Trajectory, arm: Arm) -> FloatArray:
    """Tool poses ``(T, 4, 4)``, known to be those of a gripper above the table."""
    if trajectory.num_arms != 1:
        raise UnreachableError(f"the trajectory is for {trajectory.num_arms} grippers, this task's is one: {arm.name}")
    triplets = trajectory.triplets[:, 0]
    poses = arm.triangle.poses(triplets)
    misfit = np.sqrt(((arm.triangle.triplets(poses) - triplets) ** 2).sum(axis=-1).mean(axis=-1))
    _refuse(misfit > TRIPLET_TOLERANCE_M, "three points that are no gripper, {:.0f} mm off its shape", misfit * 1e3)
    depth = -arm.triangle.triplets(poses)[..., 2].min(axis=-1)
    _refuse(depth > TABLE_TOLERANCE_M, "fingers {:.0f} mm inside the table", depth * 1e3)
    return poses


class _Schedule:
    """When the tool is to be where: poses ``(4, 4)`` at increasing times, from ``start`` at time 0, hand open.

    ``interval`` is the time between waypoints in seconds; ``closed`` the gripper command from each time on,
    ``steps`` the waypoint that each pose belongs to.
    """

    def __init__(self, start: FloatArray, interval: float):
        self._interval = interval
        self.times, self.poses, self.closed, self.steps = [0.0], [start], [False], [0]

    @property
    def pose(self) -> FloatArray:
        return self.poses[-1]

    @property
    def shut(self) -> bool:
        return self.closed[-1]

    def go(self, pose: FloatArray, step: int, speed: float) -> None:
        """Go on to ``pose`` in the time between waypoints, or slower where that would take more than ``speed`` m/s."""
        distance = float(np.linalg.norm(pose[:3, 3] - self.pose[:3, 3]))
        self._add(pose, max(self._interval, distance / speed), step)

    def wait(self, seconds: float, shut: bool) -> None:
        """Stay for ``seconds``, with the hand commanded ``shut`` or open from the beginning of them."""
        self.closed[-1] = shut
        self._add(self.pose, seconds, self.steps[-1])

    def _add(self, pose: FloatArray, seconds: float, step: int) -> None:
        self.times.append(self.times[-1] + seconds)
        self.poses.append(pose)
        self.closed.append(self.shut)
        self.steps.append(step)


def plan_poses(
    poses: FloatArray,
    closed: np.ndarray,
    arm: Arm,
    rate_hz: float,
    steps: np.ndarray | None = None,
    before: Motion | None = None,
) -> Motion:
    """Motion through tool ``poses (N, 4, 4)`` at ``rate_hz``, slowed down where a joint would be too fast.

    ``closed (N,)`` is the gripper command, ``steps (N,)`` the waypoint each pose leads to, for the error messages.
    It starts where the motion ``before`` ends, or at home.
    """
    before = Motion.at_home(arm) if before is None else before
    steps = np.arange(len(poses)) if steps is None else steps
    path = arm.kinematics.follow(poses, before.joints[-1])
    short, turned = path.position_error, path.rotation_error
    _refuse(short > REACH_TOLERANCE_M, "a pose the arm cannot reach, it stays {:.0f} mm short", short * 1e3, steps)
    turned_deg = np.rad2deg(turned)
    _refuse(turned > arm.turn_tolerance, "a pose the arm cannot reach, it stays {:.0f} degrees off", turned_deg, steps)
    change = np.abs(np.diff(path.joints, axis=0, prepend=before.joints[-1:])).max(axis=1)
    _refuse(change > FLIP_RAD, "an elbow or wrist that flips by {:.0f} degrees at once", np.rad2deg(change), steps)
    count = np.maximum(np.ceil(change * rate_hz / arm.joint_speed), 1).astype(int)
    position = np.repeat(np.arange(len(poses)), count) - 1 + np.concatenate([np.arange(1, n + 1) / n for n in count])
    joints = np.stack([np.interp(position, np.arange(len(poses)), column) for column in path.joints.T], axis=1)
    nearest = np.ceil(position - 1e-9).clip(0).astype(int)
    return Motion(
        joints, _finger_ramp(closed[nearest], float(before.fingers[-1]), arm, rate_hz), poses[nearest], closed[nearest]
    )


def _smooth(times: FloatArray, knots: FloatArray, at: FloatArray) -> FloatArray:
    """Poses at times ``at`` through ``knots``, without overshoot (monotone cubic; Fritsch and Carlson 1980)."""
    poses = np.tile(np.eye(4), (len(at), 1, 1))
    poses[:, :3, 3] = PchipInterpolator(times, knots[:, :3, 3])(at)
    poses[:, :3, :3] = Slerp(times, Rotation.from_matrix(knots[:, :3, :3]))(at).as_matrix()
    return poses


def _finger_ramp(closed: np.ndarray, travel: float, arm: Arm, rate_hz: float) -> FloatArray:
    """Finger travel ``(N,)`` that follows the gripper command from ``travel`` on, no faster than the hand can."""
    fingers = np.empty(len(closed))
    most = arm.finger_speed / rate_hz
    for step, shut in enumerate(closed):
        travel += np.clip((0.0 if shut else arm.finger_travel) - travel, -most, most)
        fingers[step] = travel
    return fingers


def _refuse(bad: np.ndarray, what: str, amount: np.ndarray, steps: np.ndarray | None = None) -> None:
    if bad.any():
        first = int(np.argmax(bad))
        step = first if steps is None else int(steps[first])
        raise UnreachableError(f"step {step} of the trajectory asks for " + what.format(amount[first]))
