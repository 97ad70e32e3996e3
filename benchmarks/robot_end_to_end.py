"""Demonstrations through leader, bus and follower, then `rip run`, on an emulated ALOHA cell with the task's physics.

    python benchmarks/robot_end_to_end.py [--task aloha-pick-banana] [--demonstrations 10] [--scenes 20]
        [--llm embedded] [--folder runs/robot-end-to-end] [--out docs/tables/robot_end_to_end.md]

A scripted hand moves the leader as the task's demonstrator moves: the leader's servos are on an emulated bus in a
process of its own, as the follower's are. Both are read and written by the real drivers, at 50 Hz. A browser's requests
keep the page with the live picture busy. Without ``--llm``
the plans are those of the nearest demonstrations (`neighbours`), which `rip run --plan` executes. The simulator
executes the plans, too, in the same scenes. An interrupted run continues.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from types import MappingProxyType

import numpy as np
from scipy.interpolate import PchipInterpolator

from robust_instant_policy.commands.live_camera import LiveCamera
from robust_instant_policy.datasets import DatasetWriter, load_demonstrations
from robust_instant_policy.errors import UnreachableError
from robust_instant_policy.evaluation import scene_seed
from robust_instant_policy.evaluation.statistics import wilson_interval
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.policies.neighbours import Neighbours
from robust_instant_policy.policies.policy import Plan
from robust_instant_policy.policies.settings import Settings
from robust_instant_policy.reporting.run import MEASURED_FILE, PLAN_FILE, SEEN_FILE, RunRecord, save_context
from robust_instant_policy.robots.cell import CellConfig, DeviceConfig
from robust_instant_policy.robots.emulation.client import emulated
from robust_instant_policy.robots.emulation.servos import ServoBus
from robust_instant_policy.robots.emulation.twin import SharedTwin, TwinState
from robust_instant_policy.robots.leaders import make_leader
from robust_instant_policy.robots.operator import ENTER
from robust_instant_policy.robots.path import MeasuredPath
from robust_instant_policy.robots.priority import DEVICE, take_real_time
from robust_instant_policy.robots.recording import jitter_95_ms
from robust_instant_policy.robots.session import Session
from robust_instant_policy.robots.signals import StopRequest
from robust_instant_policy.robots.station import Station
from robust_instant_policy.sanity import check_demonstrations
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.task import Attempt, Task

REST_S = 0.4  # of the hand, after it has shown a demonstration
CELL = """
[cell]
name = "end-to-end"
workspace = [[-0.40, -0.40, -0.005], [0.30, 0.40, 0.50]]
min_confidence = 0.0

[[arms]]
name = "left"
model = "viperx-300"
base = [-0.469, 0, 0, 0, 0, 0]
park = [-1.4, -0.43, 0.434, 0, 1.567, 0]
driver = { kind = "viperx", port = "" }
leader = { kind = "aloha", port = "" }

[camera]
kind = "emulated"
calibration = "camera.toml"
"""
CAMERA = "pose = [[0.0, -1, 0, -0.05], [-1, 0, 0, 0], [0, 0, -1, 0.85], [0, 0, 0, 1]]\n"  # of the simulated cell


class Hand:
    """A twin of a leader arm: where the hand is now, along ``rows (T, 7)`` of joints and finger travel at 50 Hz."""

    def __init__(self, rest: np.ndarray):
        self.rows, self.began = rest[None], 0.0

    def states(self) -> list[TwinState]:
        row = self.rows[min(int((time.monotonic() - self.began) * 50), len(self.rows) - 1)]
        return [TwinState(row[:-1], float(row[-1]), 0.0)]


def lead(rest: np.ndarray, travel: float, wire: Connection) -> None:
    """Emulate the leader's bus; begin the rows that come over ``wire``, until None comes."""
    take_real_time(DEVICE)
    hand = Hand(rest)
    wire.send(ServoBus(SharedTwin(hand), 0, travel).options)
    while (rows := wire.recv()) is not None:
        hand.began, hand.rows = time.monotonic(), rows


def watch(url: str) -> None:
    """Ask for the page's pictures as a browser does."""
    while True:
        for path in ("live.jpg", "state", "start"):
            with contextlib.suppress(OSError):
                urllib.request.urlopen(f"{url}/{path}", timeout=5).read()
        time.sleep(0.1)


class Person:
    """An `Operator` who moves the leader along ``rows`` once it is coupled, and keeps every demonstration."""

    def __init__(self, wire: Connection):
        self.stop, self.wire = StopRequest(), wire
        self.on_end: Callable[[], object] = lambda: None
        self.rows, self.done = np.zeros((0, 7)), np.inf

    def say(self, line: str) -> None:
        print(f"  {line}", flush=True)
        if line.startswith("coupled"):
            self.wire.send(self.rows)
            self.done = time.monotonic() + len(self.rows) / 50 + REST_S

    def pressed(self, keys: str) -> str:
        if time.monotonic() < self.done:
            return ""
        self.done = np.inf
        return ENTER

    def ask(self, line: str, keys: str) -> str:
        if "keeps it" in line:
            self.on_end()
        return ENTER


def rows_of(attempt: Attempt, arm: Arm) -> np.ndarray:
    """Joints and finger travel ``(T, 7)`` at 50 Hz that show the demonstration of an attempt."""
    trajectory, rate = attempt.demonstration.trajectory, attempt.demonstration.rate_hz
    joints = arm.kinematics.follow(arm.triangle.poses(trajectory.triplets[:, 0]), arm.home).joints
    joints = np.concatenate([arm.home[None], joints])
    times = np.arange(len(joints)) / rate
    at = np.arange(0.0, times[-1], 1 / 50)
    held = np.clip(np.searchsorted(times, at, side="right") - 2, 0, len(trajectory) - 1)
    travel = np.where(trajectory.gripper_state[held, 0] > 0.5, 0.0, arm.finger_travel)
    return np.column_stack([PchipInterpolator(times, joints)(at), travel])


def record(config: CellConfig, task: Task, folder: Path, count: int) -> dict[str, object]:
    """Record ``count`` demonstrations; returns the row of the table."""
    arm = Station(config).arms[0]
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    rest = np.append(arm.home, arm.finger_travel)
    leading = multiprocessing.get_context("spawn").Process(
        target=lead, args=(rest, arm.finger_travel, theirs), daemon=True
    )
    leading.start()
    with emulated(config) as emulation:
        port = DeviceConfig("aloha", MappingProxyType(ours.recv()), "leader")
        config = replace(emulation.config, arms=(replace(emulation.config.arms[0], leader=port),))
        person = Person(ours)
        results: list[str] = []
        person.on_end = lambda: results.append(emulation.failure())
        with (
            Station(config) as station,
            DatasetWriter(folder, task.name, task.description, config.rate_hz) as writer,
        ):
            leader = make_leader(config.arms[0], arm, config.rate_hz, folder, person.pressed)
            leader.connect()
            assert config.camera is not None
            seeds = iter(range(0 if writer.last_seed is None else writer.last_seed + 1, 10_000))

            def next_scene() -> int:
                for seed in seeds:  # a person repeats what failed; so does the task's demonstrator
                    attempt = task.demonstrate(seed)
                    if attempt.success:
                        break
                person.rows = rows_of(attempt, arm)
                ours.send(person.rows[:1])
                emulation.scene(seed)
                return seed

            camera = LiveCamera(config.camera, folder, folder, config.limits.workspace)
            camera.connect()
            browser = multiprocessing.get_context("spawn").Process(target=watch, args=(camera.url,), daemon=True)
            browser.start()
            Session(station, [leader], camera, writer, person, camera.show, next_scene).record(count)
            browser.terminate()
            camera.disconnect()
            leader.disconnect()
    ours.send(None)
    leading.join()
    demonstrations = load_demonstrations(folder)
    late = [float(one.info["jitter_95_ms"]) for one in demonstrations]
    return {
        "demonstrations": len(demonstrations),
        "seconds": float(np.mean([one.seconds for one in demonstrations])),
        "done": sum(not failure for failure in results),
        "tried": len(results),
        "jitter_median_ms": float(np.median(late)),
        "jitter_worst_ms": max(late),
        "findings": [str(finding) for finding in check_demonstrations(demonstrations).findings],
        "load": os.getloadavg()[0],
    }


class Planner:
    """Plans of `neighbours` from the recorded demonstrations."""

    def __init__(self, demos: Path, task: Task):
        self.demonstrations = load_demonstrations(demos)
        self.policy = Neighbours(Settings.of("adaptive").changed(workspace=task.workspace))
        self.policy.fit(self.demonstrations)

    def write(self, config: CellConfig, task: Task, seed: int, out: Path) -> None:
        """Write a run folder with the plan for the scene ``seed``, as `rip run --dry-run` does."""
        seen = task.reset(seed)
        plan = self.policy.plan(seen)
        out.mkdir(parents=True, exist_ok=True)
        seen.save(out / SEEN_FILE)
        replace(plan, cell=config.digest).save(out / PLAN_FILE)
        save_context(out, [one.observation.rgb for one in self.demonstrations], self.policy.context_.pixels)
        RunRecord(task.name, task.goal, None, "", self.policy.name, None, "planned, not executed", ()).save(out)


def run_scene(
    folder: Path, demos: Path, task: Task, index: int, planner: Planner | None, llm: str
) -> dict[str, object]:
    """`rip run` in one scene, and its plan executed by the simulator; returns the row."""
    seed = scene_seed(0, index)
    robot = write_cell(folder, task.name, seed)
    out = folder / f"run-{index}"
    command = [sys.executable, "-m", "robust_instant_policy.cli", "run", "--robot", str(robot), "--demos", str(demos)]
    command += ["--yes", "--speed", "1"]
    if planner is None:
        command += ["--llm", llm, "--out", str(out)]
    else:
        planner.write(CellConfig.load(robot), task, seed, out)
        command += ["--plan", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    row: dict[str, object] = {"seed": seed, "exit": done.returncode, "words": done.stderr.strip()[-300:]}
    if not (out / PLAN_FILE).exists():
        raise SystemExit(f"rip run failed in scene {index}: {done.stderr.strip()}")
    if (out / MEASURED_FILE).exists():
        path = MeasuredPath.load(out / MEASURED_FILE)
        row["jitter_95_ms"] = jitter_95_ms(path.seconds, path.rate_hz)
        row["following_rad"] = float(path.joint_errors.max(initial=0.0))
    outcome = RunRecord.load(out)
    plan = Plan.load(out / PLAN_FILE)
    return row | {"cell": bool(outcome.success), "outcome": outcome.outcome, "simulator": simulated(task, seed, plan)}


def simulated(task: Task, seed: int, plan: Plan) -> bool:
    task.reset(seed)
    try:
        return task.execute(plan.trajectory).success
    except UnreachableError:
        return False


def write_cell(folder: Path, task: str, seed: int) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "camera.toml").write_text(CAMERA)
    robot = folder / "cell.toml"
    robot.write_text(f'{CELL}\n[emulation]\ntask = "{task}"\nseed = {seed}\n')
    return robot


def table(name: str, method: str, recorded: dict, rows: list[dict]) -> str:
    done, same = sum(row["cell"] for row in rows), sum(row["simulator"] for row in rows)
    low, high = (round(100 * bound) for bound in wilson_interval(done, len(rows))) if rows else (0, 100)
    jitter = [row["jitter_95_ms"] for row in rows if "jitter_95_ms" in row]
    following = [row["following_rad"] for row in rows if "following_rad" in row]
    lines = [
        "| | " + name + " |",
        "| --- | --- |",
        f"| demonstrations at 50 Hz, mean length | {recorded['demonstrations']}, {recorded['seconds']:.1f} s |",
        f"| of them with the task done | {recorded['done']} of {recorded['tried']} |",
        f"| jitter, 95% of the steps (median, worst demonstration) | {recorded['jitter_median_ms']:.2f} ms, "
        f"{recorded['jitter_worst_ms']:.2f} ms |",
        f"| findings of `rip check` | {'; '.join(recorded['findings']) or 'none'} |",
    ]
    if rows:
        lines += [
            f"| `rip run`, plans by {method}: task done | {done} of {len(rows)} scenes ({low}% to {high}%) |",
            f"| the same plans executed by the simulated task | {same} of {len(rows)} |",
            f"| scenes in which the two differ | {sum(row['cell'] != row['simulator'] for row in rows)} |",
            f"| jitter of `rip run`, 95% of the steps (median, worst run) | {np.median(jitter):.2f} ms, "
            f"{max(jitter):.2f} ms |",
            f"| largest following error | {max(following):.3f} rad |",
        ]
    load = recorded["load"]
    lines += ["", f"{os.cpu_count()} cores, no GPU; load of the machine at the end of the recording {load:.1f}."]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="aloha-pick-banana", help="of one ALOHA arm")
    parser.add_argument("--demonstrations", type=int, default=10)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--llm", default="", help="plan with this language model (default: neighbours, without one)")
    parser.add_argument("--folder", type=Path, default=Path("runs/robot-end-to-end"))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    folder, demos = options.folder, options.folder / "demonstrations"
    kept = folder / "measured.json"
    measured = json.loads(kept.read_text()) if kept.exists() else {"recorded": None, "rows": []}
    task = make_task(options.task)
    if measured["recorded"] is None:
        config = CellConfig.load(write_cell(folder, options.task, 0))
        measured["recorded"] = record(config, task, demos, options.demonstrations)
        kept.write_text(json.dumps(measured, indent=1) + "\n")
    indices = range(len(measured["rows"]), options.scenes)
    planner = Planner(demos, task) if indices and not options.llm else None
    for index in indices:
        measured["rows"].append(run_scene(folder, demos, task, index, planner, options.llm))
        kept.write_text(json.dumps(measured, indent=1) + "\n")
        print(measured["rows"][-1], flush=True)
    text = table(options.task, options.llm or "neighbours", measured["recorded"], measured["rows"][: options.scenes])
    print(text)
    if options.out is not None:
        options.out.write_text(text)


if __name__ == "__main__":
    main()
