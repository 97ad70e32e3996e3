"""What a real arm needs beyond `waypoints`: a motion within its accelerations, and the checks of the whole path.

plan ──check_waypoints──▶ plan_waypoints ──retimed──▶ check_motion ──▶ the arm

Only commands that passed `check_motion` are sent; `gate.Gate` looks at each of them once more.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from robust_instant_policy.errors import UnreachableError
from robust_instant_policy.geometry import FloatArray, interpolate
from robust_instant_policy.motion.arm import Arm, Motion
from robust_instant_policy.motion.capsules import ArmShape, Capsules
from robust_instant_policy.motion.checks import gripper_poses
from robust_instant_policy.motion.limits import Limits, exceeded
from robust_instant_policy.motion.waypoints import plan_waypoints
from robust_instant_policy.trajectory import Trajectory

SMOOTHING_S = 0.12  # window of the moving average over joint commands: a jump of the speed is spread over it
MAX_SLOWDOWN = 4.0  # a motion that needs more than this is not the one that was planned
HEADROOM = 0.95  # of speeds, for the difference between the measured joints and the first command
RETIMING_ROUNDS, RETIMING_MARGIN = 6, 1.02  # slower by a little more than needed, until smoothing exceeds no limit
ROUNDING_M, ROUNDING_RAD = 1e-6, 1e-6
PEAK_SPEED = 1.875  # of a minimum-jerk motion, over its mean speed
LEAST_MOTION_S = 0.2
HOME_MARGIN_M = 0.05  # around the box of workspace and home, in which an arm comes and goes
UP_M = 0.10  # of the tool, before an arm goes to its park pose the direct way would be refused


def plan_guarded(
    trajectory: Trajectory,
    arms: Sequence[Arm],
    limits: Limits,
    execute_hz: float,
    rate_hz: float,
    speed: float = 1.0,
) -> Motion:
    """Motion from the arms' homes along ``trajectory``, slower by the factor ``speed`` (0 to 1), within all limits.

    Raises `UnreachableError` that names the waypoint or the time, the limit, and how to change it.
    """
    check_waypoints(trajectory, arms, limits)
    motion = retimed(plan_waypoints(trajectory, arms, execute_hz, rate_hz), arms, rate_hz, speed)
    check_motion(motion, arms, limits, rate_hz)
    return motion


def check_waypoints(trajectory: Trajectory, arms: Sequence[Arm], limits: Limits) -> None:
    """Refuse a trajectory that jumps or turns too far between two waypoints, or leaves the workspace."""
    poses = gripper_poses(trajectory, arms)
    changes = poses[:-1, ..., :3, :3].swapaxes(-1, -2) @ poses[1:, ..., :3, :3]
    turns = Rotation.from_matrix(changes.reshape(-1, 3, 3)).magnitude().reshape(changes.shape[:2])
    steps = np.linalg.norm(np.diff(poses[..., :3, 3], axis=0), axis=-1)
    for index, arm in enumerate(arms):
        _check_workspace(trajectory.triplets[:, index, 1:], arm, limits, None)
        for values, limit, what, unit, key, scale in (
            (steps[:, index], limits.step, "moves", "m", "step", 1.0),
            (turns[:, index], limits.turn_per_step, "turns", "degrees", "turn_per_step", math.degrees(1.0)),
        ):
            if (values > limit).any():
                step = int(np.argmax(values > limit))
                what = f"the tool {what} to the next one by"
                raise UnreachableError(
                    exceeded(_when(arm, step, None), what, values[step] * scale, limit * scale, unit, key)
                )


def retimed(motion: Motion, arms: Sequence[Arm], rate_hz: float, speed: float = 1.0) -> Motion:
    """``motion`` with smooth speeds, slower by the factor ``speed`` and as far as the arms' limits need.

    Raises `UnreachableError` where it would have to be slower than by `MAX_SLOWDOWN`.
    """
    motion = _stretched(_smoothed(motion, rate_hz), 1 / speed)
    total = 1.0
    for _ in range(RETIMING_ROUNDS):
        needed, reason = _slowdown(motion, arms, rate_hz)
        if needed <= HEADROOM:
            return motion
        total *= needed
        if total > MAX_SLOWDOWN:
            break
        motion = _stretched(motion, RETIMING_MARGIN * needed / HEADROOM)
    raise UnreachableError(f"{reason}; the motion would have to be {total:.1f} times slower")


def check_motion(motion: Motion, arms: Sequence[Arm], limits: Limits, rate_hz: float, to_home: bool = False) -> None:
    """Refuse commands that are not finite, or outside the limits of joints, speeds, workspace, table and distances.

    A motion ``to_home`` may leave the workspace, see `Space.check`.
    """
    if not (np.isfinite(motion.joints).all() and np.isfinite(motion.fingers).all()):
        raise UnreachableError("the motion holds commands that are not numbers; plan again")
    needed, reason = _slowdown(motion, arms, rate_hz)
    if needed > 1.0:
        raise UnreachableError(reason)
    for index, arm in enumerate(arms):
        check_joint_range(motion.joints[:, index], arm, rate_hz)
    Space(arms, limits).check(motion.joints, rate_hz, to_home)


def check_joint_range(joints: FloatArray, arm: Arm, rate_hz: float) -> None:
    """Refuse ``joints (N, J)`` outside the range of the arm's joints."""
    low, high = arm.kinematics.joint_range.T
    outside = np.maximum(low - joints, joints - high)
    if (outside > ROUNDING_RAD).any():
        step, joint = np.unravel_index(np.argmax(outside > ROUNDING_RAD), outside.shape)
        bound = (low if joints[step, joint] < low[joint] else high)[joint]
        what = f"joint {joint + 1} goes to"
        raise UnreachableError(exceeded(_when(arm, step, rate_hz), what, joints[step, joint], bound, "rad", "model"))


class Space:
    """Where arms may be: their tools in the workspace, no link at the table or another link, and the arms apart."""

    def __init__(self, arms: Sequence[Arm], limits: Limits):
        self._arms, self._limits = arms, limits
        self._shapes = [ArmShape(arm.kinematics) for arm in arms]
        self._parked = [self._links(index, arm.home[None]) for index, arm in enumerate(arms)]

    def check(self, joints: FloatArray, rate_hz: float, to_home: bool = False, start: FloatArray | None = None) -> None:
        """Refuse ``joints (N, A, J)`` with a tool outside the workspace, a link at the table, or two arms or two links
        of one arm together.

        A tool may come into the workspace from outside, within `HOME_MARGIN_M` of the box around workspace and home;
        with ``to_home`` it may be anywhere in that box before and after its time in the workspace. Links of one arm
        may be as near to each other as at home, or as at ``start (A, J)``, by default the first of ``joints``.
        """
        limits = self._limits
        capsules = [shape.at(joints[:, index]) for index, shape in enumerate(self._shapes)]
        for index, (arm, shape, links) in enumerate(zip(self._arms, self._shapes, capsules, strict=True)):
            poses = np.array([arm.kinematics.tool_pose(angles) for angles in joints[:, index]])
            points = arm.triangle.triplets(poses)[:, 1:]
            _check_workspace(points, arm, limits, rate_hz, to_home)
            depth = -points[..., 2].min(axis=-1)
            what = "a fingertip goes"
            _refuse(depth - limits.table_depth, depth, limits.table_depth, arm, what, "m below the table",
                    "table_depth", rate_hz)  # fmt: skip
            least = shape.height(links)
            _refuse(-least, least, 0.0, arm, "a link has a height above the table of", "m", "model", rate_hz)
            begun = joints[:1, index] if start is None else start[index : index + 1]
            self._check_links(index, joints[:, index], links, self._links(index, begun), rate_hz)
        for one, other in combinations(range(len(self._arms)), 2):
            apart = self._shapes[one].distance(capsules[one], self._shapes[other], capsules[other])
            what = f"its distance from {self._arms[other].name} is"
            _refuse(limits.arm_distance - apart, apart, limits.arm_distance, self._arms[one], what, "m",
                    "arm_distance", rate_hz)  # fmt: skip

    def _links(self, index: int, joints: FloatArray, capsules: Capsules | None = None) -> FloatArray:
        """Distances ``(N, P)`` of an arm's own links at ``joints (N, J)``."""
        shape = self._shapes[index]
        return shape.link_distances(joints, capsules or shape.at(joints), self._limits.link_distance)

    def _check_links(
        self, index: int, joints: FloatArray, capsules: Capsules, begun: FloatArray, rate_hz: float
    ) -> None:
        """Refuse ``joints (N, J)`` of an arm whose links meet, unless they did so at home or in ``begun (1, P)``."""
        shape, limit = self._shapes[index], self._limits.link_distance
        if not shape.pairs.size:
            return
        apart = self._links(index, joints, capsules)
        least = np.minimum(self._parked[index], begun)[0].clip(max=limit)
        pair = int(np.argmin((apart - least).min(axis=0)))
        one, other = (shape.links[shape_index] for shape_index in shape.pairs[:, pair])
        what = f"the distance between its links {one} and {other} is"
        _refuse(least[pair] - apart[:, pair], apart[:, pair], float(least[pair]), self._arms[index], what, "m",
                "link_distance", rate_hz)  # fmt: skip

    def outside(self, joints: FloatArray) -> FloatArray:
        """How far, metres, each tool is outside the workspace at ``joints (N, A, J)``: ``(N, A)``, 0 inside."""
        columns = []
        for index, arm in enumerate(self._arms):
            poses = np.array([arm.kinematics.tool_pose(angles) for angles in joints[:, index]])
            columns.append(_outside(arm.triangle.triplets(poses)[:, 1:], self._limits))
        return np.stack(columns, axis=1).clip(0.0)


def minimum_jerk(share: FloatArray) -> FloatArray:
    """Position, 0 to 1, at a ``share`` of the time, 0 to 1, of a motion that starts and ends at rest."""
    return share**3 * (10 - 15 * share + 6 * share**2)


def joint_motion(start: FloatArray, goal: FloatArray, fingers: FloatArray, arms: Sequence[Arm], rate_hz: float,
                 speed: float = 1.0) -> Motion:  # fmt: skip
    """Straight motion of joints ``(A, J)`` from ``start`` to ``goal`` with a minimum-jerk profile, fingers at rest."""
    needed = PEAK_SPEED * np.abs(goal - start).max(axis=1) / [arm.joint_speed for arm in arms]
    seconds = max(float(needed.max()), LEAST_MOTION_S)
    share = np.linspace(0.0, 1.0, max(math.ceil(seconds * rate_hz / speed), 2) + 1)[1:, None, None]
    share = minimum_jerk(share)
    joints = start + share * (goal - start)
    poses = np.stack(
        [[arm.kinematics.tool_pose(row) for row in joints[:, index]] for index, arm in enumerate(arms)], axis=1
    )
    count = (len(joints), 1)
    return Motion(joints, np.tile(fingers, count), poses, np.tile(fingers <= 0.0, count))


def check_home(arms: Sequence[Arm], limits: Limits, rate_hz: float) -> None:
    """Refuse homes in which a link is at the table, or two arms are together."""
    try:
        Space(arms, limits).check(np.stack([arm.home for arm in arms])[None], rate_hz, to_home=True)
    except UnreachableError as refused:
        words = f"the park pose is refused ({refused}); change park, or base, in the cell's file"
        raise UnreachableError(words) from None


def park_motion(start: FloatArray, fingers: FloatArray, arms: Sequence[Arm], limits: Limits, rate_hz: float,
                speed: float = 1.0) -> Motion:  # fmt: skip
    """Motion from joints ``start (A, J)`` to the arms' homes: directly, or up first where that would be refused.

    Fingers keep their travel ``fingers (A,)``. Raises `UnreachableError` where both ways are refused.
    """
    check_home(arms, limits, rate_hz)
    home = np.stack([arm.home for arm in arms])
    direct = retimed(joint_motion(start, home, fingers, arms, rate_hz), arms, rate_hz, speed)
    try:
        check_motion(direct, arms, limits, rate_hz, to_home=True)
        return direct
    except UnreachableError as refused:
        raised = []
        for arm, joints in zip(arms, start, strict=True):
            pose = arm.kinematics.tool_pose(joints)
            path = np.repeat(pose[None], 11, axis=0)
            path[:, 2, 3] += np.linspace(0.0, UP_M, 11)
            raised.append(arm.kinematics.follow(path, joints).joints[-1])
        up = np.stack(raised)
        parts = [joint_motion(start, up, fingers, arms, rate_hz), joint_motion(up, home, fingers, arms, rate_hz)]
        detour = Motion(*(np.concatenate([getattr(part, name) for part in parts]) for name in _FIELDS))
        detour = retimed(detour, arms, rate_hz, speed)
        try:
            check_motion(detour, arms, limits, rate_hz, to_home=True)
        except UnreachableError:
            raise UnreachableError(f"the way to the park pose is refused ({refused}); move the arm by hand") from None
        return detour


_FIELDS = ("joints", "fingers", "poses", "closed")


def _smoothed(motion: Motion, rate_hz: float) -> Motion:
    """Joint commands after a moving average; the motion ends later by its window."""
    window = 2 * round(SMOOTHING_S * rate_hz / 2) + 1
    held = {name: getattr(motion, name) for name in _FIELDS}
    held = {name: np.concatenate([values, np.repeat(values[-1:], window, axis=0)]) for name, values in held.items()}
    joints = uniform_filter1d(held["joints"], window, axis=0, mode="nearest")
    return replace(motion, **{**held, "joints": joints})


def _stretched(motion: Motion, factor: float) -> Motion:
    """``motion`` over ``factor`` times as many control steps."""
    count = len(motion.joints)
    if count < 2 or factor == 1.0:
        return motion
    position = np.linspace(0, count - 1, math.ceil((count - 1) * factor) + 1)
    nearest = np.ceil(position - 1e-9).astype(int)
    return Motion(
        PchipInterpolator(np.arange(count), motion.joints)(position),
        interpolate(position, np.arange(count), motion.fingers),
        motion.poses[nearest],
        motion.closed[nearest],
    )


def _slowdown(motion: Motion, arms: Sequence[Arm], rate_hz: float) -> tuple[float, str]:
    """The factor by which ``motion`` is too fast, and which limit says so."""
    worst, reason = 0.0, ""
    speeds = np.diff(motion.joints, axis=0, prepend=motion.joints[:1], append=motion.joints[-1:]) * rate_hz
    changes = np.diff(speeds, axis=0) * rate_hz
    for index, arm in enumerate(arms):
        tips = np.array([arm.kinematics.tool_pose(joints)[:3, 3] for joints in motion.joints[:, index]])
        tool = np.linalg.norm(np.diff(tips, axis=0, prepend=tips[:1]), axis=1)[:, None] * rate_hz
        for values, limit, what, unit, key, order in (
            (np.abs(speeds[:, index]), arm.joint_speed, "moves a joint at", "rad/s", "joint_speed", 1.0),
            (np.abs(changes[:, index]), arm.joint_acceleration, "accelerates a joint by", "rad/s²",
             "joint_acceleration", 0.5),
            (tool, arm.tool_speed, "moves its tool at", "m/s", "tool_speed", 1.0),
        ):  # fmt: skip
            ratio = float(values.max()) / limit
            if ratio**order > worst:
                step = int(np.argmax(values.max(axis=1)))
                worst = ratio**order
                reason = exceeded(_when(arm, step, rate_hz), what, float(values.max()), limit, unit, key)
    return worst, reason


def _check_workspace(
    fingertips: FloatArray, arm: Arm, limits: Limits, rate_hz: float | None, to_home: bool = False
) -> None:
    """Refuse ``fingertips (N, 2, 3)`` outside the workspace, but on the way from the arm's home or ``to_home``."""
    home = arm.triangle.triplets(arm.home_pose)[1:]
    outside = _outside(fingertips, limits)
    excess = _outside(fingertips, limits, home) - HOME_MARGIN_M
    inside = np.flatnonzero(outside <= ROUNDING_M)
    if to_home:
        way_in, way_out = (inside[0], inside[-1]) if len(inside) else (0, 0)
    else:
        way_in, way_out = inside[0] if len(inside) else 0, len(outside)
    excess[way_in:way_out] = outside[way_in:way_out]
    if excess.max() > ROUNDING_M:
        step = int(np.argmax(excess))
        what = "its tool is outside the workspace by"
        raise UnreachableError(exceeded(_when(arm, step, rate_hz), what, float(excess[step]), 0.0, "m", "workspace"))


def _outside(fingertips: FloatArray, limits: Limits, home: FloatArray | None = None) -> FloatArray:
    """How far, metres, ``fingertips (N, 2, 3)`` are outside the workspace: ``(N,)``, negative inside.

    With fingertips ``home (2, 3)``, how far they are outside the box around both.
    """
    low, high = limits.workspace[0].copy(), limits.workspace[1]
    low[2] = min(low[2], -limits.table_depth)  # the table has a limit of its own
    if home is not None:
        low, high = np.minimum(low, home.min(axis=0)), np.maximum(high, home.max(axis=0))
    return np.maximum(low - fingertips, fingertips - high).max(axis=(1, 2))


def _refuse(excess: FloatArray, values: FloatArray, limit: float, arm: Arm, what: str, unit: str, key: str,
            rate_hz: float) -> None:  # fmt: skip
    """Raise an error for the first of ``values (N,)`` with an ``excess`` above 0."""
    if (excess > ROUNDING_M).any():
        step = int(np.argmax(excess > ROUNDING_M))
        raise UnreachableError(exceeded(_when(arm, step, rate_hz), what, float(values[step]), limit, unit, key))


def _when(arm: Arm, step: int | np.integer, rate_hz: float | None) -> str:
    """The place of ``step`` in a motion at ``rate_hz``, or among the waypoints of a plan."""
    return f"{arm.name}, step {step} of the plan" if rate_hz is None else f"{arm.name}, after {step / rate_hz:.1f} s"
