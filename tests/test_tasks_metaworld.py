"""Meta-World's tasks: its scenes, a camera that is right to the millimetre, its experts, its measure of success."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from metaworld.env_dict import ALL_V3_ENVIRONMENTS

from robust_instant_policy.cli import main
from robust_instant_policy.errors import UnknownNameError
from robust_instant_policy.evaluation import Episode, Scene, Suite, Variant, read_results
from robust_instant_policy.evaluation.failures import Failure
from robust_instant_policy.evaluation.statistics import Summary
from robust_instant_policy.geometry import lift, project, transform_points
from robust_instant_policy.motion.gripper_changes import state_of_opening
from robust_instant_policy.reporting.benchmark import benchmark_figure, group_table, loss_table, task_table
from robust_instant_policy.sanity import errors
from robust_instant_policy.tasks import check_task, make_task
from robust_instant_policy.tasks.metaworld.benchmark import METAWORLD
from robust_instant_policy.trajectory import downsample


@pytest.fixture(scope="module", params=["push", "reach"])
def scene(request):
    """A task, what its camera sees in one scene, and the truth of it."""
    task = make_task(f"metaworld/{request.param}")
    observation = task.reset(5)
    yield request.param, observation, task.scene_truth()
    task.close()


def test_all_fifty_tasks_have_a_name_and_a_group():
    assert {f"metaworld/{name.removesuffix('-v3')}" for name in ALL_V3_ENVIRONMENTS} == set(METAWORLD.tasks)
    assert len(METAWORLD.tasks) == 50
    assert set(METAWORLD.tuning) < set(METAWORLD.tasks)
    with pytest.raises(UnknownNameError, match="metaworld/reach"):
        make_task("metaworld/juggle")
    with pytest.raises(UnknownNameError, match="noise"):
        make_task("metaworld/reach", level="hard")


def test_what_is_known_projects_where_it_is_rendered(scene):
    name, observation, truth = scene
    for part, radius in (("obj", 0.02), ("site goal", 0.02)):  # the goal has no body: it is drawn as in the benchmark
        middle = truth.poses[truth.names.index(part)][:3, 3]
        seen = truth.parts == truth.names.index(part)
        assert seen.sum() > 10, f"{part} is not seen in {name}"
        pixel = project(middle, observation.intrinsics, observation.camera_pose)
        assert np.abs(np.argwhere(seen)[:, ::-1].mean(axis=0) - pixel).max() < 1.5
        pixels = np.argwhere(seen)[:, ::-1]
        points = lift(pixels, observation.depth[seen], observation.intrinsics, observation.camera_pose)
        away = np.linalg.norm(points - middle, axis=1)
        assert np.median(away) == pytest.approx(radius, abs=0.006)


def test_a_goal_is_drawn_where_success_is_measured_where_the_benchmark_draws_it_elsewhere():
    task = make_task("metaworld/pick-out-of-hole")
    try:
        task.reset(5)
        truth = task.scene_truth()
        goal = truth.poses[truth.names.index("site goal")][:3, 3]
        assert goal == pytest.approx(task._env.env._target_pos)
        assert (truth.parts == truth.names.index("site goal")).sum() > 10
    finally:
        task.close()


def test_the_table_is_at_height_zero_to_the_millimetre(scene):
    _, observation, truth = scene
    table = truth.parts == truth.names.index("tablelink")
    pixels = np.argwhere(table)[:, ::-1]
    points = lift(pixels, observation.depth[table], observation.intrinsics, observation.camera_pose)
    assert table.mean() > 0.5
    assert np.abs(points[:, 2]).max() < 1e-3


def test_the_robot_is_not_in_the_image(scene):
    _, observation, truth = scene
    hand = truth.poses[truth.names.index("hand")]
    u, v = np.rint(project(hand[:3, 3], observation.intrinsics, observation.camera_pose)).astype(int)
    behind = transform_points(observation.camera_pose, [0.0, 0.0, 0.0])
    assert observation.depth[v, u] > np.linalg.norm(hand[:3, 3] - behind) * 0.9 + 0.05
    assert {truth.names[part] for part in np.unique(truth.parts) if part >= 0} & {"hand", "right_l5", "base"} == set()


def test_the_contract_of_a_task_is_kept():
    task = make_task("metaworld/reach")
    try:
        assert not errors(check_task(task, num_scenes=2))
    finally:
        task.close()


def test_what_was_grasped_and_placed_replays_and_is_filmed():
    task = make_task("metaworld/pick-place")
    try:
        film = []
        shown = task.demonstrate(1)  # where closed fingers cannot push the object to its goal
        assert shown.success
        task.reset(1)
        assert task.execute(downsample(shown.demonstration.trajectory), film.append).success
        assert len(film) > 10
    finally:
        task.close()


def test_camera_noise_leaves_the_scene_as_it_is():
    exact, noisy = make_task("metaworld/push"), make_task("metaworld/push", level="noise")
    try:
        clean, seen = exact.reset(3), noisy.reset(3)
        assert (clean.rgb != seen.rgb).any()
        read = seen.depth > 0
        assert np.median(np.abs(clean.depth[read] - seen.depth[read])) < 0.01
        assert exact.demonstrate(3).success
        assert noisy.demonstrate(3).success
    finally:
        exact.close()
        noisy.close()


def test_a_gripper_state_changes_where_the_hand_is_slowest_while_the_fingers_travel():
    height = np.concatenate([np.linspace(0.3, 0.05, 26), np.full(3, 0.05), np.linspace(0.05, 0.3, 26)])
    points = np.stack([np.zeros_like(height), np.zeros_like(height), height], axis=1)
    travel = np.clip((np.arange(len(height)) - 20) / 12, 0, 1)  # the command comes before the hand is there
    state = state_of_opening(0.1 - 0.06 * travel, points)
    (change,) = np.flatnonzero(np.diff(state.astype(int)))
    assert 24 <= change <= 28
    assert not state_of_opening(np.full(50, 0.1), points[:50]).any()
    assert (state_of_opening(0.04 + 0.06 * travel, points) == ~state).mean() > 0.9  # opening


def test_methods_are_evaluated_and_look_again(in_this_process, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    suite = ["eval", "--suite", "metaworld", "--tasks", "metaworld/push", "--demos", "3", "--episodes", "1"]
    suite += ["--out", "runs/mw", "--no-videos"]
    assert main([*suite, "--methods", "replay", "neighbours"]) == 0
    assert main([*suite, "--methods", "neighbours", "--replan", "8"]) == 0
    rows = read_results(Path("runs/mw")).episodes
    assert [(row.variant.method, row.variant.replan) for row in rows] == [
        ("replay", 0),
        ("neighbours", 0),
        ("neighbours", 8),
    ]
    assert rows[0].success
    assert all(row.executed_seconds > 0 for row in rows)
    assert (tmp_path / "data" / "metaworld-push").exists()
    page = Path("runs/mw/index.html").read_text()
    assert "SmolVLA (2.25B), published" in page


def test_other_simulators_are_not_imported():
    code = (
        "import sys; from robust_instant_policy.tasks import make_task; task = make_task('metaworld/reach');"
        "task.demonstrate(0); task.close();"
        "print([m for m in ('mani_skill', 'sapien', 'gym_aloha', 'torch') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_tables_group_tasks_by_difficulty_beside_published_numbers():
    methods = Variant("replay"), Variant("neighbours")
    suite = Suite("metaworld", METAWORLD.tasks, methods, (1_000_000, 1_000_001))
    easy = set(METAWORLD.groups["easy"])
    rows = [
        Episode(Scene(task, "seen", seed), method, 0, 1, good, 1.0, 1.0, 1.0, 0, None, "" if good else "missed")
        for task in METAWORLD.tasks
        for seed in suite.seeds
        for method in methods
        for good in [method.method == "replay" or task in easy or seed == suite.seeds[0]]
    ]
    summary = Summary(suite, rows)
    table = group_table(METAWORLD, summary)
    neighbours = dict(zip(table.head, table.rows[1], strict=True))
    assert neighbours["easy (28)"] == "100.0"
    assert neighbours["very hard (5)"] == "50.0"
    assert neighbours["mean of the groups"] == "62.5"  # (100 + 3 · 50) / 4
    assert neighbours["mean of the 50 tasks"] == "78.0 (64.8 to 87.2)"  # (28 · 100 + 22 · 50) / 50; Wilson, n = 50
    assert "replay, neighbours: 2 scenes a task." in table.note
    published = {row[0]: row for row in table.rows}["SmolVLA (2.25B), published"]
    assert dict(zip(table.head, published, strict=True))["mean of the groups"] == "68.2"
    assert "what differs" not in table.note
    assert "2,500" in table.note
    by_task = {row[0]: row for row in task_table(METAWORLD, summary).rows}
    assert len(by_task) == 50
    assert by_task["stick-pull †"][1:] == ("very hard", "100", "50")
    assert by_task["stick-push"][1:] == ("very hard", "100", "50")
    assert benchmark_figure(METAWORLD, summary).axes[0].get_ylabel() == "success [%]"


def test_failures_are_told_by_task_and_stage_for_sets_of_demonstrations_with_scenes_of_their_own():
    sets = [Variant("gp", demo_set=number) for number in range(2)]
    suite = Suite("metaworld", ("metaworld/push", "metaworld/reach"), tuple(sets), (1_000_000, 1_001_000))
    moved = {"metaworld/push": 2.0, "metaworld/reach": 0.0}  # seconds: plans of reach were refused
    rows = [
        Episode(Scene(task, "seen", seed), one, 0, 1, False, 1.0, 1.0, moved[task], 0, None, "not done")
        for task in suite.tasks
        for seed, one in zip(suite.seeds, sets, strict=True)
    ]
    told = [("samples", 0.0), ("samples", 0.02), ("keypoints", 0.2), ("samples", 0.2)]  # 0.0: none on what moves
    found = [
        Failure(row.scene, row.variant, 0, stage, True, stage == "keypoints", error, False)
        for row, (stage, error) in zip(rows, told, strict=True)
    ]
    table = loss_table(METAWORLD, Summary(suite, rows), found)
    by_task = {row[0]: dict(zip(table.head, row, strict=True)) for row in table.rows}
    push, reach = by_task["push †"], by_task["reach †"]
    assert (push["failed"], push["keypoints"], push["plan"], push["keypoint error, mm"]) == ("2 of 2", "1", "1", "20")
    assert (reach["refused"], reach["keypoints"], reach["plan"]) == ("2", "–", "–")
    note = group_table(METAWORLD, Summary(suite, rows)).note
    assert "gp: 2 scenes a task, a part of them with each of 2 sets of demonstrations." in note
    assert loss_table(METAWORLD, Summary(suite, rows), []) is None  # nothing was examined
