"""Tasks by name, without any simulator."""

from __future__ import annotations

import subprocess
import sys

import pytest

from robust_instant_policy.errors import UnknownNameError
from robust_instant_policy.tasks import TASK_NAMES, make_task


def test_importing_tasks_imports_no_simulator():
    heavy = ("mani_skill", "mujoco", "torch")
    code = f"import sys, robust_instant_policy.tasks; print([m for m in {heavy} if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


def test_an_unknown_task_names_the_known_ones():
    with pytest.raises(UnknownNameError, match="push-cube"):
        make_task("juggle")
    assert "push-cube" in TASK_NAMES
