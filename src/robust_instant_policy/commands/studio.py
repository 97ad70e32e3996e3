"""`rip studio`: demonstrate a task by hand in the browser, see why a plan is trusted, and let the arm execute it."""

import argparse
import signal
from pathlib import Path

from robust_instant_policy.commands.options import DATA, add_llm
from robust_instant_policy.datasets.folder import read_recording
from robust_instant_policy.datasets.layout import RIP_PATH
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import UsageError, needs_extra
from robust_instant_policy.interrupts import blocked
from robust_instant_policy.llm import model_name
from robust_instant_policy.tasks import require_task

DEFAULT_PORT, DEFAULT_TASK = 8080, "push-cube"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--task", help="name of the task to begin with (default: that of --demos, or push-cube)")
    parser.add_argument(
        "--demos", type=Path, metavar="DIR", help="folder of the demonstrations (default: data/studio/TASK)"
    )
    parser.add_argument(
        "--observation", type=Path, metavar="FILE", help="a new scene (.npz) to plan for, instead of a simulator"
    )
    add_llm(parser)
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on")
    parser.add_argument("--port", type=int, default=DEFAULT_PORT, help="0 for any")


def run(options: argparse.Namespace) -> int:
    task = options.task or (_recorded_task(options.demos) if options.demos else DEFAULT_TASK)
    if options.demos is None:
        require_task(task)
    observation = Observation.load(options.observation) if options.observation else None
    model_name(options.llm)  # a spec that names no model is refused here, not at the first plan
    with blocked(signal.SIGINT), needs_extra("studio"):  # some libraries catch Ctrl-C while they are imported
        from robust_instant_policy.studio.server import Choice, serve
    serve(Choice(task, options.demos, DATA / "studio", options.llm, observation), options.host, options.port)
    return 0


def _recorded_task(folder: Path) -> str:
    """The task of the demonstrations in ``folder``."""
    if not (folder / RIP_PATH).is_file():
        raise UsageError(f"{folder} is no folder of demonstrations; add --task NAME to record into it")
    return read_recording(folder)["task"]
