"""`rip demo`: record demonstrations, plan in a new scene, execute, and write a run folder with a report."""

import argparse
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from robust_instant_policy.commands.console import StageConsole
from robust_instant_policy.commands.options import DATA, RUNS, add_method, method_settings, require_keypoints, seed
from robust_instant_policy.commands.planning import fitted_policy
from robust_instant_policy.datasets import VideoWriter, load_demonstrations
from robust_instant_policy.datasets.folder import holds_demonstrations, open_folder
from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.errors import UnreachableError, UsageError
from robust_instant_policy.evaluation import Variant, holds_results, obtain_demonstrations, scene_seed
from robust_instant_policy.files import file_stem, require_writable
from robust_instant_policy.llm import check_server, model_name
from robust_instant_policy.policies import Plan
from robust_instant_policy.reporting.run import PLAN_FILE, SEEN_FILE, VIDEO_FILE, RunRecord, save_context, write_report
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.task import Task


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--task", default="push-cube", help="name of the task")
    parser.add_argument("--seed", type=seed, default=0, help="seed of the new scene")
    parser.add_argument("--demos", default="10", metavar="N|DIR", help="number of demonstrations, or a folder of them")
    parser.add_argument("--out", type=Path, help="run folder (default: runs/TASK-SEED)")
    add_method(parser)


def run(options: argparse.Namespace) -> int:
    """Record missing demonstrations, plan and execute; writes the run folder."""
    if options.demos.removeprefix("-").isdecimal() and int(options.demos) < 1:
        raise UsageError(f"--demos {options.demos}: the task must be shown at least once")
    if not options.demos.isdecimal():
        open_folder(Path(options.demos), options.task)  # raises before the simulator starts
    settings = method_settings(options)  # raises for unknown descriptors
    out = options.out or RUNS / f"{file_stem(options.task)}-{options.seed}"
    if holds_results(out):
        raise UsageError(f"{out} holds an evaluation; choose another folder with --out")
    if holds_demonstrations(out):
        raise UsageError(f"{out} holds demonstrations; choose another folder with --out")
    require_writable(out / PLAN_FILE)
    screen, scene = StageConsole(), scene_seed(options.seed, 0)
    screen.say(f"{options.task}: demonstrations, then a plan and its execution in a new scene (seed {scene})")
    check_server(options.llm)
    require_keypoints(settings)
    with ExitStack() as stack:
        with screen.stage("simulator"):
            task: Task = stack.enter_context(closing(make_task(options.task)))
        shown = _demonstrations(task, options.demos, screen)
        with fitted_policy(options, shown, screen, task.workspace) as policy:
            for note in policy.context_.notes:
                screen.say(f"    {note}")
            with screen.stage("a new scene"):
                observation = task.reset(scene)
            with screen.stage("plan"):
                plan = policy.plan(observation)
        _tell(plan, screen)
        plan.save(out / PLAN_FILE)
        observation.save(out / SEEN_FILE)
        save_context(out, [one.observation.rgb for one in shown], policy.context_.pixels)
        with screen.stage("execution"), VideoWriter(out / VIDEO_FILE, fps=task.video_hz) as video:
            try:
                execution = task.execute(plan.trajectory, on_frame=video.add)
                success, failure = execution.success, execution.failure
            except UnreachableError as error:
                success, failure = False, f"the arm refused the trajectory: {error}"
    outcome = f"success: {task.goal}" if success else f"failed: {failure}"
    planning = [replace(stage, name=f"plan: {stage.name}") for stage in plan.usage.stages]
    RunRecord(
        task=task.name,
        description=task.description,
        seed=scene,
        llm=model_name(options.llm),
        method=policy.name,
        config=Variant.of(policy.settings, policy.name).config,
        success=success,
        outcome=outcome,
        stages=tuple(part for stage in screen.stages for part in (planning if stage.name == "plan" else [stage])),
    ).save(out)
    with screen.stage("report"):
        report = write_report(out)
    screen.say("")
    screen.say(f"{task.name}, {outcome}")
    screen.say(f"report: {report}")
    return 0


def _tell(plan: Plan, screen: StageConsole) -> None:
    for stage in plan.usage.stages:
        tokens = (
            f", {stage.prompt_tokens:,} tokens read, {stage.completion_tokens:,} written" if stage.prompt_tokens else ""
        )
        screen.say(f"    {stage.name:<32}{stage.seconds:7.3f} s{tokens}")
    ignored = [f"{index + 1} from step {plan.onset[index]}" for index in np.flatnonzero(plan.hallucinated)]
    screen.say(
        f"    {len(plan.candidates)} candidates, hallucinated: {', '.join(ignored) or 'none'}; "
        f"confidence {plan.confidence:.2f}"
    )


def _demonstrations(task: Task, wanted: str, screen: StageConsole) -> list[Demonstration]:
    if not wanted.isdecimal():
        with screen.stage(f"demonstrations from {wanted}"):
            return load_demonstrations(wanted, task=task.name)
    thrown_away = 0

    def progress(there: int, count: int, thrown: int) -> None:
        nonlocal thrown_away
        thrown_away = thrown
        screen.done_so_far("recording demonstrations", there, count)

    folder = DATA / file_stem(task.name)
    with screen.stage(f"{wanted} demonstrations"):
        shown = obtain_demonstrations(task, folder, int(wanted), progress)
    screen.say(f"    in {folder}; {thrown_away} failed attempts discarded")
    return shown
