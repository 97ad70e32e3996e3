"""`rip check`: check demonstrations, and a new scene, against each other."""

import argparse
from pathlib import Path

from robust_instant_policy.commands.options import add_demos, beside
from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.files import require_writable, write_whole
from robust_instant_policy.reporting.check import check_page
from robust_instant_policy.sanity import Finding, check_demonstrations, errors


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_demos(parser)
    parser.add_argument("--observation", type=Path, metavar="FILE", help="a new scene: .npz, as for rip plan")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the page (default: DIR-check.html)")


def run(options: argparse.Namespace) -> int:
    """Print every finding and write the page; returns 1 if a finding is an error."""
    out = options.out or beside(options.demos, "-check.html")
    if options.out is not None:
        require_writable(out)
    observation = None if options.observation is None else Observation.load(options.observation)
    demonstrations = load_demonstrations(options.demos)
    report = check_demonstrations(demonstrations)
    found = () if observation is None else report.check_observation(observation)
    name = demonstrations[0].task or "a task without name"
    print(f"{len(demonstrations)} demonstrations of {name}: {options.demos}")
    _tell(report.findings, "demonstrations")
    if observation is not None:
        _tell(found, f"observation {options.observation}")
    write_whole(out, check_page(f"Check of {name}", demonstrations, report, observation, found).encode())
    print(f"page: {out}")
    return 1 if errors((*report.findings, *found)) else 0


def _tell(findings: tuple[Finding, ...], what: str) -> None:
    if not findings:
        print(f"  {what}: no problem found")
    for finding in findings:
        print(f"  {finding}")
