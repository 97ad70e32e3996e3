"""A model of human demonstrations with leader arms: strokes with random path, speed, pauses and errors.

An expert lists the `Stroke`s; `perform` executes them with the variation of one episode. Strokes between rests
follow the minimum-jerk profile of human reaching (Flash and Hogan 1985).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from robust_instant_policy.geometry import FloatArray, make_pose

SPEED_SPREAD = 0.15  # standard deviation of the log of an episode's and a stroke's speed
MIN_STROKE_S = 0.35
TURN_RADIUS_M = 0.12  # a rotation by one radian takes as long as this distance
SKEW_SPREAD = 0.12  # standard deviation of the log of the exponent that skews the speed profile
BOW_SHARE = 0.06  # lateral deviation of a free stroke from the straight line, relative to its length
BOW_UP_SHARE = 0.05  # mean upward deviation of a free stroke, relative to its length
HESITATION_CHANCE, HESITATION_S = 0.15, (0.15, 0.45)
AIM_ERROR_RAD = 0.02
TREMOR_M = 0.0004
TREMOR_HZ = (0.6, 3.5)
TREMOR_WAVES = 4
STRAIGHT_DOWN = -0.99  # or below: the vertical part of an approach
GRIP_PAUSE_S = (0.4, 0.65)  # the demonstrator waits for the fingers


@dataclass(frozen=True, eq=False)
class Stroke:
    """One movement from rest to rest through tool ``poses (N, 4, 4)``, stopping at the last.

    ``error`` is the spread, in metres, of the last position, ``aim``, in rad, that of the rotations; ``speed`` the
    typical mean speed in m/s; ``pause`` the typical rest afterwards in seconds; ``closed`` the gripper state after the
    stroke. A ``free`` stroke touches nothing and may deviate from the straight line. ``arm`` is the index of the arm
    among the task's end-effectors; arms move at the same time, but a stroke that ``waits`` begins after all strokes
    listed before it.
    """

    poses: FloatArray
    closed: bool
    speed: float = 0.25
    error: float = 0.002
    pause: float = 0.08
    free: bool = False
    arm: int = 0
    waits: bool = False
    aim: float = AIM_ERROR_RAD


def shorter_turns(strokes: Sequence[Stroke]) -> list[Stroke]:
    """``strokes`` with hands rotated by half a turn about their approach where they would turn by more than 90 degrees.

    The two fingers of a parallel gripper are interchangeable. Hands that point straight down are rotated, an arm's all
    together, where the first would turn from the world's x axis to the other side.
    """
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    rotated: dict[int, bool] = {}
    for stroke in strokes:
        first = stroke.poses[0]
        rotated.setdefault(stroke.arm, bool(first[2, 2] < STRAIGHT_DOWN and first[0, 0] < 0))
    return [replace(one, poses=one.poses @ half_turn) if rotated[one.arm] else one for one in strokes]


def perform(
    starts: FloatArray, strokes: Sequence[Stroke], rng: np.random.Generator, rate_hz: float
) -> tuple[FloatArray, np.ndarray]:
    """Tool poses ``(T, A, 4, 4)`` and gripper commands ``(T, A)`` bool at ``rate_hz``, from ``starts (A, 4, 4)`` with
    open grippers."""
    pace = np.exp(rng.normal(0.0, SPEED_SPREAD))
    motions = [_ArmMotion(start) for start in starts]
    for stroke in strokes:
        motion = motions[stroke.arm]
        if stroke.waits:
            motion.rest_until(max(len(other) for other in motions))
        path = _move(motion.pose, stroke, pace, rng, rate_hz)
        rest = stroke.pause * rng.uniform(0.3, 1.7)
        if rng.random() < HESITATION_CHANCE:
            rest += rng.uniform(*HESITATION_S)
        motion.follow(path)
        if stroke.closed != motion.command:
            motion.command = stroke.closed
            rest += rng.uniform(*GRIP_PAUSE_S)
        motion.rest_until(len(motion) + round(rest * rate_hz))
    for motion in motions:
        motion.rest_until(max(len(other) for other in motions))
    whole = np.stack([motion.poses for motion in motions], axis=1)
    for index in range(len(motions)):
        whole[:, index, :3, 3] += _tremor(len(whole), rng, rate_hz)
    return whole, np.stack([motion.closed for motion in motions], axis=1)


class _ArmMotion:
    """The motion of one arm so far: ``poses (T, 4, 4)`` and gripper commands ``closed (T,)`` bool.

    ``command`` is the gripper command of further poses.
    """

    def __init__(self, start: FloatArray):
        self.poses, self.closed, self.command = start[None], np.zeros(1, dtype=bool), False

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def pose(self) -> FloatArray:
        return self.poses[-1]

    def follow(self, path: FloatArray) -> None:
        self.poses = np.concatenate([self.poses, path])
        self.closed = np.append(self.closed, np.full(len(path), self.command))

    def rest_until(self, length: int) -> None:
        self.follow(np.repeat(self.pose[None], length - len(self), axis=0))


def _move(here: FloatArray, stroke: Stroke, pace: float, rng: np.random.Generator, rate_hz: float) -> FloatArray:
    knots = np.concatenate([here[None], stroke.poses])
    knots[1:, :3, 3] += rng.normal(0.0, stroke.error, 3)  # one error for the whole curve, not one per point
    if stroke.free:
        knots = np.insert(knots, 1, _bow(knots[0], knots[1], rng), axis=0)
    turn = Rotation.from_rotvec(rng.normal(0.0, stroke.aim, 3)).as_matrix()
    knots[1:, :3, :3] = knots[1:, :3, :3] @ turn
    rotations = Rotation.from_matrix(knots[:, :3, :3])
    step = np.linalg.norm(np.diff(knots[:, :3, 3], axis=0), axis=1)
    step = step + TURN_RADIUS_M * (rotations[:-1].inv() * rotations[1:]).magnitude()
    along = np.concatenate([[0.0], np.cumsum(np.maximum(step, 1e-6))])
    speed = stroke.speed * pace * np.exp(rng.normal(0.0, SPEED_SPREAD))
    count = max(int(np.ceil(max(along[-1] / speed, MIN_STROKE_S) * rate_hz)), 2)
    time = (np.arange(1, count + 1) / count) ** np.exp(rng.normal(0.0, SKEW_SPREAD))
    at = along[-1] * (10 * time**3 - 15 * time**4 + 6 * time**5)
    places = CubicSpline(along, knots[:, :3, 3], bc_type="natural")(at)
    return make_pose(Slerp(along, rotations)(np.minimum(at, along[-1])).as_matrix(), places)


def _bow(start: FloatArray, stop: FloatArray, rng: np.random.Generator) -> FloatArray:
    """A pose ``(4, 4)`` half-way, beside the straight line."""
    length = float(np.linalg.norm(stop[:3, 3] - start[:3, 3]))
    middle = stop.copy()
    middle[:3, 3] = (start[:3, 3] + stop[:3, 3]) / 2 + length * rng.normal(0.0, BOW_SHARE, 3)
    middle[2, 3] += length * BOW_UP_SHARE
    middle[:3, :3] = Slerp([0.0, 1.0], Rotation.from_matrix([start[:3, :3], stop[:3, :3]]))(0.5).as_matrix()
    return middle


def _tremor(length: int, rng: np.random.Generator, rate_hz: float) -> FloatArray:
    """Tremor ``(length, 3)`` in metres, 0 at the first sample."""
    time = np.arange(length) / rate_hz
    waves = np.zeros((length, 3))
    for _ in range(TREMOR_WAVES):
        frequency = rng.uniform(*TREMOR_HZ)
        phase = rng.uniform(0.0, 2 * np.pi, 3)
        amplitude = rng.normal(0.0, TREMOR_M, 3)
        waves += amplitude * (np.sin(2 * np.pi * frequency * time[:, None] + phase) - np.sin(phase))
    return waves
