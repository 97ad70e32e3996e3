"""The benchmark of relations, and planning from given keypoints."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import relations
from relation_families import FAMILIES, UNCOVERED
from relations import WITHIN_M, key_error, read_rows, way_error

from robust_instant_policy.errors import UsageError
from robust_instant_policy.policies import (
    KeypointRegression,
    Neighbours,
    Settings,
    context_of_keypoints,
    locate,
    scene_of_keypoints,
)
from robust_instant_policy.sanity.envelope import step_turns


@pytest.fixture
def benchmark(monkeypatch):
    """Runs the benchmark with arguments."""

    def run(*arguments: object) -> None:
        monkeypatch.setattr(sys, "argv", ["relations.py", *map(str, arguments)])
        relations.main()

    return run


@pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES)
def test_a_demonstration_is_right_by_the_measure_and_one_of_another_scene_is_not(family):
    draw = family.scenes("tune", 0, 0.002)
    errors = []
    for number in range(10):
        truth, shown = draw(number, exact=True), draw(number)
        assert key_error(truth.trajectory, truth.path) == 0
        assert way_error(truth.trajectory, truth.path) == 0
        assert key_error(draw(number + 100).trajectory, truth.path) > WITHIN_M
        errors.append(max(key_error(shown.trajectory, truth.path), way_error(shown.trajectory, truth.path)))
        assert shown.keypoints.shape == (10, 3)
        assert not np.array_equal(family.scenes("measure", 0, 0.002)(number).keypoints, shown.keypoints)
    assert np.median(errors) <= WITHIN_M  # a hand may err by more now and then


@pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES)
def test_scenes_that_no_demonstration_covers_differ_from_the_usual_ones(family):
    draw = family.scenes("tune", 0, 0.0)
    for condition in family.uncovered:
        moved = np.linalg.norm(draw(1, condition=condition).keypoints - draw(1).keypoints, axis=1)
        assert moved.max() > 0.02


def test_a_plan_needs_keypoints_only():
    draw = FAMILIES["place"].scenes("tune", 0, 0.002)
    shown = [draw(number) for number in range(10)]
    context = context_of_keypoints(
        np.stack([scene.keypoints for scene in shown]), [scene.path for scene in shown], Settings()
    )
    new = draw(1000, exact=True)
    plan = Neighbours().fit_context(context).plan_scene(scene_of_keypoints(new.keypoints))
    assert key_error(plan.trajectory, new.path) <= WITHIN_M
    with pytest.raises(UsageError, match="keypoints of the demonstrations were given"):
        locate(context, None)


def test_a_plan_turns_between_two_things_as_gradually_as_the_demonstrations():
    draw = FAMILIES["flip"].scenes("tune", 0, 0.002)
    shown = [draw(number) for number in range(10)]
    context = context_of_keypoints(
        np.stack([scene.keypoints for scene in shown]), [scene.path for scene in shown], Settings()
    )
    policy = Neighbours().fit_context(context)
    demonstrated = max(step_turns(scene.trajectory).max() for scene in shown)
    for number in range(1000, 1005):
        plan = policy.plan_scene(scene_of_keypoints(draw(number, exact=True).keypoints))
        assert step_turns(plan.trajectory).max() < 1.5 * demonstrated
        assert plan.evidence["errors"] == 0


def test_a_scene_between_two_ways_to_act_has_less_confidence_and_says_so():
    family = FAMILIES["side"]
    draw = family.scenes("tune", 0, 0.002)
    shown = [draw(number) for number in range(10)]
    context = context_of_keypoints(
        np.stack([scene.keypoints for scene in shown]), [scene.path for scene in shown], Settings()
    )
    policy = Neighbours().fit_context(context)
    keypoints = next(scene.keypoints for scene in shown if abs(scene.keypoints[:5, 1].mean()) > 0.05)
    middle = keypoints - np.array([0.0, 1.0, 0.0]) * keypoints[:5, 1].mean() * (np.arange(10) < 5)[:, None]
    clear, close = (policy.plan_scene(scene_of_keypoints(points)) for points in (keypoints, middle))
    assert close.evidence["vote"] < clear.evidence["vote"]
    assert close.confidence < clear.confidence
    assert any("do different things" in note for note in close.notes)


def test_the_benchmark_writes_rows_once_and_a_table(benchmark, tmp_path):
    rows = tmp_path / "rows.jsonl"
    for _ in range(2):
        benchmark(
            "--rows", rows, "--out", tmp_path, "--families", "place", "--sets", 1, "--scenes", 1, "--demos", 5,
            "--methods", "median", "neighbours", "rip", "--llm", "stand-in",
        )  # fmt: skip
        assert sorted(row.case.method for row in read_rows(rows)) == ["kat", "median", "neighbours", "rip", "rip-gauss"]
    assert "| place | 100% of 1" in (tmp_path / "tables" / "relations.md").read_text()


def test_a_gaussian_process_learns_what_the_chosen_frames_leave_over():
    draw = FAMILIES["place"].scenes("tune", 0, 0.002)
    shown, new = [draw(number) for number in range(10)], [draw(1000 + number, exact=True) for number in range(10)]
    errors = {}
    for settings in (Settings(frames="world"), Settings()):
        context = context_of_keypoints(
            np.stack([scene.keypoints for scene in shown]), [scene.path for scene in shown], settings
        )
        policy = KeypointRegression(settings).fit_context(context)
        plans = [policy.plan_scene(scene_of_keypoints(scene.keypoints)) for scene in new]
        errors[settings.frames] = [
            key_error(plan.trajectory, scene.path) for plan, scene in zip(plans, new, strict=True)
        ]
    assert np.median(errors["adaptive"]) < 0.5 * np.median(errors["world"])


def test_the_benchmark_says_what_the_confidence_is_worth(benchmark, tmp_path):
    benchmark(
        "--rows", tmp_path / "rows.jsonl", "--out", tmp_path, "--families", "place", "--sets", 1, "--scenes", 1,
        "--methods", "neighbours", "--confidence",
    )  # fmt: skip
    table = (tmp_path / "tables" / "relations_confidence.md").read_text()
    for kind in ("usual scenes", *UNCOVERED):
        assert f"| neighbours | {kind} | 1, " in table
    assert (tmp_path / "images" / "relations_confidence.svg").stat().st_size > 1000


def test_the_benchmark_refuses_methods_without_a_language_model_in_one_line(benchmark, tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        benchmark("--methods", "rip", "--out", tmp_path)
    assert "--llm" in capsys.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())
