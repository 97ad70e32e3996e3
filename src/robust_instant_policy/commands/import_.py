"""`rip import`: write the demonstrations of another recording into a demonstrations folder."""

import argparse
from pathlib import Path

from robust_instant_policy.commands.options import DATA
from robust_instant_policy.datasets.importers import convert_demonstrations
from robust_instant_policy.datasets.importers.rig_file import read_rig
from robust_instant_policy.files import file_stem


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording", type=Path, metavar="PATH", help="a ManiSkill or robomimic HDF5 file, or a LeRobot v3 folder"
    )
    parser.add_argument("--rig", type=Path, required=True, metavar="FILE", help="gripper, camera …, JSON")
    parser.add_argument("--task", type=task_name, required=True, metavar="NAME", help="short name of the task")
    parser.add_argument("--description", default="", metavar="TEXT", help="the task in words (default: its name)")
    parser.add_argument("--out", type=Path, metavar="DIR", help=f"folder to write or add to (default: {DATA}/NAME)")


def task_name(text: str) -> str:
    """A name that can be that of a folder, too."""
    if not text.strip(". "):
        raise argparse.ArgumentTypeError(f"must be a name, not {text!r}")
    return text


def run(options: argparse.Namespace) -> int:
    out = options.out or DATA / file_stem(options.task)
    rig = read_rig(options.rig)
    count = convert_demonstrations(options.recording, out, options.task, options.description, rig)
    print(f"{out}: {count} demonstrations of {options.task}; next: rip check --demos {out}")
    return 0
