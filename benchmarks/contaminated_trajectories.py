"""Seeded gripper trajectories with hallucinated candidates, and their ground truth.

A scene is one task with new object positions: a true trajectory, Q candidates, and the set of hallucinated ones.
Trajectories are functions of normalised time, so that candidates of different lengths sample the same motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from robust_instant_policy.geometry import FloatArray, GripperTriangle, make_pose

STEPS = 30
GRIPPER = GripperTriangle(length=0.10, opening=0.08)
NUMBER_NOISE_M = 0.002  # independent noise of every number
STEP_NOISE_M, STEP_NOISE_RAD = 0.0015, 0.01  # independent noise of the gripper at each step
SLOW_NOISE_M = 0.001  # slowly varying noise along the candidate
NOTICEABLE_M = 0.015  # smaller contaminations are drawn again: they are within the noise
DETOUR_M = (0.06, 0.20)  # between neighbouring ways of a task that can be done in several
RAGGED_SHARE = 0.25  # of the scenes, whose candidates have 27 to 33 steps instead of 30

Motion = Callable[[FloatArray], FloatArray]  # times (T,) -> actions (T, 10)


@dataclass(frozen=True, eq=False)
class Scene:
    truth: Motion
    candidates: list[FloatArray]
    hallucinated: np.ndarray
    modes: np.ndarray
    ways: tuple[Motion, ...]

    @property
    def times(self) -> FloatArray:
        return np.linspace(0.0, 1.0, STEPS)


@dataclass(frozen=True, eq=False)
class Task:
    """Via points relative to two objects, so that the task can be executed at other object positions."""

    style: str
    times: FloatArray
    offsets: FloatArray
    owner: np.ndarray  # frame of each via point: object 0 or 1; 2 is the world
    yaw: FloatArray
    tilt: FloatArray
    closes: float
    opens: float

    @classmethod
    def draw(cls, rng: np.random.Generator, style: str) -> Task:
        if style == "smooth":
            times = np.linspace(0, 1, 6)
            offsets = np.cumsum(rng.normal(0, 0.07, (6, 3)), axis=0)
            owner = np.array([2, 0, 0, 1, 1, 1])
            return cls(
                style,
                times,
                offsets,
                owner,
                np.cumsum(rng.normal(0, 0.25, 6)),
                rng.normal(0, 0.1, 6),
                closes=rng.uniform(0.3, 0.45),
                opens=rng.uniform(0.7, 0.9),
            )
        # start, above, grasp, (pause), lift, above the goal, place, (pause), retreat: corners at whole steps
        steps = np.cumsum([0, rng.integers(5, 8), 3, 2, 3, rng.integers(5, 7), 3, 2])
        times = np.append(steps, STEPS - 1) / (STEPS - 1)
        height = rng.uniform(0.06, 0.12)
        offsets = np.zeros((9, 3))
        offsets[0] = rng.normal([0, 0, 0.25], 0.05)
        offsets[[1, 4, 5, 8], 2] = height
        offsets[[5, 8], :2] = rng.normal(0, 0.01, (2, 2))
        offsets[8] += [rng.normal(0, 0.04), rng.normal(0, 0.04), 0.05]
        turn = rng.uniform(-0.6, 0.6, 2)
        yaw = np.array([0, *[turn[0]] * 4, *[turn[1]] * 4])
        tilt = np.zeros(9)
        owner = np.array([2, 0, 0, 0, 0, 1, 1, 1, 1])
        return cls(style, times, offsets, owner, yaw, tilt, closes=times[2] + 0.5 / STEPS, opens=times[6] + 0.5 / STEPS)

    def at(self, objects: FloatArray, turn: float = 0.0) -> Motion:
        """The motion for objects at ``objects (2, 3)``, metres, the gripper rotated by ``turn`` radians."""
        points = self.offsets + np.vstack([objects, np.zeros(3)])[self.owner]
        via = np.column_stack([points, self.yaw + turn, self.tilt])

        def motion(times: FloatArray) -> FloatArray:
            if self.style == "smooth":
                values = CubicSpline(self.times, via, bc_type="natural")(times)
            else:
                values = np.stack([np.interp(times, self.times, column) for column in via.T], axis=1)
            state = (times > self.closes) & (times < self.opens)
            return _actions(values[:, :3], values[:, 3:], state)

        return motion


def _actions(positions: FloatArray, angles: FloatArray, state: np.ndarray) -> FloatArray:
    down = Rotation.from_euler("x", np.pi)
    rotations = (Rotation.from_euler("zx", angles) * down).as_matrix()
    poses = np.stack([make_pose(rotation, position) for rotation, position in zip(rotations, positions, strict=True)])
    return np.column_stack([GRIPPER.triplets(poses).reshape(len(poses), 9), state])


def _objects(rng: np.random.Generator) -> FloatArray:
    return np.column_stack([rng.uniform([0.25, -0.25], [0.55, 0.25], (2, 2)), rng.uniform(0.01, 0.05, 2)])


def noisy(rng: np.random.Generator, actions: FloatArray, level: float) -> FloatArray:
    """``actions (T, 10)`` as a candidate has them: noise, whole millimetres, gripper changes a step off."""
    count = len(actions)
    noisy = actions.copy()
    points = actions[:, :9].reshape(count, 3, 3)
    centre = points.mean(axis=1, keepdims=True)
    spin = Rotation.from_rotvec(rng.normal(0, STEP_NOISE_RAD * level, (count, 3))).as_matrix()
    points = (points - centre) @ np.swapaxes(spin, 1, 2) + centre
    slow = gaussian_filter1d(rng.normal(size=(count + 40, 3)), 5.0, axis=0)[20:-20]
    slow *= SLOW_NOISE_M * level * np.sqrt(2 * np.sqrt(np.pi) * 5.0)
    points = points + (rng.normal(0, STEP_NOISE_M * level, (count, 3)) + slow)[:, None]
    noisy[:, :9] = points.reshape(count, 9) + rng.normal(0, NUMBER_NOISE_M * level, (count, 9))
    noisy[:, :9] = np.round(noisy[:, :9], 3)
    if rng.random() < 0.3:  # gripper changes one step early or late
        change = rng.choice(np.flatnonzero(np.diff(actions[:, 9]))) if np.diff(actions[:, 9]).any() else 0
        noisy[change : change + 2, 9] = actions[change + rng.integers(2), 9]
    return noisy


def _offset(rng: np.random.Generator, truth: Motion, times: FloatArray, other: Motion) -> FloatArray:
    actions = truth(times)
    actions[:, :9] += np.tile(_direction(rng) * rng.uniform(0.02, 0.15), 3)
    return actions


def _drift(rng: np.random.Generator, truth: Motion, times: FloatArray, other: Motion) -> FloatArray:
    actions = truth(times)
    grown = np.clip((times - rng.uniform(0.0, 0.6)) / 0.4, 0.0, None) ** rng.uniform(1, 2)
    actions[:, :9] += np.outer(grown, np.tile(_direction(rng) * rng.uniform(0.04, 0.15), 3))
    return actions


def _other_demonstration(rng: np.random.Generator, truth: Motion, times: FloatArray, other: Motion) -> FloatArray:
    return other(times)


def _wrong_time(rng: np.random.Generator, truth: Motion, times: FloatArray, other: Motion) -> FloatArray:
    shift = rng.uniform(0.1, 0.3) * rng.choice([-1, 1])
    return truth(np.clip(times + shift, 0.0, 1.0))


def _digits(rng: np.random.Generator, truth: Motion, times: FloatArray, other: Motion) -> FloatArray:
    actions = truth(times)
    for _ in range(rng.integers(1, 5)):
        step, column = rng.integers(len(times)), rng.integers(9)
        length = rng.choice([1, 1, 3])
        actions[step : step + length, column] *= rng.choice([-1.0, 10.0, 0.1])
    return actions


def _freeze(rng: np.random.Generator, truth: Motion, times: FloatArray, other: Motion) -> FloatArray:
    actions = truth(times)
    length = rng.integers(len(times) // 5, len(times) // 2)
    start = rng.integers(0, len(times) - length)
    actions[start : start + length] = actions[start]
    return actions


def _garbage(rng: np.random.Generator, truth: Motion, times: FloatArray, other: Motion) -> FloatArray:
    positions = rng.uniform([0.1, -0.4, 0.0], [0.7, 0.4, 0.4], (len(times), 3))
    return _actions(positions, rng.uniform(-1, 1, (len(times), 2)), rng.random(len(times)) > 0.5)


def _direction(rng: np.random.Generator) -> FloatArray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


KINDS = {
    "offset": _offset,
    "drift": _drift,
    "other demonstration": _other_demonstration,
    "wrong time": _wrong_time,
    "digits": _digits,
    "freeze": _freeze,
    "garbage": _garbage,
}


def draw_modes(seed: int, style: str, sizes: tuple[int, ...]) -> Scene:
    """A scene with ``sizes`` candidates in several modes, which diverge and meet again; `Scene.truth` is the first and
    largest mode, ``modes`` the mode of each candidate."""
    rng = np.random.default_rng([seed, *sizes, len(style)])
    task = Task.draw(rng, style)
    common = task.at(_objects(rng))
    start, stop = rng.uniform(0.1, 0.3), rng.uniform(0.6, 0.9)
    around = rng.uniform(0, 2 * np.pi) + np.arange(len(sizes)) * 2 * np.pi / len(sizes)
    detour = rng.uniform(*DETOUR_M) / (2 * np.sin(np.pi / max(len(sizes), 2)))  # distance of neighbouring modes
    level = float(np.exp(rng.normal(0, 0.5)))
    truths = [_detour(common, start, stop, [detour * np.cos(a), 0.0, detour * np.sin(a)], style) for a in around]
    if len(sizes) == 1:
        truths = [common]
    modes = rng.permutation(np.repeat(np.arange(len(sizes)), sizes))
    times = np.linspace(0.0, 1.0, STEPS)
    candidates = [noisy(rng, truths[mode](times), level) for mode in modes]
    return Scene(truths[0], candidates, np.zeros(len(modes), dtype=bool), modes, tuple(truths))


def _detour(common: Motion, start: float, stop: float, far: list[float], style: str) -> Motion:
    def motion(times: FloatArray) -> FloatArray:
        phase = np.clip((times - start) / (stop - start), 0.0, 1.0)
        height = np.sin(np.pi * phase) ** 2 if style == "smooth" else np.minimum(1.0, 3 * np.minimum(phase, 1 - phase))
        actions = common(times)
        actions[:, :9] += np.outer(height, np.tile(far, 3))
        return actions

    return motion


def draw_scene(seed: int, style: str, num_candidates: int, num_hallucinated: int, kind: str = "offset") -> Scene:
    """A scene of ``style`` "smooth" or "piecewise" with ``num_hallucinated`` candidates of one ``kind``."""
    rng = np.random.default_rng([seed, num_candidates, num_hallucinated, sorted(KINDS).index(kind), len(style)])
    task = Task.draw(rng, style)
    truth = task.at(_objects(rng))
    level = float(np.exp(rng.normal(0, 0.5)))
    ragged = rng.random() < RAGGED_SHARE
    hallucinated = np.zeros(num_candidates, dtype=bool)
    hallucinated[rng.permutation(num_candidates)[:num_hallucinated]] = True
    candidates = []
    for wrong in hallucinated:
        times = np.linspace(0.0, 1.0, rng.integers(STEPS - 3, STEPS + 4) if ragged else STEPS)
        right = truth(times)
        actions = right
        while wrong:
            other = task.at(_objects(rng), turn=rng.uniform(-0.5, 0.5))
            actions = KINDS[kind](rng, truth, times, other)
            moved = np.linalg.norm((actions - right)[:, :9].reshape(-1, 3, 3), axis=-1)
            if moved.max() > NOTICEABLE_M:
                break
        candidates.append(noisy(rng, actions, level))
    return Scene(truth, candidates, hallucinated, np.zeros(num_candidates, dtype=np.intp), (truth,))


def draw_single_steps(seed: int, style: str, num_candidates: int, rate: float) -> Scene:
    """A scene in which any step of any candidate is off with probability ``rate``, independently."""
    scene = draw_scene(seed, style, num_candidates, 0)
    rng = np.random.default_rng([seed, num_candidates, round(rate * 100), len(style)])
    candidates = []
    for candidate in scene.candidates:
        actions = candidate.copy()
        for step in np.flatnonzero(rng.random(len(actions)) < rate):
            actions[step, :9] += np.tile(_direction(rng) * rng.uniform(0.03, 0.10), 3)
        candidates.append(actions)
    return replace(scene, candidates=candidates)
