"""`rip merge`: combine several evaluations in one folder."""

import argparse
from pathlib import Path

from robust_instant_policy.evaluation.merging import merge
from robust_instant_policy.reporting.publication import PAGE_FILE, publish


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folders written by rip eval")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new folder, or one to add to")


def run(options: argparse.Namespace) -> int:
    for share in merge(options.runs, options.out):
        print(f"{share.folder}: {share.new} new executions, {share.known} already present")
    publish(options.out)
    print(options.out / PAGE_FILE)
    return 0
