"""`rip samples`: count or export the stored answers of a language model."""

import argparse
import sys
from contextlib import closing
from pathlib import Path

from robust_instant_policy.errors import UsageError
from robust_instant_policy.llm import SampleStore


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help="samples.sqlite of an evaluation")
    parser.add_argument("--export", choices=("jsonl", "csv"), help="write all answers to standard output")


def run(options: argparse.Namespace) -> int:
    if not options.file.exists():
        raise UsageError(f"no stored answers at {options.file}; rip eval --out DIR keeps them in DIR/samples.sqlite")
    if options.file.is_file() and options.file.stat().st_size == 0:  # SQLite would make a database of it
        raise UsageError(f"{options.file} is empty; rip eval --out DIR keeps answers in DIR/samples.sqlite")
    with closing(SampleStore(options.file)) as store:
        if options.export:
            store.export(sys.stdout, options.export)
            return 0
        print(f"{'model':<40}{'prompts':>10}{'answers':>10}{'tokens read':>15}{'tokens written':>16}")
        for held in store.models():
            print(
                f"{held.model:<40}{held.queries:>10,}{held.answers:>10,}"
                f"{held.prompt_tokens:>15,}{held.completion_tokens:>16,}"
            )
    return 0
