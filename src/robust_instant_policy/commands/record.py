"""`rip record`: record demonstrations into a dataset folder, of a simulated task or on the arms of a real cell."""

import argparse
from contextlib import closing
from pathlib import Path

from robust_instant_policy.commands.console import StageConsole
from robust_instant_policy.commands.options import add_assets, add_level, positive, seed
from robust_instant_policy.datasets import DatasetWriter, load_demonstrations
from robust_instant_policy.sanity import check_demonstrations, errors
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.record import record


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--task", required=True, help="name of the task; with --robot, any name")
    parser.add_argument("--robot", type=Path, metavar="FILE", help="file of a cell, to record with its leaders")
    parser.add_argument("--description", default="", help="with --robot: the task in words")
    parser.add_argument("--episodes", type=positive, default=10, help="demonstrations")
    parser.add_argument("--seed", type=seed, default=0, help="seed of the first scene of a new folder")
    parser.add_argument("--images", action="store_true", help="record an image for each step")
    parser.add_argument(
        "--every", type=positive, default=1, metavar="N", help="keep every N-th step: 5 reduces 55 Hz to 11 Hz"
    )
    add_assets(parser)
    add_level(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder, or one to continue")


def run(options: argparse.Namespace) -> int:
    if options.robot is not None:
        from robust_instant_policy.commands.record_cell import record_cell  # needs the packages of real arms

        return record_cell(options)
    screen = StageConsole()
    with closing(make_task(options.task, assets=options.assets, level=options.level)) as task:
        rate_hz, robot = task.record_hz / options.every, getattr(task, "robot_type", None)
        with (
            screen.stage(f"{options.episodes} demonstrations"),
            DatasetWriter(options.out, task.name, task.description, rate_hz, robot) as writer,
        ):
            thrown_away = record(
                task,
                writer,
                options.episodes,
                seed=options.seed,
                with_images=options.images,
                every=options.every,
                on_progress=lambda there, count, _: screen.done_so_far("recording", there, count),
            )
    screen.say(
        f"{options.out}: {options.episodes} demonstrations of {task.name}, {thrown_away} failed attempts discarded"
    )
    findings = check_demonstrations(load_demonstrations(options.out)).findings
    for finding in findings:
        screen.say(f"    {finding}")
    return 1 if errors(findings) else 0
