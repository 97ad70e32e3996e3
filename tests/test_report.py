import json
import os
import re
from dataclasses import fields, replace

import numpy as np
import pytest

from robust_instant_policy import Observation, Plan, Trajectory
from robust_instant_policy.cli import main
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.evaluation import Episode, Scene, Variant
from robust_instant_policy.geometry import GripperTriangle, make_pose
from robust_instant_policy.policies import Stage, Usage
from robust_instant_policy.policies.confidence import Evidence
from robust_instant_policy.reporting.evaluation import Section, evaluation_page
from robust_instant_policy.reporting.run import (
    CONTEXT_FILE,
    EVIDENCE,
    PLAN_FILE,
    SEEN_FILE,
    VIDEO_FILE,
    RunRecord,
    save_context,
    write_report,
)
from robust_instant_policy.reporting.tables import Table
from tests.pages import Page

QUERIES, STEPS, KEYPOINTS = 5, 12, 10


def straight_trajectory(offset_m: float, steps: int = STEPS, arms: int = 1) -> Trajectory:
    poses = np.stack([make_pose(np.diag([1.0, -1, -1]), [0.02 * t, offset_m, 0.1]) for t in range(steps)])
    one_arm = Trajectory.from_poses(poses, np.arange(steps) > 6, GripperTriangle(0.12, 0.05))
    return Trajectory(np.tile(one_arm.actions, (1, arms)), one_arm.times)


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
    page = Page(write_report(run_folder).read_text())
    assert len(page.of("figure")) == 5  # no video; the candidates, the new scene, three demonstrations
    for words in (
        "failed: it <slipped>", "a <remark>", "candidate 4 (hallucinated)", "step 4 of 12", "12.3", "9,000", "0.90",
        "column 9", "not executed",
    ):  # fmt: skip
        assert words in page.text
    content = (run_folder / "report.html").read_text()
    assert "world x [mm]" in content
    assert "gripper z (approach)" in content
    assert content.count("plotly.js v") == 1
    assert page.loaded() == []


NO_CANDIDATES = {
    "candidates": (), "weights": np.zeros((0, STEPS)), "hallucinated": np.zeros(0, bool), "onset": np.zeros(0, int),
    "scores": np.zeros(0),
}  # fmt: skip


def odd_plans(plan: Plan) -> dict[str, Plan]:
    two_arms = straight_trajectory(0.0, arms=2)
    return {
        "no candidates": replace(plan, **NO_CANDIDATES),
        "longer candidates": replace(
            plan,
            candidates=tuple(straight_trajectory(0.01 * index, 40) for index in range(QUERIES)),
            onset=np.array([-1, -1, -1, 30, -1]),
        ),
        "shorter candidates": replace(
            plan, candidates=tuple(straight_trajectory(0.01 * index, 1 + index) for index in range(QUERIES))
        ),
        "one step": replace(
            plan, trajectory=straight_trajectory(0.0, 1), weights=np.ones((QUERIES, 1)), scale=np.zeros((1, 10))
        ),
        "two arms": replace(
            plan, trajectory=two_arms, candidates=(two_arms,) * QUERIES, scale=np.full((STEPS, 20), 0.01)
        ),
        "nothing seen": replace(
            plan, keypoints=np.zeros((0, 3)), pixels=np.zeros((0, 2)), keypoint_confidence=np.zeros(0)
        ),
        "nothing judged": replace(plan, confidence=None, notes=(), usage=Usage()),
        "a single sample": replace(plan, **NO_CANDIDATES, confidence=None, scale=np.zeros((STEPS, 10))),
    }


TOLD = {
    "no candidates": "The plan has no candidates",
    "longer candidates": "step 30 of 40 (time 0.77)",
    "shorter candidates": "candidate 5",
    "one step": "step 4 of 12",
    "two arms": "arm 2 gripper state",
    "nothing seen": "4 of 5",
    "nothing judged": "No check left a note",
    "a single sample": "does not compare the candidates",
}


@pytest.mark.parametrize("case", TOLD)
def test_a_plan_of_any_shape_has_a_report(run_folder, plan, case):
    odd_plans(plan)[case].save(run_folder / PLAN_FILE)
    content = write_report(run_folder).read_text()
    assert TOLD[case] in content
    assert ">nan<" not in content


def test_a_camera_that_looks_away_has_a_report(run_folder, observation):
    replace(observation, camera_pose=make_pose(np.eye(3), [0, 0, 5])).save(run_folder / SEEN_FILE)
    lines = Page(write_report(run_folder).read_text()).of("polyline")
    assert {line["points"] for line in lines} == {""}


def test_words_from_outside_stay_words(run_folder, plan):
    words = "<img src=x onerror=alert(1)> </script> **キューブ** & “Würfel” {{ 7 * 7 }}"
    stages = (Stage(words, 1.0),)
    replace(plan, notes=(words,)).save(run_folder / PLAN_FILE)
    RunRecord(words, words, 7, words, words, True, words, stages).save(run_folder)
    page = Page(write_report(run_folder).read_text())
    assert not page.of("img")
    assert page.text.count("<img src=x onerror=alert(1)> </script>") >= 6
    assert "“Würfel” {{ 7 * 7 }}" in page.text


def test_words_of_an_evaluation_stay_words(tmp_path):
    variant = Variant("rip", model="<i>model</i>")
    row = Episode(Scene("push-cube", "seen", 1), variant, 0, 1, False, 1.0, 1.0, 1.0, 5, 0.5, "<b>slipped</b>")
    table = Table(("<u>head</u>", "`<s>`"), (("**<em>** </td>", "\\*"),), "<p>")
    page = Page(
        evaluation_page(tmp_path, [Section("table1", "paper", "", (), b"<svg/>", [table])], {}, [row], [], table, table)
    )
    for words in ("<b>slipped</b>", "<u>head</u>", "<em> </td>", "<s>", "not examined"):
        assert words in page.text
    assert not {"i", "u", "em", "s"} & {tag for tag, _ in page.seen}
    assert page.loaded() == []


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


def test_damaged_keypoints_of_demonstrations_are_refused_in_one_line(run_folder, capsys):
    np.savez(run_folder / CONTEXT_FILE, pixels=np.zeros((2, KEYPOINTS, 2)))
    assert main(["report", str(run_folder)]) == 1
    (run_folder / CONTEXT_FILE).write_text("hello")
    assert main(["report", str(run_folder)]) == 1
    (run_folder / CONTEXT_FILE).unlink()
    assert main(["report", str(run_folder)]) == 1
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 3
    assert all(CONTEXT_FILE in error for error in errors)


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


@pytest.mark.parametrize("kind", ["pipe", "link", "folder"])
@pytest.mark.parametrize("name", [PLAN_FILE, SEEN_FILE, "report.html"])
def test_what_is_no_regular_file_is_neither_replaced_nor_waited_for(run_folder, tmp_path, capsys, name, kind):
    path, target = run_folder / name, tmp_path / "elsewhere"
    target.write_text("mine")
    path.unlink(missing_ok=True)
    {"pipe": os.mkfifo, "link": lambda it: it.symlink_to(target), "folder": os.mkdir}[kind](path)
    before = path.lstat().st_mode
    assert main(["report", str(run_folder)]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert (path.lstat().st_mode, target.read_text()) == (before, "mine")


@pytest.mark.parametrize("name", ["run.json", CONTEXT_FILE, VIDEO_FILE])
def test_a_pipe_in_the_place_of_a_run_s_file_is_told(run_folder, capsys, name):
    (run_folder / name).unlink(missing_ok=True)
    os.mkfifo(run_folder / name)
    assert main(["report", str(run_folder)]) == 1
    assert "named pipe" in capsys.readouterr().err


def test_the_report_of_a_run_shows_all_evidence_of_the_confidence():
    assert EVIDENCE.keys() == {field.name for field in fields(Evidence)}
