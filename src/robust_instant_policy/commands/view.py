"""`rip view`: write a page that shows every demonstration of a folder."""

from __future__ import annotations

import argparse
from pathlib import Path

from robust_instant_policy.commands.options import beside
from robust_instant_policy.reporting.demonstrations import write_page


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--demos", type=Path, required=True, metavar="DIR", help="folder of demonstrations")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the page (default: DIR.html)")


def run(options: argparse.Namespace) -> int:
    print(write_page(options.demos, options.out or beside(options.demos, ".html")))
    return 0
