import json
import re
from dataclasses import replace

import numpy as np
import pytest

from robust_instant_policy import Observation, Plan, Trajectory
from robust_instant_policy.cli import main
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.geometry import GripperTriangle, make_pose
from robust_instant_policy.policies import Stage, Usage
from robust_instant_policy.reporting.run import PLAN_FILE, SEEN_FILE, RunRecord, save_context, write_report

QUERIES, STEPS, KEYPOINTS = 5, 12, 10


def straight_trajectory(offset_m: float) -> Trajectory:
    poses = np.stack([make_pose(np.diag([1.0, -1, -1]), [0.02 * t, offset_m, 0.1]) for t in range(STEPS)])
    return Trajectory.from_poses(poses, np.arange(STEPS) > 6, GripperTriangle(0.12, 0.05))


@pytest.fixture
def plan() -> Plan:
    rng = np.random.default_rng(0)
    weights = np.ones((QUERIES, STEPS))
    weights[3, 4:] = 0.02
    return Plan(
        trajectory=straight_trajectory(0.0),
        candidates=tuple(straight_trajectory(0.3 if index == 3 else 0.002 * index) for index in range(QUERIES)),
        weights=weights,
        scale=np.full((STEPS, 10), 0.004),
        hallucinated=np.arange(QUERIES) == 3,
        onset=np.where(np.arange(QUERIES) == 3, 4, -1),
        scores=np.arange(QUERIES) / 10,
        confidence=0.9,
        keypoints=rng.uniform(-0.2, 0.2, (KEYPOINTS, 3)),
        pixels=rng.uniform(0, 64, (KEYPOINTS, 2)),
        keypoint_confidence=np.linspace(0.5, 1, KEYPOINTS),
        usage=Usage((Stage("language model", 12.3, 9000, 8000, 700), Stage("regression", 0.002))),
        notes=("a <remark>",),
    )


@pytest.fixture
def observation() -> Observation:
    rng = np.random.default_rng(1)
    return Observation(
        rgb=rng.integers(0, 255, (64, 64, 3), dtype=np.uint8),
        depth=np.full((64, 64), 1.2, dtype=np.float32),
        intrinsics=np.array([[90.0, 0, 32], [0, 90, 32], [0, 0, 1]]),
        camera_pose=make_pose(np.diag([1.0, -1, -1]), [0, 0, 1.2]),
    )


@pytest.fixture
def run_folder(tmp_path, plan, observation):
    plan.save(tmp_path / PLAN_FILE)
    observation.save(tmp_path / SEEN_FILE)
    save_context(tmp_path, [observation.rgb] * 3, np.random.default_rng(2).uniform(0, 64, (3, KEYPOINTS, 2)))
    RunRecord("push-cube", "push it", 7, "a model", "rip", False, "failed: it <slipped>", plan.usage.stages).save(
        tmp_path
    )
    return tmp_path


def test_a_plan_comes_back_from_its_file_unchanged(tmp_path, plan):
    plan.save(tmp_path / "plan.json")
    read = Plan.load(tmp_path / "plan.json")
    np.testing.assert_array_equal(read.trajectory.actions, plan.trajectory.actions)
    np.testing.assert_array_equal(read.weights, plan.weights)
    assert read.hallucinated.tolist() == plan.hallucinated.tolist()
    assert read.usage == plan.usage
    assert read.notes == plan.notes
    assert len(read.candidates) == QUERIES


def test_a_plan_with_a_number_that_is_none_is_never_written(tmp_path, plan):
    with pytest.raises(ValueError, match="JSON"):
        replace(plan, scale=np.full((STEPS, 10), np.nan)).save(tmp_path / "plan.json")


def test_a_damaged_plan_is_refused_in_one_line(tmp_path):
    for content in ("", "[]", "{}", '{"format": 1}', '{"format": 99}'):
        (tmp_path / "plan.json").write_text(content)
        with pytest.raises(DatasetError, match=r"plan\.json"):
            Plan.load(tmp_path / "plan.json")


@pytest.mark.parametrize("value", ["NaN", '"high"', "1.5", "true or false"])
def test_a_plan_whose_confidence_is_no_confidence_is_refused(tmp_path, plan, value):
    plan.save(tmp_path / "plan.json")
    text = (tmp_path / "plan.json").read_text()
    (tmp_path / "plan.json").write_text(re.sub('"confidence": [^,]+', f'"confidence": {value}', text))
    with pytest.raises(DatasetError, match=r"plan\.json is not a plan"):
        Plan.load(tmp_path / "plan.json")


def test_the_report_tells_the_whole_story_without_the_network(run_folder):
    page = write_report(run_folder).read_text()
    assert page.count("<figure") == 5  # the proposals, the new scene, three demonstrations
    assert "failed: it &lt;slipped&gt;" in page
    assert "a &lt;remark&gt;" in page
    assert "candidate 4 (hallucinated)" in page
    assert "step 4 of 12" in page
    assert "12.3" in page
    assert "9,000" in page
    assert "world x [mm]" in page
    assert "gripper z (approach)" in page
    head = page[: page.index("<script>")] + page[page.index("</script>") :]
    assert 'src="http' not in head
    assert 'href="http' not in head


def test_the_report_command_writes_the_page_again(run_folder, capsys):
    assert main(["report", str(run_folder)]) == 0
    assert (run_folder / "report.html").exists()


def test_a_folder_without_a_run_is_refused_in_one_line(tmp_path, capsys):
    assert main(["report", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert "holds no run" in error
    assert error.count("\n") == 1


def test_a_damaged_run_is_refused_in_one_line(run_folder, capsys):
    (run_folder / "run.json").write_text(json.dumps({"task": 1}))
    assert main(["report", str(run_folder)]) == 1
    assert "damaged" in capsys.readouterr().err


def test_an_observation_comes_back_from_its_file(tmp_path, observation):
    observation.save(tmp_path / "seen.npz")
    read = Observation.load(tmp_path / "seen.npz")
    np.testing.assert_array_equal(read.rgb, observation.rgb)
    np.testing.assert_array_equal(read.depth, observation.depth)


def test_a_file_that_is_no_observation_is_refused_in_one_line(tmp_path):
    (tmp_path / "text.npz").write_text("hello")
    np.savez(tmp_path / "half.npz", rgb=np.zeros((4, 4, 3), np.uint8))
    np.savez(tmp_path / "objects.npz", rgb=np.array([{}], dtype=object), depth=1, intrinsics=1, camera_pose=1)
    for name in ("text.npz", "half.npz", "objects.npz", "absent.npz"):
        with pytest.raises(DatasetError, match=name):
            Observation.load(tmp_path / name)
