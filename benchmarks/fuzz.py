"""Fuzz all readers of external data: python benchmarks/fuzz.py [--cases N] [--targets NAME …] [--seed N].

The targets are those of ``tests/fuzz_targets.py``, which the tests run with fewer cases. A failing case is
minimised and stored in ``tests/fuzz_corpus/``, where the tests run it again. Writes ``docs/tables/fuzz.md`` when
all targets were run.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import sys
import traceback
from dataclasses import dataclass
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.fuzz_targets import CORPUS, TARGETS, Case, Target, fuzz, run  # noqa: E402

if importlib.util.find_spec("tests.fuzz_targets_llm"):
    from tests.fuzz_targets_llm import SERVER_REPLIES, check_server_reply

    def replied(case: object) -> bool:
        check_server_reply(case)
        return True

    TARGETS["replies"] = Target("replies", SERVER_REPLIES.map(Case), replied)

TABLE = ROOT / "docs" / "tables" / "fuzz.md"
MAX_KEPT_BYTES = 64 * 1024  # of a failed case


@dataclass
class Tally:
    cases: int = 0
    accepted: int = 0
    slowest_s: float = 0.0
    failed: Case | None = None  # the last one, which is the smallest when hypothesis is done


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000, help="for each target")
    parser.add_argument("--targets", nargs="+", choices=sorted(TARGETS), default=list(TARGETS))
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    columns = (TextColumn("{task.description:>14}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    tallies = {}
    with Progress(*columns) as progress:
        for name in options.targets:
            tallies[name] = count(TARGETS[name], options.cases, options.seed, progress)
    text = table(tallies, options.seed)
    print(text)
    if set(tallies) == set(TARGETS):
        TABLE.write_text(text)
    return 1 if any(tally.failed for tally in tallies.values()) else 0


def count(target: Target, cases: int, seed: int, progress: Progress) -> Tally:
    """Run a target; a failure is printed with its seed, and kept."""
    tally = Tally()
    bar = progress.add_task(target.name, total=cases)

    def check(case: Case) -> None:
        try:
            outcome = run(target, case)
        except BaseException:
            tally.failed = case
            raise
        tally.cases += 1
        tally.accepted += outcome.accepted
        tally.slowest_s = max(tally.slowest_s, outcome.seconds)
        progress.update(bar, completed=min(tally.cases, cases))

    try:
        fuzz(target, cases, seed, check)
    except Exception:  # of any kind: that is what is looked for
        case = tally.failed
        if case is None:
            raise
        print(f"{target.name} fails with --seed {seed}: {case!r}", file=sys.stderr)
        traceback.print_exc(limit=-4)
        if len(case) <= MAX_KEPT_BYTES:
            path = CORPUS / target.name / hashlib.sha256(case).hexdigest()[:12]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(case)
            print(f"kept as {path.relative_to(ROOT)}", file=sys.stderr)
    return tally


def table(tallies: dict[str, Tally], seed: int) -> str:
    lines = [
        f"Written by `python benchmarks/fuzz.py --seed {seed}`. A case is refused with an error in one line, or "
        "accepted with a value that keeps its promises; the slowest is in seconds of processor time.",
        "",
        "| target | cases | refused | accepted | slowest, s | failed |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name, tally in tallies.items():
        lines.append(
            f"| {name} | {tally.cases} | {tally.cases - tally.accepted} | {tally.accepted} | {tally.slowest_s:.2f} "
            f"| {'yes' if tally.failed else 'no'} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
