"""Success of the demonstrators and of replayed recordings, and the speed of the simulation.

    python benchmarks/simulation.py [--attempts 100] [--tasks push-cube …] [--out results/simulation.md]
    python benchmarks/simulation.py --level hard --downsampling masked --no-speed --out results/simulation-hard.md

Replays execute the recording, downsampled to about 30 steps, in its scene. Measurements are stored beside ``--out`` as
.json; an interrupted run continues.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from robust_instant_policy.errors import UnreachableError
from robust_instant_policy.policies.settings import DOWNSAMPLING
from robust_instant_policy.tasks import TASK_NAMES, UNSEEN_TASKS, make_task
from robust_instant_policy.tasks.level import LEVELS, PAPER
from robust_instant_policy.tasks.task import Task
from robust_instant_policy.trajectory import Trajectory, downsample

TIMED_EPISODES = 5


@dataclass(frozen=True)
class Quality:
    task: str
    objects: str
    attempts: int
    successes: int
    seconds: float
    replayed: dict[str, int]


@dataclass(frozen=True)
class Speed:
    task: str
    reset_s: float
    bare: float  # simulated seconds per wall second
    filmed: float
    episodes_an_hour: float
    episodes_an_hour_with_images: float


def replays(task: Task, seed: int, trajectory: Trajectory) -> bool:
    task.reset(seed)
    try:
        return task.execute(trajectory).success
    except UnreachableError:
        return False


def measure_quality(task: Task, objects: str, attempts: int, downsampling: list[str]) -> Quality:
    seconds, replayed = [], dict.fromkeys(downsampling, 0)
    for seed in range(attempts):
        attempt = task.demonstrate(seed)
        if attempt.success:
            seconds.append(attempt.demonstration.seconds)
            for method in replayed:
                replayed[method] += replays(task, seed, downsample(attempt.demonstration.trajectory, method))
    return Quality(task.name, objects, attempts, len(seconds), float(np.mean(seconds)), replayed)


def measure_speed(task: Task) -> Speed:
    task.demonstrate(0)  # the first image of a process also compiles the shaders
    started = time.perf_counter()
    trajectories = [task.demonstrate(seed).demonstration.trajectory for seed in range(TIMED_EPISODES)]
    demonstrating = time.perf_counter() - started
    started = time.perf_counter()
    task.demonstrate(0, with_images=True)
    with_images = time.perf_counter() - started
    resetting, running, simulated = 0.0, {False: 0.0, True: 0.0}, 0.0
    for seed, trajectory in enumerate(trajectories):
        for filmed in running:
            started = time.perf_counter()
            task.reset(seed)
            resetting += time.perf_counter() - started
            started = time.perf_counter()
            execution = task.execute(downsample(trajectory), (lambda frame: None) if filmed else None)
            running[filmed] += time.perf_counter() - started
        simulated += execution.seconds
    return Speed(
        task.name,
        resetting / (2 * TIMED_EPISODES),
        simulated / running[False],
        simulated / running[True],
        3600 * TIMED_EPISODES / demonstrating,
        3600 / with_images,
    )


def page(qualities: list[Quality], speeds: list[Speed]) -> str:
    lines = [
        "| task | objects | demonstrator succeeds | episode | masked replay succeeds | uniform replay succeeds |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for one in qualities:
        masked, uniform = (
            f"{one.replayed[method]}/{one.successes}" if method in one.replayed else "–" for method in DOWNSAMPLING
        )
        succeeds = f"{one.successes}/{one.attempts}"
        lines.append(f"| {one.task} | {one.objects} | {succeeds} | {one.seconds:.1f} s | {masked} | {uniform} |")
    if speeds:
        lines += speed_table(speeds)
    return "\n".join(lines) + "\n"


def speed_table(speeds: list[Speed]) -> list[str]:
    lines = [
        "",
        "| task | reset with image | simulated s per s | with video | recorded episodes/h | with images |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for each in speeds:
        lines.append(
            f"| {each.task} | {each.reset_s:.2f} s | {each.bare:.1f} | {each.filmed:.1f} "
            f"| {each.episodes_an_hour:.0f} | {each.episodes_an_hour_with_images:.0f} |"
        )
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    lines += [
        "",
        f"{os.cpu_count()} cores, {platform.machine()}, no GPU; load of the machine while measuring {load:.1f}.",
    ]
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--attempts", type=int, default=100)
    parser.add_argument("--tasks", nargs="+", choices=TASK_NAMES, default=TASK_NAMES)
    parser.add_argument("--level", choices=tuple(LEVELS), default=PAPER.name)
    parser.add_argument("--downsampling", nargs="+", choices=DOWNSAMPLING, default=DOWNSAMPLING)
    parser.add_argument("--no-speed", action="store_true", help="measure successes only")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    kept = None if options.out is None else options.out.with_suffix(".json")
    measured = json.loads(kept.read_text()) if kept is not None and kept.exists() else {}
    wanted = [(n, o) for n in options.tasks for o in (("seen", "unseen") if n in UNSEEN_TASKS else ("seen",))]
    for name, objects in wanted:
        key = f"{name} {objects} {options.attempts} {options.level}"
        if key in measured:
            continue
        task = make_task(name, objects, level=options.level)
        speed = asdict(measure_speed(task)) if objects == "seen" and not options.no_speed else None
        quality = measure_quality(task, objects, options.attempts, options.downsampling)
        measured[key] = {"quality": asdict(quality), "speed": speed}
        task.close()
        print(key, measured[key], flush=True)
        if kept is not None:
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(json.dumps(measured, indent=1) + "\n")
    rows = [measured[f"{name} {objects} {options.attempts} {options.level}"] for name, objects in wanted]
    text = page([Quality(**row["quality"]) for row in rows], [Speed(**row["speed"]) for row in rows if row["speed"]])
    print(text)
    if options.out:
        options.out.write_text(text)


if __name__ == "__main__":
    main()
