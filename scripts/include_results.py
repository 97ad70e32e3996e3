"""Copies result tables into README and docs: python scripts/include_results.py [--check]

The text between the lines ``<!-- include: results/… -->`` and ``<!-- end -->`` of a page is replaced by the file. With
``--check`` nothing is written, and a difference is an error.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"(<!-- include: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)


def included(text: str) -> str:
    """``text`` with every block filled from its file."""
    return BLOCK.sub(lambda found: f"{found[1]}\n{(ROOT / found[2]).read_text().strip()}\n\n{found[3]}", text)


def main(check: bool) -> int:
    stale = []
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        text = page.read_text()
        missing = [file for _, file, _ in BLOCK.findall(text) if not (ROOT / file).exists()]
        if missing:
            print(f"{page.name} includes {', '.join(missing)}, which does not exist")
            return 1
        if included(text) != text:
            stale.append(page.name)
            if not check:
                page.write_text(included(text))
    print(f"{'differ from results/' if check else 'updated'}: {', '.join(stale) or 'none'}")
    return int(check and bool(stale))


if __name__ == "__main__":
    sys.exit(main("--check" in sys.argv[1:]))
