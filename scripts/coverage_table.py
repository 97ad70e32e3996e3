"""Print which share of the lines of each room of the package the last tests ran, from coverage's data file."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import coverage

PACKAGE = Path(__file__).parents[1] / "src" / "robust_instant_policy"


def main() -> None:
    measured = coverage.Coverage()
    measured.load()
    lines: Counter[str] = Counter()
    missed: Counter[str] = Counter()
    for path in sorted(PACKAGE.rglob("*.py")):
        _, statements, _, missing, _ = measured.analysis2(str(path))
        inside = path.relative_to(PACKAGE)
        room = f"{inside.parts[0]}/" if len(inside.parts) > 1 else "(top)"
        lines[room] += len(statements)
        missed[room] += len(missing)
    print(f"{'room':<14} {'lines':>6} {'missed':>6} {'run':>6}")
    for room in sorted(lines):
        print(_row(room, lines[room], missed[room]))
    print(_row("total", lines.total(), missed.total()))


def _row(name: str, lines: int, missed: int) -> str:
    return f"{name:<14} {lines:>6} {missed:>6} {1 - missed / max(lines, 1):>6.1%}"


if __name__ == "__main__":
    main()
