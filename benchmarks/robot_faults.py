"""Faults injected into emulated cells while arms move: does a command leave the limits, does an arm move on or let go?

    python benchmarks/robot_faults.py [--quick] [--out docs/tables/robot_faults.md] [--rows runs/robot-faults.jsonl]
    python benchmarks/robot_faults.py --watchdog --out docs/tables/robot_watchdog.md --rows runs/robot-watchdog.jsonl

The drivers are the real ones; the emulated devices keep what they executed, and that is what is judged. Each case has
its own motion and moment of the fault, from its seed. An interrupted run continues. ``--watchdog`` injects the faults
of devices at the rate and with the timeouts of real ones, and measures how long the arm goes on.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import resource
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from unittest import mock

import numpy as np

from robust_instant_policy.errors import RipError
from robust_instant_policy.geometry import FloatArray, make_pose
from robust_instant_policy.motion.arm import Arm, Motion
from robust_instant_policy.motion.guard import ROUNDING_M, Space, check_joint_range, plan_guarded
from robust_instant_policy.robots.camera import Frame
from robust_instant_policy.robots.cell import CellConfig, DeviceConfig
from robust_instant_policy.robots.emulation.client import Emulation, emulated
from robust_instant_policy.robots.execution import is_parked, observe, park, require_trust
from robust_instant_policy.robots.path import MeasuredPath
from robust_instant_policy.robots.signals import StopRequest, stop_on_signals
from robust_instant_policy.robots.station import Played, Station
from robust_instant_policy.trajectory import Trajectory

CELLS = {
    "viperx": ("left", "viperx-300", (-0.469, 0, 0, 0, 0, 0), (-1.4, -0.43, 0.434, 0, 1.567, 0), (-0.15, 0.0), 10.0),
    "ur5e": ("hand-e", "ur5e-hand-e", (-0.5, 0, 0, 0, 0, 0), (0.9, -1.9, 2.2, -1.87, -1.5708, -0.67), (0.0, 0.0), 4.0),
}  # name, model, base, park, middle of the targets in x and y, pace
ARMS = {"viperx": "ViperX 300", "ur5e": "UR5e"}
WATCHED = ("unplugged", "silent", "overload", "frozen", "nan", "protective-stop")  # of devices that no longer answer
WATCHDOG_CASES = 4  # of each
STOPPING_S = 0.1  # in which an arm must stop once the process that commands it has ended
STILL_S = 0.5  # after a stop, in which nothing may be executed any more
HOLD_COMMANDS = 2  # that a stop itself may execute, at the present position
SPEED_TOLERANCE = 1.1  # of executed speeds: servos count whole units, the last step of a stop included
HELD_RAD = 0.6  # largest change of a stop's own command: something stood in the way


@dataclass(frozen=True)
class Kind:
    """A fault, the arm it happens to, how many cases it has, and what it does."""

    name: str
    arm: str
    cases: int
    inject: Callable[[Case], Outcome]


@dataclass(frozen=True)
class Outcome:
    """What a case led to: ``said`` is the message, empty where the motion ended as planned."""

    said: str
    kept: bool  # the measured path until then can be read back, or nothing had moved
    executed: FloatArray  # commands that the device executed, (N, J + 1)
    after: int  # further ones, `STILL_S` later
    limp: bool
    late: float | None = None  # seconds from the fault to the last command that the device executed


class Bench:
    """An emulated cell, started anew where a fault has broken it."""

    def __init__(self, kind: str, folder: Path, real_time: bool):
        name, model, base, parked, self.middle, pace = CELLS[kind]
        path = folder / f"{kind}.toml"
        path.write_text(
            f"[cell]\nworkspace = [[-0.4, -0.4, -0.005], [0.4, 0.4, 0.4]]\n"
            f"[[arms]]\nname = '{name}'\nmodel = '{model}'\nbase = {list(base)}\npark = {list(parked)}\n"
            f"driver = {{ kind = '{kind}' }}\n[emulation]\npace = {pace}\n"
        )
        self.name, self._config, self._real_time = name, CellConfig.load(path), real_time
        self._context: AbstractContextManager[Emulation] | None = None
        self._emulation: Emulation | None = None

    def ready(self) -> Emulation:
        """The running cell, without a fault and its arm parked."""
        if self._emulation is None:
            self._context = emulated(self._config)
            self._emulation = self._context.__enter__()
        self._emulation.fault(self.name, "")
        with Station(self._emulation.config) as station:
            if not is_parked(station) and (stopped := park(station, StopRequest(), 1.0).stopped):
                raise SystemExit(f"the emulated arm could not be parked for the next case: {stopped}; run again")
        if self._real_time:
            return replace(self._emulation, config=in_real_time(self._emulation.config))
        return self._emulation

    def close(self) -> None:
        if self._context is not None:
            self._context.__exit__(None, None, None)
        self._context = self._emulation = None


def in_real_time(config: CellConfig) -> CellConfig:
    """``config`` with the rate and the timeouts of real devices at the ports of the emulated ones."""

    def real(driver: DeviceConfig) -> DeviceConfig:
        ports = {key: value for key, value in driver.options.items() if key in ("port", "address")}
        return replace(driver, options=MappingProxyType(ports))

    return replace(config, arms=tuple(replace(arm, driver=real(arm.driver)) for arm in config.arms), emulation=None)


@dataclass(frozen=True)
class Case:
    """One case: its cell, and its random numbers."""

    bench: Bench
    fault: str
    seed: int
    folder: Path

    @property
    def rng(self) -> np.random.Generator:
        return np.random.default_rng([self.seed, *self.fault.encode()])

    def trajectory(self, arm: Arm) -> Trajectory:
        """Down to a random place, close, and up again."""
        x, y = self.bench.middle + self.rng.uniform(-0.08, 0.08, 2)
        home = arm.home_pose[:3, :3]
        poses = np.array([make_pose(home, (x, y, height)) for height in (0.08, 0.02, 0.08)])
        return Trajectory.from_poses(poses, [0.0, 1.0, 1.0], arm.triangle)

    def motion(self, station: Station) -> Motion:
        config = station.config
        return plan_guarded(self.trajectory(station.arms[0]), station.arms, config.limits, 2.0, station.rate_hz)

    def moment(self, motion: Motion) -> int:
        """The number of executed commands after which the fault happens."""
        return int(self.rng.integers(10, int(0.7 * len(motion.joints))))


def during_motion(fault: str) -> Callable[[Case], Outcome]:
    """A fault of the device at a random moment of a motion."""

    def inject(case: Case) -> Outcome:
        emulation = case.bench.ready()
        begun, since = len(emulation.commands()), [math.inf]

        def fail() -> None:
            since[0] = emulation.fault(case.bench.name, fault)

        with Station(emulation.config) as station:
            motion = case.motion(station)
            with _at(emulation, begun + case.moment(motion), fail):
                played = station.play(motion, StopRequest())
        if math.isinf(since[0]):
            raise SystemExit(f"stopped before the fault, this computer is too busy: {played.stopped}; run again")
        return replace(_judged(case, emulation, begun, played), late=max(emulation.times()[-1] - since[0], 0.0))

    return inject


def clock_jump(case: Case) -> Outcome:
    """The system's time jumps by an hour, forward or back, and more than once."""
    emulation = case.bench.ready()
    begun = len(emulation.commands())
    real, jump = time.time, [0.0]
    with mock.patch("time.time", side_effect=lambda: real() + jump[0]), Station(emulation.config) as station:
        motion = case.motion(station)
        with _at(
            emulation, begun + case.moment(motion), lambda: jump.__setitem__(0, case.rng.choice([-3600.0, 3600.0]))
        ):
            played = station.play(motion, StopRequest())
    return _judged(case, emulation, begun, played)


def ended_by(number: signal.Signals) -> Callable[[Case], Outcome]:
    """The process that moves the arm is killed, or asked to end."""

    def inject(case: Case) -> Outcome:
        emulation = case.bench.ready()
        begun = len(emulation.commands())
        process = multiprocessing.get_context("fork").Process(target=_victim, args=(case, emulation))
        process.start()
        with _at(emulation, begun + int(case.rng.integers(10, 100)), lambda: os.kill(process.pid, number)):
            process.join()
        time.sleep(STOPPING_S)
        kept = number == signal.SIGKILL or (case.folder / "measured.npz").exists()
        return _outcome(f"ended by {number.name}", kept, emulation, begun)

    return inject


def full_disk(case: Case) -> Outcome:
    """No byte can be written when the path is stored; that of the run before must stay."""
    emulation = case.bench.ready()
    begun = len(emulation.commands())
    file = case.folder / "measured.npz"
    with Station(emulation.config) as station:
        played = station.play(case.motion(station), StopRequest())
        played.path.save(file)
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
        try:
            said = ""
            played.path.save(file)
        except RipError as error:
            said = str(error)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
            signal.signal(signal.SIGXFSZ, before)
    return _outcome(said, len(MeasuredPath.load(file).seconds) == len(played.path.seconds), emulation, begun)


def camera_fault(fault: str) -> Callable[[Case], Outcome]:
    """A camera that repeats its image, or sees no depth: refused before an arm moves."""

    def inject(case: Case) -> Outcome:
        emulation = case.bench.ready()
        begun = len(emulation.commands())
        config = replace(emulation.config, camera_pose=np.diag([1.0, -1.0, -1.0, 1.0]))
        return _refusal(lambda: observe(config, FaultyCamera(fault)), emulation, begun)

    return inject


class FaultyCamera:
    """See `robots.camera.Camera`."""

    name = "faulty"

    def __init__(self, fault: str):
        self._fault, self._frames = fault, 0

    def read(self) -> Frame:
        self._frames += 1
        depth = np.zeros((48, 64)) if self._fault == "zeros" else np.full((48, 64), 0.8)
        stamp = 1.0 if self._fault == "frozen" else float(self._frames)
        rgb = np.zeros((48, 64, 3), dtype=np.uint8)
        return Frame(rgb, depth.astype(np.float32), np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), stamp)

    def connect(self) -> None: ...
    def disconnect(self) -> None: ...


def wrong_plan(fault: str) -> Callable[[Case], Outcome]:
    """A plan that jumps, turns, goes into the table, or was made for another cell: refused before an arm moves."""

    def inject(case: Case) -> Outcome:
        emulation = case.bench.ready()
        begun = len(emulation.commands())
        config = emulation.config
        station = Station(config)

        def attempt() -> None:
            require_trust(config, 0.5 if fault == "doubt" else 0.99, "other" if fault == "cell" else config.digest)
            actions = case.trajectory(station.arms[0]).actions.copy()
            points = actions[1, :9].reshape(3, 3)
            if fault == "jump":
                points += case.rng.choice([-1, 1], 3) * [0.4, 0.4, 0.0]
            elif fault == "turn":
                middle = points.mean(axis=0)
                points[:, 0], points[:, 1] = middle[0] - (points - middle)[:, 1], middle[1] + (points - middle)[:, 0]
            elif fault == "table":
                points[:, 2] -= 0.08
            changed = actions.copy()
            changed[1, :9] = points.ravel()
            plan_guarded(Trajectory.from_actions(changed), station.arms, config.limits, 2.0, station.rate_hz)

        return _refusal(attempt, emulation, begun)

    return inject


KINDS = (
    *(Kind(name, "viperx", cases, during_motion(name)) for name, cases in (
        ("unplugged", 14), ("silent", 14), ("garbled", 14), ("overload", 14), ("frozen", 12), ("blocked", 12),
        ("nan", 12),
    )),
    *(Kind(name, "ur5e", cases, during_motion(name)) for name, cases in (
        ("protective-stop", 14), ("unplugged", 12), ("silent", 8), ("frozen", 8), ("nan", 8),
    )),
    Kind("clock jump", "viperx", 10, clock_jump),
    Kind("process killed", "viperx", 4, ended_by(signal.SIGKILL)),
    Kind("commanding process killed", "ur5e", 4, ended_by(signal.SIGKILL)),
    Kind("terminal closed", "viperx", 6, ended_by(signal.SIGHUP)),
    Kind("full disk", "viperx", 6, full_disk),
    Kind("camera frozen", "viperx", 4, camera_fault("frozen")),
    Kind("depth of zeros", "viperx", 4, camera_fault("zeros")),
    *(Kind(f"plan: {name}", "viperx", 4, wrong_plan(fault)) for name, fault in (
        ("jump", "jump"), ("turn", "turn"), ("into the table", "table"), ("another calibration", "cell"),
        ("doubt", "doubt"),
    )),
)  # fmt: skip
BREAKING = ("unplugged", "overload")  # the emulated cell must be started anew after these


def _victim(case: Case, emulation: Emulation) -> None:
    """What a process does that is ended from outside."""
    with stop_on_signals() as stop, Station(emulation.config) as station:
        played = station.play(case.motion(station), stop)
        played.path.save(case.folder / "measured.npz")


@contextmanager
def _at(emulation: Emulation, count: int, action: Callable[[], object]) -> Iterator[None]:
    """Do something once ``count`` commands were executed, unless the context ends before."""
    ended = threading.Event()

    def wait() -> None:
        while len(emulation.commands()) < count:
            if ended.wait(0.01):
                return
        action()

    thread = threading.Thread(target=wait)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _refusal(attempt: Callable[[], object], emulation: Emulation, begun: int) -> Outcome:
    said = ""
    try:
        attempt()
    except RipError as error:
        said = str(error)
    return _outcome(said, True, emulation, begun)


def _judged(case: Case, emulation: Emulation, begun: int, played: Played) -> Outcome:
    file = case.folder / "measured.npz"
    played.path.save(file)
    return _outcome(played.stopped, len(MeasuredPath.load(file).seconds) > 0, emulation, begun)


def _outcome(said: str, kept: bool, emulation: Emulation, begun: int) -> Outcome:
    executed = emulation.commands()
    time.sleep(STILL_S)
    later = emulation.commands()
    return Outcome(said, kept, executed[begun:, 0], len(later) - len(executed), bool(emulation.limp()))


def outside_limits(executed: FloatArray, arm: Arm, config: CellConfig) -> str:
    """Which limit the executed commands ``(N, J + 1)`` leave, empty for none."""
    joints = executed[:, None, :-1]
    if len(joints) == 0:
        return ""
    try:
        if not np.isfinite(executed).all():
            return "not a number"
        check_joint_range(joints[:, 0], arm, config.rate_hz)
        space = Space([arm], config.limits)
        on_its_way_in = (space.outside(joints) > ROUNDING_M).all()  # from the park pose, when it was stopped
        space.check(joints, config.rate_hz, to_home=on_its_way_in)
    except RipError as error:
        return str(error)
    steps = np.abs(np.diff(joints[:, 0], axis=0)).max(axis=1)
    # The last commands of a stop put the goal where the arm is, if something held it back: it does not move by them.
    moving, holding = steps[:-HOLD_COMMANDS], steps[-HOLD_COMMANDS:]
    fast = moving.max(initial=0.0) * config.rate_hz
    if fast > SPEED_TOLERANCE * arm.joint_speed or holding.max(initial=0.0) > HELD_RAD:
        return f"{fast:.2f} rad/s, and {holding.max(initial=0.0):.2f} rad at the stop"
    return ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one case of each fault")
    parser.add_argument("--kinds", nargs="*", help="only these")
    parser.add_argument("--watchdog", action="store_true", help="how long an arm goes on, at the rate of real devices")
    parser.add_argument("--rows", type=Path, default=Path("runs/robot-faults.jsonl"))
    parser.add_argument("--out", type=Path, default=Path("docs/tables/robot_faults.md"))
    options = parser.parse_args()
    options.rows.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in options.rows.read_text().splitlines()] if options.rows.exists() else []
    done = {(row["fault"], row["arm"], row["seed"]) for row in rows}
    kinds = [kind for kind in KINDS if kind.name in (options.kinds or [one.name for one in KINDS])]
    if options.watchdog:
        kinds = [replace(kind, cases=WATCHDOG_CASES) for kind in kinds if kind.name in WATCHED]
    with tempfile.TemporaryDirectory() as folder:
        benches = {name: Bench(name, Path(folder), options.watchdog) for name in CELLS}
        try:
            for kind in kinds:
                for seed in range(1 if options.quick else kind.cases):
                    if (kind.name, kind.arm, seed) in done:
                        continue
                    rows.append(one(kind, seed, benches[kind.arm]))
                    with options.rows.open("a") as file:
                        file.write(json.dumps(rows[-1]) + "\n")
                    print(rows[-1], flush=True)
        finally:
            for bench in benches.values():
                bench.close()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(watchdog_table(rows) if options.watchdog else table(rows))
    print(options.out.read_text())


def one(kind: Kind, seed: int, bench: Bench) -> dict:
    """The row of one case."""
    with tempfile.TemporaryDirectory() as folder:
        outcome = kind.inject(Case(bench, kind.name, seed, Path(folder)))
    emulation = bench._emulation
    assert emulation is not None
    arm = Station(emulation.config).arms[0]
    outside = outside_limits(outcome.executed, arm, emulation.config)
    if kind.name in BREAKING:
        bench.close()
    facts = {key: value for key, value in asdict(outcome).items() if key != "executed"}
    return {
        "fault": kind.name,
        "arm": kind.arm,
        "seed": seed,
        "executed": len(outcome.executed),
        "outside": outside,
        **facts,
    }


def watchdog_table(rows: list[dict]) -> str:
    lines = [
        "| fault | arm | cases | last command after the fault: median | worst |",
        "| --- | --- | --- | --- | --- |",
    ]
    for fault, arm in dict.fromkeys((row["fault"], row["arm"]) for row in rows):
        late = [1e3 * row["late"] for row in rows if (row["fault"], row["arm"]) == (fault, arm)]
        lines.append(f"| {fault} | {ARMS[arm]} | {len(late)} | {np.median(late):.0f} ms | {max(late):.0f} ms |")
    load = f"{os.cpu_count()} cores; load of the machine at the end {os.getloadavg()[0]:.1f}."
    return "\n".join([*lines, "", load]) + "\n"


def table(rows: list[dict]) -> str:
    head = ("fault", "arm", "cases", "stopped or refused", "ended as planned", "commands outside the limits",
            "moved on", "torque switched off", "path lost")  # fmt: skip
    lines = [f"| {' | '.join(head)} |", f"| {' | '.join('---' for _ in head)} |"]
    groups = {(row["fault"], row["arm"]): [] for row in rows}
    for row in rows:
        groups[row["fault"], row["arm"]].append(row)
    for (fault, arm), cases in [*groups.items(), (("**all**", ""), rows)]:
        counts = (
            len(cases),
            sum(bool(row["said"]) for row in cases),
            sum(not row["said"] for row in cases),
            sum(bool(row["outside"]) for row in cases),
            sum(row["after"] > 0 for row in cases),
            sum(row["limp"] for row in cases),
            sum(not row["kept"] for row in cases),
        )
        lines.append(f"| {fault} | {ARMS.get(arm, '')} | {' | '.join(map(str, counts))} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
