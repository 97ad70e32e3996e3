"""`rip report`: write the report of a run, or of an evaluation, again from its files."""

from __future__ import annotations

import argparse
from pathlib import Path

from robust_instant_policy.evaluation import export_results, holds_results
from robust_instant_policy.reporting.publication import PAGE_FILE, publish
from robust_instant_policy.reporting.run import write_report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder written by rip demo or rip eval")


def run(options: argparse.Namespace) -> int:
    if holds_results(options.folder):
        export_results(options.folder)
        publish(options.folder)
        print(options.folder / PAGE_FILE)
        return 0

    print(write_report(options.folder))
    return 0
