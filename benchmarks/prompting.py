"""How well, how fast and for how many tokens a language model imitates, by frames and layout of the prompt.

A synthetic pick-and-place: two objects, each turned and placed at random, five keypoints on each, measured with
noise; the gripper grasps the first object in its own frame and sets it down in the frame of the second. Ten
demonstrations, then scenes that were not shown. The error is the largest distance of any of the three gripper points
from where it belongs, at any key step: start, both sides of the grasp and of the release, end.

    python benchmarks/prompting.py --nearest-last --out docs/tables/prompting.md
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from robust_instant_policy.context import InContextPrompt
from robust_instant_policy.context.prompt import Frames, Layout, Order
from robust_instant_policy.geometry import FloatArray, GripperTriangle, interpolate_poses, make_pose
from robust_instant_policy.llm import connect
from robust_instant_policy.regression import robust_gripper_trajectory
from robust_instant_policy.trajectory import Trajectory, downsample

NUM_DEMOS = 10
MIN_CANDIDATES = 3
TRIANGLE = GripperTriangle(length=0.10, opening=0.08)
KEYPOINT_NOISE_M = 0.002
HAND_NOISE_M = 0.002  # of a demonstrator's waypoints
HAND_NOISE_RAD = np.radians(2.0)
WITHIN_M = 0.015
HOME = make_pose(np.diag([1.0, -1.0, -1.0]), [0.30, 0.0, 0.35])


@dataclass(frozen=True, eq=False)
class Scene:
    """Measured keypoints ``(K, 3)`` and what a demonstrator does in it."""

    keypoints: FloatArray
    trajectory: Trajectory


class PickAndPlace:
    """Draws scenes. The objects' keypoints and the grasp are those of ``seed``."""

    def __init__(self, seed: int = 0):
        rng = np.random.default_rng(seed)
        self.shapes = rng.uniform([-0.04, -0.04, 0.0], [0.04, 0.04, 0.03], (2, 5, 3))
        self.grasp = _down(rng.uniform(-0.01, 0.01, 2), 0.02, rng.uniform(-0.5, 0.5))
        self.place = _down(rng.uniform(-0.01, 0.01, 2), 0.05, rng.uniform(-0.5, 0.5))

    def scene(self, seed: int, *, exact: bool = False) -> Scene:
        """Scene of ``seed``; ``exact`` lets the demonstrator's hand be steady (the keypoints stay noisy)."""
        rng = np.random.default_rng([7, seed])
        while True:
            places = rng.uniform([0.35, -0.25], [0.65, 0.25], (2, 2))
            if np.linalg.norm(places[0] - places[1]) > 0.15:
                break
        objects = [_turned(place, angle) for place, angle in zip(places, rng.uniform(-1.5, 1.5, 2), strict=True)]
        keypoints = np.concatenate(
            [shape @ pose[:3, :3].T + pose[:3, 3] for shape, pose in zip(self.shapes, objects, strict=True)]
        )
        keypoints = keypoints + rng.normal(0, KEYPOINT_NOISE_M, keypoints.shape)
        grasp, place = objects[0] @ self.grasp, objects[1] @ self.place
        if not exact:
            grasp, place = _shaken(grasp, rng), _shaken(place, rng)
        ways = [
            (HOME, 0),
            (_raised(grasp, 0.10), 0),
            (grasp, 0),
            (grasp, 1),
            (_raised(grasp, 0.12), 1),
            (_raised(place, 0.12), 1),
            (place, 1),
            (place, 0),
            (_raised(place, 0.12), 0),
        ]
        return Scene(keypoints, downsample(_played(ways, rng)))


def _played(ways: list[tuple[FloatArray, int]], rng: np.random.Generator) -> Trajectory:
    poses, states = [ways[0][0][None]], [np.array([ways[0][1]])]
    for (start, _), (stop, state) in pairwise(ways):
        count = max(2, round(np.linalg.norm(stop[:3, 3] - start[:3, 3]) / 0.005 * rng.uniform(0.8, 1.25)))
        poses.append(interpolate_poses([0, 1], np.stack([start, stop]), np.arange(1, count + 1) / count))
        states.append(np.full(count, state))
    return Trajectory.from_poses(np.concatenate(poses), np.concatenate(states), TRIANGLE)


def _turned(place: FloatArray, angle: float) -> FloatArray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return make_pose([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], [*place, 0])


def _down(place: FloatArray, height: float, angle: float) -> FloatArray:
    return make_pose(_turned(place, angle)[:3, :3] @ np.diag([1.0, -1.0, -1.0]), [*place, height])


def _raised(pose: FloatArray, height: float) -> FloatArray:
    return make_pose(pose[:3, :3], pose[:3, 3] + [0, 0, height])


def _shaken(pose: FloatArray, rng: np.random.Generator) -> FloatArray:
    turn = _turned(np.zeros(2), rng.normal(0, HAND_NOISE_RAD))[:3, :3]
    return make_pose(turn @ pose[:3, :3], pose[:3, 3] + rng.normal(0, HAND_NOISE_M, 3))


def key_steps(trajectory: Trajectory) -> list[int]:
    """The start, both sides of every gripper change, and the end."""
    changes = np.flatnonzero(np.diff(np.round(trajectory.gripper_state[:, 0])))
    return [0, *(int(step) + side for step in changes for side in (0, 1)), len(trajectory) - 1]


def key_error(trajectory: Trajectory, truth: Trajectory) -> float:
    """Largest distance of the three gripper points from the truth at any key step, metres; infinite when the
    gripper opens and closes another number of times."""
    own, true = key_steps(trajectory), key_steps(truth)
    if len(own) != len(true):
        return float("inf")
    return float(np.linalg.norm(trajectory.triplets[own] - truth.triplets[true], axis=-1).max())


@dataclass(frozen=True)
class Row:
    """One line of the table: a way of asking."""

    model: str
    frames: Frames
    layout: Layout
    order: Order = "given"


@dataclass(frozen=True, eq=False)
class Outcome:
    """Key-step errors in metres (infinite where no plan came) and what the plans cost."""

    single: FloatArray
    gaussian: FloatArray
    robust: FloatArray
    refused: int
    answers: int
    tokens: list[int]  # read (not from a cache) and written, of each plan
    seconds: list[float]
    cpu_seconds: list[float]


def measure(row: Row, world: PickAndPlace, scenes: int, args: argparse.Namespace) -> Outcome:
    demos = [world.scene(seed) for seed in range(NUM_DEMOS)]
    prompt = InContextPrompt(row.frames, row.layout, row.order)
    prompt.fit(np.stack([demo.keypoints for demo in demos]), [demo.trajectory for demo in demos])
    model = connect(row.model)
    counts: Counter[bool] = Counter()
    single, gaussian, robust = [], [], []
    tokens, seconds, cpu_seconds = [], [], []
    for number in range(scenes):
        scene = world.scene(1000 + number, exact=True)
        start, cpu = time.monotonic(), time.process_time()
        answers = model.sample(
            prompt.queries(scene.keypoints),
            args.samples,
            temperature=args.temperature,
            seed=number,
            deadline_s=args.deadline,
            accept=prompt.accepts,
            on_answer=lambda query, sample, attempt, answer, accepted: counts.update([accepted]),
        )
        seconds.append(time.monotonic() - start)
        cpu_seconds.append(time.process_time() - cpu)
        every = [answer for own in answers for answer in own]
        tokens.append(sum(one.prompt_tokens - one.cached_tokens + one.completion_tokens for one in every))
        candidates = [
            prompt.trajectory([own[index].text for own in answers], scene.keypoints)
            for index in range(min(map(len, answers)))
        ]
        single += [key_error(candidate, scene.trajectory) for candidate in candidates]
        single += [float("inf")] * (args.samples - len(candidates))
        for results, dof in ((gaussian, float("inf")), (robust, 1.5)):
            if len(candidates) < MIN_CANDIDATES:
                results.append(float("inf"))
            else:
                fit = robust_gripper_trajectory([candidate.actions for candidate in candidates], dof=dof)
                results.append(key_error(Trajectory.from_actions(fit.actions), scene.trajectory))
    model.close()
    return Outcome(
        np.array(single),
        np.array(gaussian),
        np.array(robust),
        counts[False],
        counts.total(),
        tokens,
        seconds,
        cpu_seconds,
    )


def as_line(row: Row, outcome: Outcome) -> str:
    def cost(values: list[float], form: str) -> str:
        later = f"{np.median(values[1:]):{form}}" if len(values) > 1 else "—"
        return f"{values[0]:{form}} / {later}"

    name = row.model if row.model == "embedded" else Path(row.model.removeprefix("gguf:")).stem
    cells = (
        name + (", nearest last" if row.order == "nearest-last" else ""),
        f"{row.frames}, {row.layout}",
        str(len(outcome.robust)),
        _errors(outcome.single),
        _errors(outcome.gaussian),
        _errors(outcome.robust),
        f"{outcome.refused / max(outcome.answers, 1):.0%}",
        cost([float(value) for value in outcome.tokens], ".0f"),
        cost(outcome.seconds, ".1f"),
        cost(outcome.cpu_seconds, ".1f"),
        f"{os.getloadavg()[2]:.1f} on {os.cpu_count()} cores",
    )
    return "| " + " | ".join(cells) + " |"


def reference_line(world: PickAndPlace, scenes: int) -> str:
    """What the frames give without any model: every number the demonstrations' median."""
    demos = [world.scene(seed) for seed in range(NUM_DEMOS)]
    prompt = InContextPrompt().fit(np.stack([demo.keypoints for demo in demos]), [demo.trajectory for demo in demos])
    errors = []
    for number in range(scenes):
        scene = world.scene(1000 + number, exact=True)
        errors.append(key_error(prompt.median_trajectory(scene.keypoints), scene.trajectory))
    cells = ("none: the demonstrations' median", "adaptive, factorised", str(scenes), _errors(np.array(errors)))
    return "| " + " | ".join([*cells, *[""] * (len(COLUMNS) - len(cells))]) + " |"


def _errors(values: FloatArray) -> str:
    median = float(np.median(values)) * 1000
    return f"{'—' if np.isinf(median) else f'{median:.1f}'} mm, {np.mean(values <= WITHIN_M):.0%}"


COLUMNS = (
    "model",
    "frames, layout",
    "scenes",
    "single sample",
    "Gaussian mean",
    "Student's t",
    "unparsable",
    "tokens a plan, first / later",
    "seconds, first / later",
    "CPU seconds, first / later",
    "load of the machine",
)
HEADER = "| " + " | ".join(COLUMNS) + " |\n|" + " --- |" * len(COLUMNS) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", default=["embedded"], help="as for rip.connect")
    parser.add_argument("--frames", nargs="+", default=["world", "adaptive"])
    parser.add_argument("--layouts", nargs="+", default=["sequence", "factorised"])
    parser.add_argument("--nearest-last", action="store_true", help="also with the nearest demonstration last")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--sequence-scenes", type=int, default=3, help="sequences take a minute or more a plan")
    parser.add_argument("--samples", type=int, default=5)
    parser.add_argument("--temperature", type=float, default=0.5)
    parser.add_argument("--deadline", type=float, default=300.0, help="seconds a plan")
    parser.add_argument("--world", type=int, default=0, help="seed of the objects")
    parser.add_argument("--out", type=Path, help="also write the table there")
    args = parser.parse_args()
    world = PickAndPlace(args.world)
    lines = [reference_line(world, args.scenes)]
    orders: list[Order] = ["given", "nearest-last"] if args.nearest_last else ["given"]
    for name in args.models:
        for layout in args.layouts:
            for frames in args.frames:
                for order in orders:
                    row = Row(name, frames, layout, order)
                    scenes = args.sequence_scenes if layout == "sequence" else args.scenes
                    lines.append(as_line(row, measure(row, world, scenes, args)))
                    print(lines[-1], flush=True)
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        lines = merged(args.out.read_text().splitlines() if args.out.exists() else [], lines)
    table = (
        "Written by `benchmarks/prompting.py`, a row at a time. "
        f"{NUM_DEMOS} demonstrations, Q = {args.samples}, temperature {args.temperature:g}.\n\n"
        + HEADER
        + "\n".join(lines)
        + "\n"
    )
    print("\n" + table)
    if args.out is not None:
        args.out.write_text(table)


def merged(old: list[str], new: list[str]) -> list[str]:
    """Rows of earlier runs that were not measured again, and the new ones."""
    names = [line.split("|")[1:3] for line in new]
    rows = [line for line in old if line.startswith("| ") and line.split("|")[1:3] not in names]
    return sorted([*(row for row in rows if row not in HEADER and not row.startswith("| ---")), *new])


if __name__ == "__main__":
    main()
