"""What `--rerun` writes is read back by Rerun itself."""

import sys

import numpy as np
import pyarrow as pa
import pytest

from robust_instant_policy.cli import main
from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import RipError
from robust_instant_policy.policies import Neighbours
from robust_instant_policy.reporting.run import MEASURED_FILE, PLAN_FILE, SEEN_FILE, RunRecord, save_context
from robust_instant_policy.robots.path import MeasuredPath

pytest.importorskip("rerun")
import rerun as rr
from rerun.chunk import RrdReader

from robust_instant_policy.reporting.rerun_log import open_recording

LIFTED = np.array([0, 0, 0.005])


class Read:
    """The chunks of a file, by entity and component."""

    def __init__(self, path):
        reader = RrdReader(path)
        self.blueprints = reader.blueprints()
        self.columns: dict[tuple[str, str], list] = {}
        self.timelines: dict[str, set[str]] = {}
        for chunk in reader.stream().collect().stream().to_chunks():
            batch = chunk.to_record_batch()
            for field in batch.schema:
                if pa.types.is_list(field.type):  # a component; the others are times and row numbers
                    key = chunk.entity_path, field.name.rsplit(":", 1)[-1]
                    rows = batch.column(field.name).to_pylist()
                    self.columns.setdefault(key, []).extend(row for row in rows if row is not None)
            self.timelines.setdefault(chunk.entity_path, set()).update(chunk.timeline_names)

    def rows(self, entity, component):
        return self.columns[entity, component]


@pytest.fixture(scope="module")
def run_folder(workbench, tmp_path_factory):
    """A run whose plan was executed with an error of 5 mm, without a simulator."""
    folder = tmp_path_factory.mktemp("run")
    demos = load_demonstrations(workbench / "data" / "push-cube")
    scene = Observation.load(workbench / "observation.npz")
    policy = Neighbours().fit(demos)
    plan = policy.plan(scene)
    plan.save(folder / PLAN_FILE)
    scene.save(folder / SEEN_FILE)
    save_context(folder, [demo.observation.rgb for demo in demos], policy.context_.pixels)
    RunRecord("push-cube", "push it", 3, "none", "neighbours", True, "success", ()).save(folder)
    tools = plan.trajectory.triplets[:, :, 1:].mean(axis=2)
    joints = np.zeros((len(tools), 1, 7))
    seconds = np.arange(len(tools)) / 10
    MeasuredPath(10.0, joints, joints, tools, tools + LIFTED, joints[..., 0], seconds).save(folder / MEASURED_FILE)
    return folder, plan, scene


def test_a_run_shows_what_the_plan_saw_chose_and_did(run_folder, tmp_path):
    folder, plan, scene = run_folder
    file = tmp_path / "logs" / "run.rrd"
    assert main(["report", str(folder), "--rerun", str(file)]) == 0
    read = Read(file)
    assert len(read.blueprints) == 1
    (translation,) = read.rows("/world/camera", "translation")
    np.testing.assert_allclose(translation[0], scene.camera_pose[:3, 3], atol=1e-6)
    (camera,) = read.rows("/world/camera", "image_from_camera")
    np.testing.assert_allclose(np.reshape(camera[0], (3, 3)).T, scene.intrinsics, rtol=1e-6)
    assert read.rows("/world/camera/rgb", "buffer")
    assert read.rows("/world/camera/depth", "buffer")
    (points,) = read.rows("/world/points", "positions")
    assert 1000 < len(points) <= 40_000
    assert np.ptp(points, axis=0).max() < 5  # a workspace, in metres
    (keypoints,) = read.rows("/world/keypoints", "positions")
    np.testing.assert_allclose(keypoints, plan.keypoints, atol=1e-6)
    tips = plan.trajectory.triplets[:, 0, 1:].mean(axis=1)
    (path,) = read.rows("/world/plan", "strips")
    np.testing.assert_allclose([piece[0] for piece in path], tips[:-1], atol=1e-6)
    (measured,) = read.rows("/world/measured", "strips")
    np.testing.assert_allclose(measured[0], tips + LIFTED, atol=1e-6)
    for index, weights in enumerate(plan.weights):
        logged = np.ravel(read.rows(f"/weights/{index + 1}", "scalars"))
        np.testing.assert_allclose(logged, weights, atol=1e-6)
        assert read.rows(f"/world/candidates/{index + 1}", "strips")
    assert f"{plan.confidence:.2f}" in read.rows("/notes", "text")[0][0]
    assert "step" in read.timelines["/world/plan/gripper"]


def test_demonstrations_are_on_a_timeline(workbench, tmp_path, capsys):
    demos = load_demonstrations(workbench / "data" / "push-cube")
    file = tmp_path / "demos.rrd"
    assert main(["view", "--demos", str(workbench / "data" / "push-cube"), "--rerun", str(file)]) == 0
    assert "demos.rrd" in capsys.readouterr().out
    assert (workbench / "data" / "push-cube.html").exists()  # the page, too
    read = Read(file)
    assert {"demonstration", "step"} <= read.timelines["/world/plan/gripper"]
    assert len(read.rows("/world/plan", "strips")) == len(demos)
    assert len(read.rows("/world/plan/gripper", "strips")) == sum(len(demo.trajectory) for demo in demos)


@pytest.mark.parametrize(
    ("where", "status", "said"),
    [
        ("demos.html", 2, ".rrd"),
        ("rerun+http://127.0.0.1:1/proxy", 1, "no viewer answers"),
        ("/proc/demos.rrd", 1, "cannot log to /proc/demos.rrd"),
    ],
)
def test_a_file_of_another_kind_and_a_viewer_that_is_not_there_are_said(workbench, capsys, where, status, said):
    assert main(["view", "--demos", str(workbench / "data" / "push-cube"), "--rerun", where]) == status
    assert said in capsys.readouterr().err


def test_a_recording_that_fails_leaves_the_earlier_file(tmp_path):
    file = tmp_path / "demos.rrd"
    file.write_bytes(b"earlier")
    with pytest.raises(ZeroDivisionError), open_recording(str(file), "demos") as recording:
        recording.log("world/one", rr.Scalars(1 / 0))
    assert [(path, path.read_bytes()) for path in tmp_path.iterdir()] == [(file, b"earlier")]


def test_a_viewer_that_does_not_start_is_said_in_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))  # without a viewer beside it
    with pytest.raises(RipError, match=r"cannot log to live: .*Rerun Viewer") as told, open_recording("live", "demos"):
        pass
    assert "\n" not in str(told.value)
