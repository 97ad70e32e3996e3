"""One case of each injected fault that the tests of the drivers do not have, by the benchmark that makes the table."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

BENCHMARK = Path(__file__).parents[1] / "benchmarks" / "robot_faults.py"
ENDING_AS_PLANNED = {"clock jump"}
KINDS = (
    "clock jump", "process killed", "terminal closed", "full disk", "camera frozen", "depth of zeros", "plan: jump",
    "plan: turn", "plan: into the table", "plan: another calibration", "plan: doubt",
)  # fmt: skip


def test_no_fault_moves_an_arm_beyond_its_limits_or_lets_it_go_on_or_loses_its_path(tmp_path):
    rows, out = tmp_path / "rows.jsonl", tmp_path / "table.md"
    command = [sys.executable, str(BENCHMARK), "--quick", "--rows", str(rows), "--out", str(out), "--kinds", *KINDS]
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=500)
    assert result.returncode == 0, result.stderr
    cases = {row["fault"]: row for row in map(json.loads, rows.read_text().splitlines())}
    assert set(cases) == set(KINDS)
    for name, case in cases.items():
        assert not case["outside"], (name, case["outside"])
        assert case["after"] == 0, name
        assert not case["limp"], name
        assert case["kept"], name
        assert bool(case["said"]) == (name not in ENDING_AS_PLANNED), (name, case["said"])
        assert (case["executed"] == 0) == name.startswith(("plan", "camera", "depth")), name
    assert f"| **all** |  | {len(KINDS)} |" in out.read_text()
