"""`rip plan`: plan for one observation and write the plan; nothing is executed."""

import argparse
from pathlib import Path

from robust_instant_policy.commands.console import StageConsole
from robust_instant_policy.commands.options import add_demos, add_method, add_rerun
from robust_instant_policy.commands.planning import fitted_policy
from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.files import require_writable


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_demos(parser)
    parser.add_argument(
        "--observation", required=True, metavar="FILE", help=".npz with rgb, depth, intrinsics, camera_pose"
    )
    parser.add_argument("--out", type=Path, default=Path("plan.json"), metavar="FILE", help="the plan")
    add_rerun(parser)
    add_method(parser)


def run(options: argparse.Namespace) -> int:
    require_writable(options.out)
    screen = StageConsole()
    observation = Observation.load(options.observation)
    demonstrations = load_demonstrations(options.demos)
    with fitted_policy(options, demonstrations, screen) as policy, screen.stage("plan"):
        plan = policy.plan(observation)
    plan.save(options.out)
    if options.rerun is not None:
        from robust_instant_policy.reporting.rerun_log import log_plan, open_recording  # needs an extra

        with open_recording(options.rerun, "plan") as recording:
            log_plan(recording, observation, plan)
    for note in plan.notes:
        screen.say(f"    {note}")
    screen.say(f"{options.out}: {len(plan.trajectory)} steps, confidence {plan.confidence:.2f}")
    return 0
