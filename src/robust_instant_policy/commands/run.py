"""`rip run`: plan for what a real cell's camera sees, show the plan, and execute it once it is confirmed."""

import argparse
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

from robust_instant_policy.commands.console import StageConsole
from robust_instant_policy.commands.options import RUNS, add_method, share
from robust_instant_policy.commands.planning import fitted_policy
from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import StoppedError, UsageError
from robust_instant_policy.files import make_folder, write_whole
from robust_instant_policy.llm import model_name
from robust_instant_policy.motion.arm import Motion
from robust_instant_policy.motion.guard import plan_guarded
from robust_instant_policy.policies import KeypointPolicy
from robust_instant_policy.policies.policy import Plan
from robust_instant_policy.reporting.run import (
    MEASURED_FILE,
    PLAN_FILE,
    SEEN_FILE,
    SWEEP_FILE,
    RunRecord,
    save_context,
    write_report,
)
from robust_instant_policy.robots.cameras import make_camera
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.device import connected
from robust_instant_policy.robots.emulation.client import Emulation, devices_of
from robust_instant_policy.robots.execution import (
    has_open_grippers,
    is_parked,
    observe,
    open_grippers,
    park,
    require_trust,
)
from robust_instant_policy.robots.path import Sweep
from robust_instant_policy.robots.signals import stop_on_signals
from robust_instant_policy.robots.station import Played, Station

PLANNED, UNJUDGED = "planned, not executed", "executed, not judged"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", type=Path, required=True, metavar="FILE", help="file of the cell")
    parser.add_argument("--demos", metavar="DIR", help="folder of demonstrations of this cell")
    parser.add_argument(
        "--plan", type=Path, metavar="DIR", help="execute the plan of an earlier --dry-run in this folder"
    )
    parser.add_argument("--dry-run", action="store_true", help="everything but the motion: no arm is connected")
    parser.add_argument("--yes", action="store_true", help="execute without asking")
    parser.add_argument(
        "--speed",
        type=share(0.05),
        metavar="SHARE",
        help="of the usual speed, 0.05 to 1 (default: 1, and first_run_speed until a run in this cell ended well)",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="run folder (default: runs/CELL)")
    add_method(parser)


def run(options: argparse.Namespace) -> int:
    screen = StageConsole()
    config = CellConfig.load(options.robot)
    if options.plan is None and options.demos is None:
        raise UsageError("--demos DIR is missing: the demonstrations to plan from (or --plan DIR, a plan to execute)")
    if options.plan is not None and not (options.plan / PLAN_FILE).exists():
        raise UsageError(f"{options.plan} holds no plan; make one with: rip run --dry-run --out {options.plan}")
    out = options.plan or options.out or RUNS / config.name
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out} is a file; a run needs a folder")
    make_folder(out)
    with ExitStack() as stack:
        config, emulation = stack.enter_context(devices_of(config))
        planner = None
        if options.plan is None:
            shown = load_demonstrations(options.demos)
            policy = stack.enter_context(fitted_policy(options, shown, screen, config.limits.workspace))
            planner = _Planner(config, screen, shown, policy, model_name(options.llm))
        _Run(config, emulation, planner, out, options, screen).run()
        for number in count(2):
            if options.plan or options.dry_run or options.yes or not _goes_on():
                break
            if emulation is not None:
                emulation.scene(number - 1 + config.emulation_section().whole("seed", 0))
            screen.stages.clear()
            _Run(config, emulation, planner, out.parent / f"{out.name or RUNS.name}-{number}", options, screen).run()
    return 0


@dataclass(frozen=True, eq=False)
class _Planner:
    """Plans from demonstrations for one scene after another."""

    config: CellConfig
    screen: StageConsole
    demonstrations: Sequence[Demonstration]
    policy: KeypointPolicy
    llm: str

    def plan(self, seen: Observation, out: Path) -> RunRecord:
        """Plan for what is ``seen``; image, plan and context lie in the run folder ``out`` then."""
        with self.screen.stage("plan"):
            plan = replace(self.policy.plan(seen), cell=self.config.digest)
        make_folder(out)
        seen.save(out / SEEN_FILE)
        plan.save(out / PLAN_FILE)
        save_context(out, [one.observation.rgb for one in self.demonstrations], self.policy.context_.pixels)
        for note in plan.notes:
            self.screen.say(f"    {note}")
        task = self.demonstrations[0].task or self.config.name
        return RunRecord(task, task, None, self.llm, self.policy.name, None, PLANNED, tuple(self.screen.stages))


class _Run:
    """One run in the folder ``out``: image, plan, preview, confirmation, execution, page."""

    def __init__(
        self,
        config: CellConfig,
        emulation: Emulation | None,
        planner: _Planner | None,
        out: Path,
        options: argparse.Namespace,
        screen: StageConsole,
    ):
        self._config, self._emulation, self._planner = config, emulation, planner
        self._out, self._options, self._screen = out, options, screen
        self._done = RUNS / "cells" / f"{config.digest}.ok"  # there once a run with this calibration ended well
        self._speed = options.speed or (1.0 if self._done.exists() else config.first_run_speed)

    def run(self) -> None:
        station = Station(self._config)
        if self._options.dry_run:
            self._prepare(station)
            return
        with station:
            self._park(station)
            motion, record = self._prepare(station)
            self._open_grippers(station)
            seconds = len(motion.joints) / station.rate_hz
            self._confirm(f"execute {seconds:.0f} s of motion at {100 * self._speed:.0f}% of the usual speed?")
            with stop_on_signals() as stop:  # also while the outcome is stored
                with self._screen.stage("execution"):
                    played = station.play(motion, stop)
                played.path.save(self._out / MEASURED_FILE)
                grasps = played.path.empty_grasps([arm.name for arm in station.arms])
                success, outcome = self._outcome(played)
                self._report(record, success, [outcome, *grasps])
            if stop.reason and not played.stopped:
                raise stop.error()
            if outcome == UNJUDGED and not self._options.yes:
                success = _agrees("did it succeed?")
                self._report(record, success, ["success" if success else "failed: judged so", *grasps])
            played.require_end()
        if success:  # None: not judged
            write_whole(self._done, b"")

    def _park(self, station: Station) -> None:
        if is_parked(station):
            return
        self._confirm("the arms are not at their park pose; move them there slowly?")
        with self._screen.stage("park"), stop_on_signals() as stop:
            played = park(station, stop, min(self._speed, self._config.first_run_speed))
        played.require_end()

    def _open_grippers(self, station: Station) -> None:
        """A plan begins with open grippers; the person takes what is still held."""
        if has_open_grippers(station):
            return
        self._confirm("a gripper is closed: hold what it has; open it?")
        with self._screen.stage("open grippers"), stop_on_signals() as stop:
            open_grippers(station, stop)
        if stop.reason:
            raise stop.error()

    def _prepare(self, station: Station) -> tuple[Motion, RunRecord]:
        """A checked motion, and what is known of the run; the page shows both."""
        if self._planner is None:
            record = RunRecord.load(self._out)
        else:
            record = self._planner.plan(self._observation(), self._out)
        record = replace(record, success=None, outcome=PLANNED)
        record.save(self._out)
        for name in (SWEEP_FILE, MEASURED_FILE):  # of an earlier run
            (self._out / name).unlink(missing_ok=True)
        plan = Plan.load(self._out / PLAN_FILE)
        page = write_report(self._out)
        self._screen.say(f"the plan, with a confidence of {plan.confidence or 0.0:.2f}: {page}")
        require_trust(self._config, plan.confidence, plan.cell)
        with self._screen.stage("check of the motion"):
            motion = plan_guarded(
                plan.trajectory,
                station.arms,
                self._config.limits,
                self._config.execute_hz,
                self._config.rate_hz,
                self._speed,
            )
            Sweep.of(motion, station.arms, self._config.rate_hz).save(self._out / SWEEP_FILE)
            write_report(self._out)
        self._screen.say(f"what the arms will sweep is on the page now: {page}")
        return motion, record

    def _observation(self) -> Observation:
        if self._config.camera is None:
            raise UsageError(f"{self._config.path} has no table [camera]")
        camera = make_camera(self._config.camera, self._config.path.parent)
        with self._screen.stage(f"image of camera {camera.name}"), connected(camera):
            return observe(self._config, camera)

    def _outcome(self, played: Played) -> tuple[bool | None, str]:
        """Whether the task is done, None where only a person can say, and the outcome in words."""
        if played.stopped:
            return False, f"stopped: {played.stopped}"
        if self._emulation is None:
            return None, UNJUDGED
        failure = self._emulation.failure()
        return not failure, f"failed: {failure}" if failure else "success"

    def _report(self, record: RunRecord, success: bool | None, outcome: Sequence[str]) -> None:
        """Write the page; the ``outcome`` in words is printed, too."""
        words = "; ".join(outcome)
        replace(record, success=success, outcome=words, stages=tuple(self._screen.stages)).save(self._out)
        self._screen.say(words)
        self._screen.say(f"report: {write_report(self._out)}")

    def _confirm(self, question: str) -> None:
        """Raises `StoppedError` unless the person, or the option ``--yes``, agrees."""
        if not self._options.yes and not _agrees(question):
            raise StoppedError("nothing was executed")


def _agrees(question: str) -> bool:
    if not sys.stdin.isatty():
        raise UsageError("there is no terminal to ask on; use --yes to execute without asking")
    try:
        return input(f"{question} [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        raise StoppedError("the terminal was closed; the arms hold") from None


def _goes_on() -> bool:
    try:
        return _agrees("arrange the next scene; go on?")
    except StoppedError:  # the terminal was closed
        return False
