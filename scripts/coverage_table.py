"""Print which share of the lines of each room of the package the last tests ran.

coverage_table.py FOLDER      the files that `coverage/sitecustomize.py` left there
"""

from __future__ import annotations

import json
import sys
from collections import Counter, defaultdict
from pathlib import Path

from slipcover import Slipcover

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "robust_instant_policy"


def main(folder: Path) -> None:
    run: defaultdict[Path, set[int]] = defaultdict(set)
    for file in folder.glob("*.json"):
        for name, executed in json.loads(file.read_text()).items():
            run[Path(name).resolve()].update(executed)
    lines: Counter[str] = Counter()
    missed: Counter[str] = Counter()
    for path in sorted(PACKAGE.rglob("*.py")):
        statements = set(Slipcover.lines_from_code(compile(path.read_bytes(), str(path), "exec")))
        inside = path.relative_to(PACKAGE)
        room = f"{inside.parts[0]}/" if len(inside.parts) > 1 else "(top)"
        lines[room] += len(statements)
        missed[room] += len(statements - run[path])
    print(f"{'room':<14} {'lines':>6} {'missed':>6} {'run':>6}")
    for room in sorted(lines):
        print(_row(room, lines[room], missed[room]))
    print(_row("total", lines.total(), missed.total()))


def _row(name: str, lines: int, missed: int) -> str:
    return f"{name:<14} {lines:>6} {missed:>6} {1 - missed / max(lines, 1):>6.1%}"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
