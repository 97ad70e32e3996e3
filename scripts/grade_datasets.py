"""Grades a folder of demonstrations with four public graders of LeRobot datasets.

    python scripts/grade_datasets.py --graders DIR [--demos FOLDER]

Each grader is installed in an environment of its own in DIR (lerobot-lint brings LeRobot, 8 GB). Without --demos five
demonstrations of aloha-pick-banana are recorded. The table goes to docs/tables/graders.md; the exit code is 1 if a
grader finds an error.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

TABLE = Path(__file__).parent.parent / "docs" / "tables" / "graders.md"
GRADERS = {  # what is installed, the command, what its verdict looks like, and the exit code of an error
    "lerobot-doctor": ("lerobot-doctor==0.2.0", "lerobot-doctor check", r"Summary: (.*)", 1),
    "lerobot-lint": ("lerobot-lint==0.1.1", "lelint check --fail-on error", r"Summary: (.*)", 2),  # 1: warnings
    "kalanos": ("kalanos==0.8.2", "kalanos grade", r"Readiness\s+(\S+)", 1),
    "deepen-grade": ("deepen-grade[lerobot]==0.4.1", "deepen grade --min-grade A", r"Overall grade: (\w \(\S+\))", 1),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--graders", type=Path, required=True)
    parser.add_argument("--demos", type=Path)
    options = parser.parse_args()
    folder = options.demos or Path(tempfile.mkdtemp(prefix="graded-")) / "aloha-pick-banana"
    if options.demos is None:
        command = ["-m", "robust_instant_policy.cli", "record", "--task", "aloha-pick-banana", "--episodes", "5"]
        subprocess.run([sys.executable, *command, "--images", "--out", folder], check=True)
    rows, failed = [], False
    for name, (requirement, call, verdict, error_code) in GRADERS.items():
        env, (program, *arguments) = options.graders / name, call.split()
        if not (env / "bin" / program).exists():
            venv.create(env, with_pip=True)
            subprocess.run([env / "bin/python", "-m", "pip", "install", "--quiet", requirement], check=True)
        variables = {**os.environ, "HF_HUB_OFFLINE": "1", "COLUMNS": "200", "PYTHONPATH": ""}
        done = subprocess.run(
            [env / "bin" / program, *arguments, folder.resolve()],
            capture_output=True, text=True, check=False, env=variables,
        )  # fmt: skip
        bad = done.returncode >= error_code
        print(f"== {name}\n{done.stdout}{done.stderr if bad else ''}")
        found = re.findall(verdict, done.stdout)
        rows.append(
            f"| {requirement} | {found[-1].replace(' |', ',') if found else 'none'} | {'yes' if bad else 'no'} |"
        )
        failed |= bad
    lines = ["| grader | verdict | errors |", "| --- | --- | --- |", *rows, ""]
    TABLE.write_text("\n".join(lines))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
