"""What was demonstrated bounds what may be planned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.sanity.finding import EnvelopeError, Finding, errors
from robust_instant_policy.trajectory import TARGET_STEPS, Trajectory, downsample

POSITION_MARGIN_M = 0.10  # around the box of the demonstrated points of each arm
HEIGHT_MARGIN_M = 0.015  # below the lowest demonstrated fingertip
STEP_FACTOR, STEP_MARGIN_M = 1.5, 0.05  # on the longest demonstrated step
TURN_FACTOR, TURN_MARGIN_RAD = 1.5, np.deg2rad(25.0)  # on the largest demonstrated turn of a step
TILT_MARGIN_RAD = np.deg2rad(25.0)  # on how far the approach leaned away from its mean direction
SIDE_FACTOR, SIDE_MARGIN_M = 0.15, 0.005  # on the sides of the gripper's triangle
FEW = 3.0  # by which margins widen, over the number of demonstrations less one
LENGTH_FACTOR = 2.0  # on the longest demonstrated path
DEGREES = 180 / np.pi  # in a radian


@dataclass(frozen=True, eq=False)
class Envelope:
    """Limits of a plan's numbers, margins included; A arms.

    ``lower`` and ``upper (A, 3)``: corners of the box that holds gripper point and fingertips, metres, world, with
    the ``margin``, metres; ``lowest (A,)`` height of a fingertip above the table, metres; ``step (A,)`` metres,
    ``detour (A,)`` metres from the way between its neighbours and ``turn (A,)`` rad from one step to the next, of
    ``steps`` steps; ``approach (A, 3)`` mean direction and ``tilt (A,)`` rad around it; ``sides (A, 3)`` of the
    gripper's triangle, metres; ``length (A,)`` of the path, metres; ``changes`` the sequences of gripper states,
    one for each arm, that were demonstrated.
    """

    lower: FloatArray
    upper: FloatArray
    margin: float
    lowest: FloatArray
    step: FloatArray
    detour: FloatArray
    turn: FloatArray
    approach: FloatArray
    tilt: FloatArray
    sides: FloatArray
    length: FloatArray
    steps: int
    changes: frozenset[tuple[tuple[int, ...], ...]]
    plane: FloatArray

    @classmethod
    def of(cls, trajectories: Sequence[Trajectory], plane: FloatArray) -> Envelope:
        """Of demonstrated ``trajectories`` with the same number of arms, over the table's ``plane (4,)``.

        The extremes of few demonstrations bound a new one less: margins that protect nothing but plausibility widen by
        1 + `FEW` / (I - 1), those of height and of the gripper's shape do not.
        """
        thinned = [downsample(trajectory) for trajectory in trajectories]
        points = np.concatenate([trajectory.triplets for trajectory in trajectories])  # (T, A, 3, 3)
        directions = np.concatenate([approaches(trajectory) for trajectory in trajectories])
        mean = directions.mean(axis=0)
        mean /= np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-9)
        leaning = np.arccos(np.clip((directions * mean).sum(axis=-1), -1, 1)).max(axis=0)
        heights = points[:, :, 1:] @ plane[:3] + plane[3]
        steps = np.array([_largest(step_lengths(t)) for t in thinned]).max(axis=0)
        detours = np.array([_largest(step_detours(t)) for t in thinned]).max(axis=0)
        turns = np.array([_largest(step_turns(t)) for t in thinned]).max(axis=0)
        wider = 1 + FEW / max(len(trajectories) - 1, 1)
        return cls(
            lower=points.min(axis=(0, 2)) - wider * POSITION_MARGIN_M,
            upper=points.max(axis=(0, 2)) + wider * POSITION_MARGIN_M,
            margin=wider * POSITION_MARGIN_M,
            lowest=heights.min(axis=(0, 2)) - HEIGHT_MARGIN_M,
            step=steps + wider * ((STEP_FACTOR - 1) * steps + STEP_MARGIN_M),
            detour=detours + wider * ((STEP_FACTOR - 1) * detours + STEP_MARGIN_M),
            turn=turns + wider * ((TURN_FACTOR - 1) * turns + TURN_MARGIN_RAD),
            approach=mean,
            tilt=leaning + wider * TILT_MARGIN_RAD,
            sides=np.median(triangle_sides(points), axis=0),
            length=LENGTH_FACTOR * np.array([step_lengths(t).sum(axis=0) for t in thinned]).max(axis=0),
            steps=max(len(t) for t in thinned),
            changes=frozenset(gripper_changes(trajectory) for trajectory in trajectories),
            plane=plane,
        )

    def check(self, trajectory: Trajectory) -> tuple[Finding, ...]:
        """What of ``trajectory`` lies outside, each an error that names the step, the value and the limit."""
        arms = len(self.lower)
        if trajectory.num_arms != arms:
            return (_outside("arms", f"the plan moves {trajectory.num_arms} arms, the demonstrations {arms}", 0, 0),)
        thinned = downsample(trajectory, length=max(self.steps, TARGET_STEPS))
        # a plan of fewer steps takes longer ones
        stretch = max(1.0, (self.steps - 1) / max(len(thinned) - 1, 1))
        found: list[Finding] = []
        for arm in range(arms):
            found += self._check_arm(thinned, arm, stretch, f"arm {arm + 1}: " if arms > 1 else "")
        if (changes := gripper_changes(trajectory)) not in self.changes:
            told = " or ".join(sorted(map(_in_words, self.changes))[:3])
            words = f"the plan's gripper goes {_in_words(changes)}, demonstrated was {told}"
            most = max(sum(map(len, known)) for known in self.changes)
            found.append(_outside("gripper changes", words, sum(map(len, changes)) - arms, most - arms))
        return tuple(found)

    def require(self, trajectory: Trajectory) -> None:
        """Raises `EnvelopeError` where `check` finds an error."""
        if found := errors(self.check(trajectory)):
            raise EnvelopeError(found)

    def _check_arm(self, trajectory: Trajectory, arm: int, stretch: float, name: str) -> list[Finding]:
        points = trajectory.triplets[:, arm]  # (T, 3, 3)
        lengths = step_lengths(trajectory)[:, arm]
        found: list[Finding] = []

        def bound(kind: str, values: FloatArray, limit: float, words: str, unit: float = 1.0) -> None:
            """Report the step with the largest of ``values`` where it exceeds ``limit``."""
            if len(values) and values.max() > limit:
                step = int(values.argmax())
                told = words.format(
                    step=step, next=step + 1, after=step + 2, value=unit * values[step], limit=unit * limit
                )
                found.append(_outside(kind, name + told, values[step], limit, step))

        outside = np.maximum(self.lower[arm] - points, points - self.upper[arm]).max(axis=(1, 2)) + self.margin
        words = "position of step {step} lies {value:.2f} m outside what was demonstrated, {limit:.2f} m allowed"
        bound("position", outside, self.margin, words)
        heights, lowest = (points[:, 1:] @ self.plane[:3] + self.plane[3]).min(axis=1), self.lowest[arm]
        if heights.min() < lowest:
            step = int(heights.argmin())
            words = f"{name}a fingertip is {heights[step] * 1e3:.0f} mm above the table at step {step}, too low"
            found.append(_outside("height", f"{words}: {lowest * 1e3:.0f} mm allowed", heights[step], lowest, step))
        words = "the gripper moves {value:.2f} m from step {step} to {next}, {limit:.2f} m allowed"
        bound("step length", lengths, self.step[arm] * stretch, words)
        words = "the gripper leaves the way from step {step} to {after} by {value:.2f} m, {limit:.2f} m allowed"
        bound("detour", step_detours(trajectory)[:, arm], self.detour[arm] * stretch, words)
        words = "the gripper turns {value:.0f} degrees from step {step} to {next}, {limit:.0f} degrees allowed"
        bound("turn", step_turns(trajectory)[:, arm], self.turn[arm] * stretch, words, DEGREES)
        tilts = np.arccos(np.clip(approaches(trajectory)[:, arm] @ self.approach[arm], -1, 1))
        words = (
            "the gripper's approach leans {value:.0f} degrees from the demonstrated one at step {step}, "
            "{limit:.0f} degrees allowed"
        )
        bound("tilt", tilts, self.tilt[arm], words, DEGREES)
        sides = triangle_sides(points)
        off = np.abs(sides - self.sides[arm]) - (SIDE_FACTOR * self.sides[arm] + SIDE_MARGIN_M)
        if off.max() > 0:
            step, side = (int(i) for i in np.unravel_index(int(off.argmax()), off.shape))
            value, usual = sides[step, side], self.sides[arm, side]
            what = "between the fingertips" if side == 0 else "between gripper point and fingertip"
            words = f"the gripper is {value * 1e3:.0f} mm {what} at step {step}, {usual * 1e3:.0f} mm demonstrated"
            found.append(_outside("gripper shape", name + words, value, usual, step))
        if (total := lengths.sum()) > (limit := self.length[arm]):
            words = f"{name}the path is {total:.2f} m long, {limit:.2f} m allowed"
            found.append(_outside("path length", words, total, limit))
        return found


def step_lengths(trajectory: Trajectory) -> FloatArray:
    """Metres ``(T - 1, A)`` that the middle of the fingertips moves from step to step."""
    return np.linalg.norm(np.diff(trajectory.triplets[:, :, 1:].mean(axis=2), axis=0), axis=-1)


def step_detours(trajectory: Trajectory) -> FloatArray:
    """Metres ``(T - 2, A)`` from the middle of the fingertips at a step to the middle of its neighbours'."""
    return np.linalg.norm(np.diff(trajectory.triplets[:, :, 1:].mean(axis=2), n=2, axis=0), axis=-1) / 2


def approaches(trajectory: Trajectory) -> FloatArray:
    """Unit vectors ``(T, A, 3)`` from the gripper point to the middle of the fingertips; zero where they coincide."""
    forward = trajectory.triplets[:, :, 1:].mean(axis=2) - trajectory.triplets[:, :, 0]
    return forward / np.maximum(np.linalg.norm(forward, axis=-1, keepdims=True), 1e-9)


def step_turns(trajectory: Trajectory) -> FloatArray:
    """Angle ``(T - 1, A)``, rad, by which the gripper turns from step to step."""
    forward = approaches(trajectory)
    across = trajectory.triplets[:, :, 1] - trajectory.triplets[:, :, 2]
    across -= (across * forward).sum(axis=-1, keepdims=True) * forward
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
    frames = np.stack([across, np.cross(forward, across), forward], axis=-1)  # (T, A, 3, 3)
    trace = np.einsum("taij,taij->ta", frames[1:], frames[:-1])
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))


def triangle_sides(points: FloatArray) -> FloatArray:
    """Lengths ``(..., 3)`` of fingertip to fingertip and gripper point to each fingertip, of ``points (..., 3, 3)``."""
    gripper, left, right = points[..., 0, :], points[..., 1, :], points[..., 2, :]
    return np.stack([np.linalg.norm(d, axis=-1) for d in (left - right, left - gripper, right - gripper)], axis=-1)


def gripper_changes(trajectory: Trajectory) -> tuple[tuple[int, ...], ...]:
    """The states that each arm's gripper goes through, in order: ``((0, 1), (0, 1, 0))``."""
    closed = (trajectory.gripper_state > 0.5).astype(int)
    return tuple(tuple(int(c) for c in column[np.concatenate([[True], np.diff(column) != 0])]) for column in closed.T)


def _in_words(changes: tuple[tuple[int, ...], ...]) -> str:
    return " and ".join("-".join("closed" if state else "open" for state in states[:6]) for states in changes)


def _largest(values: FloatArray) -> FloatArray:
    return values.max(axis=0) if len(values) else np.zeros(values.shape[1])


def _outside(kind: str, message: str, value: float, limit: float, step: int = -1) -> Finding:
    return Finding(
        f"envelope: {kind}", "error", message, {"value": float(value), "limit": float(limit), "step": float(step)}
    )
