"""Records which lines of the package each Python process runs.

Python imports this file when it starts: `make test` puts its folder on PYTHONPATH, so that processes which tests start
are measured, too. Each process leaves a file in the folder that COVERAGE_FOLDER names; `coverage_table.py` adds them.
"""

from __future__ import annotations

import atexit
import json
import os
import uuid
from contextlib import suppress
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "src"
NEVER = 2**31 - 1  # Python 3.11: taking probes out again would interrupt loops of real time for up to 0.3 s


def _measure(folder: Path) -> None:
    from slipcover import FileMatcher, ImportManager, Slipcover

    measured = Slipcover(d_miss_threshold=NEVER, exclude_lines=[])
    ImportManager(measured, FileMatcher(sources=[PACKAGE])).__enter__()

    def store() -> None:
        lines = {name: file["executed_lines"] for name, file in measured.get_coverage()["files"].items()}
        (folder / f"{uuid.uuid4().hex}.json").write_text(json.dumps(lines))

    atexit.register(store)


if "COVERAGE_FOLDER" in os.environ:
    with suppress(ModuleNotFoundError):  # a Python of another environment
        _measure(Path(os.environ["COVERAGE_FOLDER"]))
