"""`rip studio`: demonstrate a task by hand in the browser, see why a plan is trusted, and let the arm execute it."""

from __future__ import annotations

import argparse
from pathlib import Path

from robust_instant_policy.commands.options import DATA
from robust_instant_policy.datasets.folder import read_recording
from robust_instant_policy.errors import MissingExtraError
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
    parser.add_argument(
        "--llm",
        default="embedded",
        help="language model: embedded, gguf:PATH, openai:MODEL or http://…#MODEL (default: %(default)s)",
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s)")
    parser.add_argument("--port", type=int, default=DEFAULT_PORT, help="0 for any (default: %(default)s)")


def run(options: argparse.Namespace) -> int:
    try:
        from robust_instant_policy.studio.server import Choice, serve
    except ModuleNotFoundError as error:
        if error.name and error.name.startswith("robust_instant_policy"):
            raise
        raise MissingExtraError(error.name or "viser", "studio") from error
    task = options.task or (read_recording(options.demos)["task"] if options.demos else DEFAULT_TASK)
    if options.demos is None:
        require_task(task)
    choice = Choice(task, options.demos, DATA / "studio", options.llm, options.observation)
    serve(choice, options.host, options.port)
    return 0
