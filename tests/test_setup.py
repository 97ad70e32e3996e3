"""`make lint` and `make setup` where something is missing: what the user reads."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = ("Makefile", "constraints.txt", "pyproject.toml", "scripts/setup.sh")

FAILING_PIP = """#!/bin/sh
case "$*" in
  "-m pip --version" | "-c import torch") exit 0 ;;
esac
echo "The conflict is caused by:"
echo "    one 1.0 depends on two==2.0"
echo "ERROR: ResolutionImpossible" >&2
exit 1
"""


@pytest.fixture
def checkout(tmp_path) -> Path:
    for name in FILES:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    return tmp_path


def make(target: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["make", "-s", target], cwd=folder, capture_output=True, text=True, check=False)


def test_lint_without_an_environment_says_what_to_do_and_installs_nothing(checkout):
    result = make("lint", checkout)
    assert result.returncode != 0
    assert "run: make setup" in result.stderr
    assert not (checkout / ".venv").exists()


def test_the_whole_output_of_a_failing_pip_is_shown(checkout):
    python = checkout / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text(FAILING_PIP)
    python.chmod(0o755)
    result = make("setup", checkout)
    assert result.returncode != 0
    assert "one 1.0 depends on two==2.0" in result.stderr
    assert "ResolutionImpossible" in result.stderr
    assert not (checkout / ".venv" / "setup-stamp").exists()


def test_a_package_that_a_killed_pip_left_half_installed_is_installed_again(checkout):
    python = checkout / ".venv" / "bin" / "python"
    packages = checkout / ".venv" / "lib" / "python3.11" / "site-packages"
    for name in ("half-1.0.dist-info", "whole-1.0.dist-info"):
        (packages / name).mkdir(parents=True)
        (packages / name / "METADATA").touch()
    (packages / "whole-1.0.dist-info" / "INSTALLER").write_text("pip\n")
    python.parent.mkdir()
    python.write_text(FAILING_PIP)
    python.chmod(0o755)
    make("setup", checkout)
    assert [folder.name for folder in packages.iterdir()] == ["whole-1.0.dist-info"]
