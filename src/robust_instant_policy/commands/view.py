"""`rip view`: write a page that shows every demonstration of a folder, and log them for Rerun."""

import argparse
from pathlib import Path

from robust_instant_policy.commands.options import add_demos, add_rerun, beside
from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.reporting.demonstrations import write_page


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_demos(parser)
    parser.add_argument("--out", type=Path, metavar="FILE", help="the page (default: DIR.html)")
    add_rerun(parser)


def run(options: argparse.Namespace) -> int:
    if options.rerun is not None:
        from robust_instant_policy.reporting.rerun_log import log_demonstrations, open_recording  # needs an extra

        demonstrations = load_demonstrations(options.demos)
        with open_recording(options.rerun, demonstrations[0].task or "demonstrations") as recording:
            log_demonstrations(recording, demonstrations)
        print(options.rerun)
    print(write_page(options.demos, options.out or beside(options.demos, ".html")))
    return 0
