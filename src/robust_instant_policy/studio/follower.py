"""Arms that follow dragged target poses, with the same inverse kinematics, limits and checks as other motions."""

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from robust_instant_policy.errors import UnreachableError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.arm import Arm, Motion
from robust_instant_policy.motion.capsules import ArmShape
from robust_instant_policy.motion.waypoints import plan_onward
from robust_instant_policy.trajectory import Trajectory

RESPONSE_S = 0.08  # time constant of the gripper's approach to its target
TURN_SPEED_RAD_S = 2.0
ARRIVED_M, ARRIVED_RAD = 2e-4, 2e-3
LINK_M = 0.005  # by which capsules around links may enter the table, or each other: they are larger than the links


class Follower:
    """Plans the motion of ``arms`` towards targets, a control step at a time. ``motion`` ends where the arms are."""

    def __init__(self, arms: Sequence[Arm], control_hz: float):
        self.arms, self.control_hz = arms, control_hz
        self.motion = Motion.at_home(arms)
        self._refused: tuple[FloatArray, np.ndarray, str] | None = None  # the last targets, where no way is free
        self._shapes = [ArmShape(arm.kinematics) for arm in arms]
        self._room = self._room_after(self.motion)
        self._speed = min(arm.tool_speed for arm in arms) / 2  # that of `plan_onward`

    def resume(self, motion: Motion) -> None:
        """Go on from the end of ``motion``."""
        self.motion, self._refused, self._room = motion, None, self._room_after(motion)

    def towards(self, targets: FloatArray, closed: np.ndarray) -> tuple[Motion | None, str]:
        """The next motion towards ``targets (A, 4, 4)`` with gripper states ``closed (A,)`` bool.

        None if there is nothing to do. If a check refuses a step, its horizontal and its vertical part are tried, so
        that a gripper slides along the border of its reach; the second value is the refusal, empty if the whole step is
        possible.
        """
        here = self.motion.poses[-1]
        if (closed == self.motion.closed[-1]).all() and all(map(_arrived, here, targets)):
            return None, ""
        if self._refused is not None:
            refused, states, refusal = self._refused
            if np.array_equal(refused, targets) and (states == closed).all():
                return None, refusal
            self._refused = None
        whole = np.stack([self._step(*pair) for pair in zip(here, self._above_table(targets), strict=True)])
        try:
            return self._plan(whole, closed), ""
        except UnreachableError as error:
            refusal = str(error).split(" asks ", 1)[-1]  # there is only one step
        reached = here.copy()
        best: Motion | None = None
        for index, full in enumerate(whole):
            for part in _parts(here[index], full):
                attempt = reached.copy()
                attempt[index] = part
                try:
                    best = self._plan(attempt, closed)
                except UnreachableError:
                    continue
                reached = attempt
                break
        if best is None:
            self._refused = targets.copy(), closed.copy(), refusal
        return best, refusal

    def _plan(self, poses: FloatArray, closed: np.ndarray) -> Motion:
        actions = Trajectory.from_poses(poses[None], closed[None], self.arms[0].triangle).actions
        motion = plan_onward(actions, self.control_hz, self.motion, self.arms, self.control_hz)
        room = self._room_after(motion)
        if (closer := room < np.minimum(self._room, -LINK_M)).any():
            what = "the table" if closer[: len(self.arms)].any() else "the other arm"
            raise UnreachableError(f"a link of the arm would touch {what}")
        self.motion, self._room = motion, room
        return motion

    def _room_after(self, motion: Motion) -> FloatArray:
        """Distances, metres, of each arm's links from the table, and of each pair of arms, at the end of ``motion``."""
        shapes = self._shapes
        links = [shape.at(joints) for shape, joints in zip(shapes, motion.joints[-1], strict=True)]
        heights = [shape.height(own) for shape, own in zip(shapes, links, strict=True)]
        pairs = combinations(range(len(shapes)), 2)
        apart = [shapes[one].distance(links[one], shapes[other], links[other]) for one, other in pairs]
        return np.concatenate(heights + apart)

    def _step(self, here: FloatArray, target: FloatArray) -> FloatArray:
        """The pose one control step from ``here`` towards ``target (4, 4)``."""
        share = 1 - np.exp(-1 / (self.control_hz * RESPONSE_S))
        way = target[:3, 3] - here[:3, 3]
        turn = Rotation.from_matrix(target[:3, :3] @ here[:3, :3].T).as_rotvec()
        step = np.eye(4)
        step[:3, 3] = here[:3, 3] + _limited(way, share, ARRIVED_M, 0.99 * self._speed / self.control_hz)
        turned = Rotation.from_rotvec(_limited(turn, share, ARRIVED_RAD, TURN_SPEED_RAD_S / self.control_hz))
        step[:3, :3] = turned.as_matrix() @ here[:3, :3]
        return step

    def _above_table(self, targets: FloatArray) -> FloatArray:
        """``targets`` raised until no fingertip is below the table plane z = 0."""
        raised = targets.copy()
        for pose, arm in zip(raised, self.arms, strict=True):
            pose[2, 3] -= min(arm.triangle.triplets(pose)[1:, 2].min(), 0.0)
        return raised


def _limited(way: FloatArray, share: float, arrived: float, most: float) -> FloatArray:
    """A ``share`` of ``way (3,)``, all of it where it is shorter than ``arrived``, and no longer than ``most``."""
    length = float(np.linalg.norm(way))
    return way if length <= arrived else way * min(share, most / length)


def _arrived(here: FloatArray, target: FloatArray) -> bool:
    turn = Rotation.from_matrix(target[:3, :3] @ here[:3, :3].T).magnitude()
    return bool(np.linalg.norm(target[:3, 3] - here[:3, 3]) <= ARRIVED_M / 2 and turn <= ARRIVED_RAD / 2)


def _parts(here: FloatArray, step: FloatArray) -> Iterator[FloatArray]:
    """The whole step, then along the table only, along the vertical only, and the turn only."""
    keep: tuple[Callable[[FloatArray], FloatArray], ...] = (
        lambda to: to,
        lambda to: np.array([to[0], to[1], here[2, 3]]),
        lambda to: np.array([here[0, 3], here[1, 3], to[2]]),
    )
    for choose in keep:
        for rotation in (step[:3, :3], here[:3, :3]):
            part = step.copy()
            part[:3, :3], part[:3, 3] = rotation, choose(step[:3, 3])
            yield part
