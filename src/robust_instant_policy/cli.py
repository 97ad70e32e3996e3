"""The command ``rip``. Exit 0: the work was done; 1: something broke; 2: wrong usage."""

import argparse
import errno
import importlib
import io
import sys
from collections.abc import Sequence
from typing import Any

from robust_instant_policy import __version__
from robust_instant_policy.errors import RipError
from robust_instant_policy.interrupts import noted_interrupts

# Each command is a module in `commands`. Only the one that runs is imported, because others may need more packages.
COMMANDS = {
    "demo": "record demonstrations, plan in a new scene, execute, and write a report",
    "new-task": "write the template of a task of your own, or check one",
    "record": "record demonstrations into a dataset folder",
    "check": "check demonstrations, and a new scene, against each other, and name likely mistakes",
    "plan": "plan for one observation and write plan.json; nothing is executed",
    "serve": "plan for robots that ask over openpi's websocket protocol or HTTP",
    "eval": "run the paper's evaluation, or a part of it; continues an interrupted run",
    "import": "write the demonstrations of ManiSkill, robomimic or LeRobot recordings into a folder",
    "demos": "delete, split, merge or restore demonstrations",
    "train": "train dp or kat-dp on demonstrations; continues an interrupted training",
    "report": "write the report of a run, or of an evaluation, again",
    "merge": "combine several evaluations in one folder",
    "view": "write a page that shows every demonstration of a folder",
    "keypoints": "write a page with the keypoints of demonstrations and new scenes, and their errors",
    "samples": "count or export the stored answers of a language model",
    "studio": "open a page in the browser to demonstrate by hand, look at plans, and execute them",
    "robot": "check the devices of a real cell, or emulate one",
    "run": "plan for what the cell's camera sees, and execute the plan on its arms",
    "calibrate": "calibrate the camera, a gripper or a leader arm of a real cell",
    "doctor": "check this machine, and say how to install what is missing",
}
CONTINUED = {"demo", "record", "eval", "train"}  # that go on where an earlier run was stopped


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line and return its exit status; errors become one line on standard error."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    with noted_interrupts():
        return _main(arguments)


def _main(arguments: list[str]) -> int:
    debug = "--debug" in arguments
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # characters that the terminal lacks become ?
            stream.reconfigure(errors="replace")
    try:
        options = parse(arguments)
        options.arguments = arguments
        return options.run(options)
    except KeyboardInterrupt:
        kept = "; finished work is kept; run the same command again to continue"
        print(f"rip: stopped{kept if _command(arguments) in CONTINUED else ''}", file=sys.stderr)
        return 1
    except RipError as error:
        if debug:
            raise
        print(f"rip: {error}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:  # the reader, such as head, has closed the pipe
        sys.stderr.close()
        return 0
    except OSError as error:
        if debug:
            raise
        print(f"rip: {_describe(error)}", file=sys.stderr)
        return 1
    except Exception as error:
        if debug:
            raise
        print(f"rip: unexpected {type(error).__name__}: {error} (--debug shows where)", file=sys.stderr)
        return 1


class CommandParser(argparse.ArgumentParser):
    """Its help tells the default of each option that has one."""

    def add_argument(self, *names: Any, **settings: Any) -> argparse.Action:
        if settings.get("help") and settings.get("default") not in (None, "", argparse.SUPPRESS):
            settings["help"] += " (default: %(default)s)"
        return super().add_argument(*names, **settings)


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """The options of a command line, with the command's function as ``run``; exits with a message for a wrong one."""
    parser = CommandParser(
        prog="rip", description="Robust Instant Policy: show a robot a task a few times; it does it at once."
    )
    parser.add_argument("--version", action="version", version=f"rip {__version__}")
    parser.add_argument("--debug", action="store_true", help="show a traceback when something breaks")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    chosen = _command(arguments)
    for name, summary in COMMANDS.items():
        command = commands.add_parser(name, help=summary, description=summary)
        command.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
        if name == chosen:
            place = "import_" if name == "import" else name.replace("-", "_")  # a keyword cannot name a module
            module = importlib.import_module(f"robust_instant_policy.commands.{place}")
            module.add_arguments(command)
            command.set_defaults(run=module.run)
    return parser.parse_args(arguments)


def _command(arguments: Sequence[str]) -> str | None:
    return next((word for word in arguments if not word.startswith("-")), None)


def _describe(error: OSError) -> str:
    where = f" at {error.filename}" if error.filename else ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"no space left{where}; free some and run the same command again to continue"
    return f"{error.strerror or error}{where}"


if __name__ == "__main__":
    sys.exit(main())
