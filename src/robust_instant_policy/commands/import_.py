"""`rip import`: write the demonstrations of another recording into a demonstrations folder."""

from __future__ import annotations

import argparse
from pathlib import Path

from robust_instant_policy.commands.options import DATA
from robust_instant_policy.datasets.importers import convert_demonstrations
from robust_instant_policy.datasets.importers.rig_file import read_rig


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recording", type=Path, metavar="PATH", help="a ManiSkill or robomimic HDF5 file, or a LeRobot v3 folder"
    )
    parser.add_argument("--rig", type=Path, required=True, metavar="FILE", help="gripper, camera …, JSON")
    parser.add_argument("--task", required=True, metavar="NAME", help="short name of the task")
    parser.add_argument("--description", default="", metavar="TEXT", help="the task in words (default: its name)")
    parser.add_argument("--out", type=Path, metavar="DIR", help=f"folder to write or add to (default: {DATA}/NAME)")


def run(options: argparse.Namespace) -> int:
    out = options.out or DATA / options.task
    rig = read_rig(options.rig)
    count = convert_demonstrations(options.recording, out, options.task, options.description, rig)
    print(f"{out}: {count} demonstrations of {options.task}; next: rip check --demos {out}")
    return 0
