"""`rip run` on the emulated UR5e: image, plan, confirmation, execution through the real drivers, page."""

from __future__ import annotations

import shutil
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from robust_instant_policy import Plan
from robust_instant_policy.cli import main
from robust_instant_policy.reporting.run import RunRecord
from robust_instant_policy.robots.cell import CELLS, CellConfig
from robust_instant_policy.robots.emulation.client import emulated
from robust_instant_policy.robots.path import MeasuredPath, Sweep
from tests.robots_cells import arms_of

pytest.importorskip("rtde_control", reason="ur_rtde has no release for Python 3.13")


@pytest.fixture(scope="module")
def cell(workbench):
    """The emulated UR5e, four times as fast as time."""
    for name in ("emulated-ur5e.toml", "emulated-ur5e-camera.toml"):
        shutil.copy(CELLS / name, workbench)
    path = workbench / "emulated-ur5e.toml"
    path.write_text(path.read_text().replace("seed = 0", "seed = 100001\npace = 4"))
    return path


@pytest.fixture
def emulation(cell, monkeypatch):
    """The cell runs once, for all commands of a test."""
    with emulated(CellConfig.load(cell)) as emulation:
        monkeypatch.setattr(
            "robust_instant_policy.commands.run.devices_of", lambda config: nullcontext((emulation.config, emulation))
        )
        yield emulation


def run(cell, *more: str) -> int:
    return main(["run", "--robot", str(cell), "--demos", "data/push-cube", *more])


def test_a_plan_is_made_refused_where_it_does_not_belong_and_executed_where_it_does(
    cell, emulation, workbench, monkeypatch, capsys
):
    monkeypatch.chdir(workbench)
    assert run(cell, "--dry-run", "--out", "runs/cell") == 0
    folder = workbench / "runs/cell"
    assert RunRecord.load(folder).outcome == "planned, not executed"
    assert not (folder / "measured.npz").exists()
    assert "the whole motion, from the park pose" in (folder / "report.html").read_text()
    sweep = Sweep.load(folder / "sweep.npz")
    (arm,), _ = arms_of(cell)
    np.testing.assert_allclose(sweep.tools[0, 0], arm.home_pose[:3, 3], atol=1e-3)
    path = Plan.load(folder / "plan.json").trajectory.triplets[:, 0, 1:].mean(axis=1)
    away = np.linalg.norm(path[:, None] - sweep.tools[:, 0], axis=-1).min(axis=1)
    assert away.max() < 0.01  # what is shown passes each waypoint of the plan

    assert run(cell, "--plan", str(folder)) == 2  # nobody is there to be asked
    assert "use --yes" in capsys.readouterr().err
    plan = Plan.load(folder / "plan.json")
    for changed, words in (
        (replace(plan, cell="0123456789abcdef"), "made for another calibration, gripper or cell"),
        (replace(plan, confidence=0.3), "confidence is 0.30, the limit is 0.90 (min_confidence in"),
    ):
        (folder / "measured.npz").touch()  # of an earlier run
        changed.save(folder / "plan.json")
        assert run(cell, "--yes", "--plan", str(folder)) == 1
        assert words in capsys.readouterr().err
        assert not (folder / "measured.npz").exists()
        assert RunRecord.load(folder).outcome == "planned, not executed"
    assert not emulation.commands().size

    plan.save(folder / "plan.json")
    assert run(cell, "--yes", "--speed", "1", "--plan", str(folder)) == 0
    record = RunRecord.load(folder)
    assert record.success, record.outcome
    path = MeasuredPath.load(folder / "measured.npz")
    assert path.tool_errors[-1].max() < 5e-3
    page = (folder / "report.html").read_text()
    assert "Execution: commanded and measured" in page
    assert record.outcome in page


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--plan", "nowhere"], "nowhere holds no plan; make one with: rip run --dry-run --out nowhere"),
        ([], "--demos DIR is missing"),
        (["--demos", "data", "--out", "file"], "file is a file; a run needs a folder"),
    ],
)
def test_wrong_usage_is_one_line_and_leaves_nothing(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    assert main(["run", "--robot", "emulated-ur5e", *arguments]) == 2
    assert words in capsys.readouterr().err
    assert [file.name for file in tmp_path.iterdir()] == ["file"]
