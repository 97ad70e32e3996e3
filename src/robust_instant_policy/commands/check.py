"""`rip check`: do demonstrations, and a new scene, fit together and belong to one camera and one task?"""

from __future__ import annotations

import argparse
from pathlib import Path

from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.sanity import Finding, check_demonstrations, errors


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--demos", type=Path, required=True, metavar="DIR")
    parser.add_argument("--observation", type=Path, metavar="FILE", help="a new scene, as for rip plan")


def run(options: argparse.Namespace) -> int:
    """Print every finding; 1 where one of them is an error."""
    observation = None if options.observation is None else Observation.load(options.observation)
    demonstrations = load_demonstrations(options.demos)
    report = check_demonstrations(demonstrations)
    print(f"{len(demonstrations)} demonstrations of {demonstrations[0].task or 'a task without name'}: {options.demos}")
    _tell(report.findings, "demonstrations")
    wrong = bool(errors(report.findings))
    if observation is not None:
        found = report.check_observation(observation)
        _tell(found, f"observation {options.observation}")
        wrong |= bool(errors(found))
    return 1 if wrong else 0


def _tell(findings: tuple[Finding, ...], what: str) -> None:
    if not findings:
        print(f"  {what}: nothing wrong was found")
    for finding in findings:
        print(f"  {finding}")
