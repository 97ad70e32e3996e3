"""The main job, small: real simulator, real image, real language model."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from robust_instant_policy import Plan
from robust_instant_policy.cli import main
from robust_instant_policy.datasets.video import decode_video
from robust_instant_policy.geometry import GripperTriangle
from robust_instant_policy.reporting.run import RunRecord
from tests.conftest import NUM_DEMONSTRATIONS

DEMOS = str(NUM_DEMONSTRATIONS)


@pytest.fixture(scope="module")
def run_folder(workbench, module_monkeypatch):
    module_monkeypatch.chdir(workbench)
    assert main(["demo", "--task", "push-cube", "--demos", DEMOS, "--out", "runs/demo"]) == 0
    return workbench / "runs" / "demo"


@pytest.fixture(scope="module")
def module_monkeypatch():
    with pytest.MonkeyPatch.context() as patch:
        yield patch


def test_the_demo_succeeds_and_leaves_plan_video_and_report(run_folder):
    record = RunRecord.load(run_folder)
    assert record.success, record.outcome
    assert record.outcome.startswith("success")
    assert {"execution", "plan: keypoints", "plan: language model", "plan: regression"} <= {
        stage.name for stage in record.stages
    }
    film = list(decode_video(run_folder / "execution.mp4"))
    assert len(film) > 20
    assert np.abs(film[0].astype(int) - film[-1]).max() > 50  # something moves
    page = (run_folder / "report.html").read_text()
    assert record.outcome in page
    assert "configuration: adaptive" in page


def test_the_robust_gripper_is_as_rigid_as_the_one_that_was_shown(run_folder, workbench):
    from robust_instant_policy import load_demonstrations

    shown = GripperTriangle.from_triplets(load_demonstrations(workbench / "data/push-cube")[0].trajectory.triplets)
    triplets = Plan.load(run_folder / "plan.json").trajectory.triplets[:, 0]
    openings = np.linalg.norm(triplets[:, 1] - triplets[:, 2], axis=-1)
    np.testing.assert_allclose(openings, openings[0], atol=1e-9)
    assert openings[0] == pytest.approx(shown.opening, abs=0.003)


def test_an_evaluation_goes_on_where_it_stopped_and_replays_without_a_model(
    reach, in_this_process, capsys, monkeypatch
):
    monkeypatch.chdir(reach)
    command = ["eval", "--tasks", "metaworld/reach", "--methods", "rip", "rip-gauss", "rip-adaptive", "kat"]
    command += ["--demos", "4"]
    assert main([*command, "--episodes", "1", "--out", "runs/eval"]) == 0
    rows = pq.read_table("runs/eval/episodes.parquet").to_pylist()
    assert [row["method"] for row in rows] == ["rip", "rip-gauss", "rip-adaptive"] + ["kat"] * 5
    assert rows[0]["success"]
    assert "| rip |" in Path("runs/eval/table.md").read_text()

    capsys.readouterr()
    assert main([*command, "--episodes", "1", "--out", "runs/eval"]) == 0
    told = capsys.readouterr().out
    assert ": success" not in told  # nothing was executed again
    assert ": failed" not in told
    assert pq.read_table("runs/eval/episodes.parquet").to_pylist() == rows

    for file in (*Path("runs/eval").glob("results.sqlite*"), *Path("runs/eval").glob("*.parquet")):
        file.unlink()
    monkeypatch.setattr("robust_instant_policy.evaluation.workbench.connect", no_model)
    assert main([*command, "--episodes", "1", "--out", "runs/eval", "--replay"]) == 0
    replayed = pq.read_table("runs/eval/episodes.parquet").to_pylist()
    for row in (*rows, *replayed):
        del row["seconds"], row["physics_seconds"]
    assert replayed == rows


def no_model(spec):
    raise AssertionError(f"{spec} was loaded")
