"""`rip report`: write the report of a run, or of an evaluation, again from its files."""

import argparse
from pathlib import Path

from robust_instant_policy.commands.options import add_rerun
from robust_instant_policy.errors import UsageError
from robust_instant_policy.evaluation import export_results, holds_results
from robust_instant_policy.reporting.publication import PAGE_FILE, publish
from robust_instant_policy.reporting.run import RunRecord, write_report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder written by rip demo, rip run or rip eval")
    add_rerun(parser)


def run(options: argparse.Namespace) -> int:
    if holds_results(options.folder):
        if options.rerun is not None:
            raise UsageError(f"{options.folder} is an evaluation; --rerun logs one run of rip demo or rip run")
        export_results(options.folder)
        publish(options.folder)
        print(options.folder / PAGE_FILE)
        return 0
    if options.rerun is not None:
        from robust_instant_policy.reporting.rerun_log import log_run, open_recording  # needs an extra

        record = RunRecord.load(options.folder)
        with open_recording(options.rerun, f"{record.task}: {record.outcome}") as recording:
            log_run(recording, options.folder)
        print(options.rerun)
    print(write_report(options.folder))
    return 0
