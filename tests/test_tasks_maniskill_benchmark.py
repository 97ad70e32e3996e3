"""ManiSkill's own tasks: the benchmark's scenes, robot and rule of success, with a demonstrator of ours."""

import pytest

from robust_instant_policy.cli import main
from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.errors import UnknownNameError
from robust_instant_policy.policies import Neighbours
from robust_instant_policy.tasks import check_task, make_task


@pytest.fixture(scope="module")
def pick_cube():
    task = make_task("maniskill/PickCube")
    yield task
    task.close()


def test_a_task_of_maniskill_keeps_the_contract_of_tasks(pick_cube):
    assert check_task(pick_cube, num_scenes=2) == ()


def test_what_is_recorded_in_a_task_of_maniskill_solves_a_new_scene(pick_cube, tmp_path, capsys):
    assert main(["record", "--task", "maniskill/PickCube", "--episodes", "6", "--out", str(tmp_path / "demos")]) == 0
    policy = Neighbours().fit(load_demonstrations(tmp_path / "demos"))
    plan = policy.plan(pick_cube.reset(1000))
    execution = pick_cube.execute(plan.trajectory)
    assert execution.success, execution.failure


def test_the_scenes_are_those_of_the_benchmark_so_only_the_camera_varies():
    with pytest.raises(UnknownNameError, match="paper, noise"):
        make_task("maniskill/PickCube", level="hard")
