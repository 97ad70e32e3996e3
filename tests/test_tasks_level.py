"""The hard level: what it varies, and that its scenes can be done."""

from __future__ import annotations

import numpy as np
import pytest

from robust_instant_policy.datasets import DatasetWriter, load_demonstrations
from robust_instant_policy.errors import UnknownNameError
from robust_instant_policy.sanity import check_demonstrations
from robust_instant_policy.tasks import TASK_NAMES, UNSEEN_TASKS, make_task
from robust_instant_policy.tasks.demonstrator import Stroke, shorter_turns
from robust_instant_policy.tasks.level import HARD, PAPER, Layout, Region, make_level
from robust_instant_policy.tasks.poses import downward, facing
from robust_instant_policy.tasks.record import record
from robust_instant_policy.trajectory import downsample

REGION = Region((-0.5, 0.0), 0.25, 0.75, ((-0.3, -0.35), (0.4, 0.35)))
REACH = [(-0.08, 0.0), (0.2, 0.0)]
SEEDS = range(30)


def yaw(pose: np.ndarray) -> float:
    return float(np.arctan2(pose[1, 0], pose[0, 0]))


def test_the_papers_level_leaves_everything_as_the_task_drew_it():
    layout, pose, home = Layout(PAPER, 3, REGION), facing(0.05, -0.02, 0.2), np.ones((1, 6))
    np.testing.assert_array_equal(layout.place(pose, REACH), pose)
    np.testing.assert_array_equal(layout.home(home), home)
    assert not layout.distractors()
    assert layout.furnishing() is None
    assert layout.rod((0.0, 0.0, 1.3)) is None


def test_hard_objects_lie_in_every_direction_where_the_arm_reaches_them():
    poses = [Layout(HARD, seed, REGION).place(facing(0.05, 0.0, 0.0), REACH) for seed in SEEDS]
    turned = [yaw(pose) for pose in poses]
    assert min(turned) < -np.pi / 2
    assert max(turned) > np.pi / 2
    for pose in poses:
        points = np.array([pose[:2, :2] @ point + pose[:2, 3] for point in REACH])
        distance = np.linalg.norm(points - REGION.base, axis=1)
        assert ((distance >= REGION.nearest) & (distance <= REGION.farthest)).all()


def test_a_task_can_limit_how_far_its_objects_turn():
    poses = [Layout(HARD, seed, REGION).place(facing(0.05, 0.0, 0.0), REACH, turn=0.3) for seed in SEEDS]
    assert max(abs(yaw(pose)) for pose in poses) <= 0.3


def test_two_to_five_distractors_stay_clear_of_the_task_and_of_each_other():
    counts = set()
    for seed in SEEDS:
        layout = Layout(HARD, seed, REGION)
        pose = layout.place(facing(0.05, 0.0, 0.0), REACH)
        found = layout.distractors()
        counts.add(len(found))
        way = np.array([pose[:2, :2] @ (share, 0.0) + pose[:2, 3] for share in np.linspace(-0.08, 0.2, 50)])
        for index, one in enumerate(found):
            at = one.pose[:2, 3]
            assert np.linalg.norm(way - at, axis=1).min() > one.radius + 0.045
            assert all(np.linalg.norm(at - other.pose[:2, 3]) > one.radius + other.radius for other in found[:index])
    assert counts == {2, 3, 4, 5}


def test_a_hand_turns_the_shorter_way_to_an_object_that_lies_the_other_way_round():
    behind, before = (np.array([downward(0.1, 0.0, 0.1, np.deg2rad(angle))]) for angle in (170, 20))
    turned, same = (shorter_turns([Stroke(poses, closed=False)])[0].poses[0] for poses in (behind, before))
    np.testing.assert_allclose(turned, downward(0.1, 0.0, 0.1, np.deg2rad(-10)), atol=1e-12)
    np.testing.assert_array_equal(same, before[0])


def test_an_unknown_level_is_told():
    with pytest.raises(UnknownNameError, match="paper, noise, hard"):
        make_level("easy")


@pytest.mark.parametrize("name", TASK_NAMES)
def test_tasks_are_known_to_have_a_second_set_of_objects_without_their_simulator(name):
    refused = "source of assets" if name in UNSEEN_TASKS else "set of objects"  # objects are looked at first
    with pytest.raises(UnknownNameError, match=refused):
        make_task(name, "unseen", assets="none", level="hard")


@pytest.mark.parametrize("name", ["open-drawer", "aloha-pick-banana"])
def test_a_hard_scene_is_done_replayed_and_drawn_again(name):
    task = make_task(name, level="hard")
    try:
        attempt = task.demonstrate(1)
        assert attempt.success, attempt.failure
        execution = task.execute(downsample(attempt.demonstration.trajectory))
        assert execution.success, execution.failure
        first, again = attempt.demonstration.observation, task.reset(1)
        np.testing.assert_array_equal(first.rgb, again.rgb)
        np.testing.assert_array_equal(first.depth, again.depth)
        hidden = {part for part in task.scene_truth().names if part.startswith(("distractor", "rod"))}
        assert {"rod", "distractor-0", "distractor-1"} <= hidden
    finally:
        task.close()


def test_arms_start_elsewhere_in_every_hard_scene():
    task = make_task("push-cube", level="hard")
    try:
        starts = [task.demonstrate(seed).demonstration.trajectory.actions[0, :3] for seed in (0, 1)]
    finally:
        task.close()
    assert np.linalg.norm(starts[0] - starts[1]) > 0.005


def test_recorded_hard_demonstrations_pass_the_checks(tmp_path):
    task = make_task("push-cube", level="hard")
    try:
        with DatasetWriter(tmp_path / "d", task=task.name, description=task.description, rate_hz=task.record_hz) as out:
            record(task, out, 3)
    finally:
        task.close()
    check_demonstrations(load_demonstrations(tmp_path / "d")).raise_if_wrong()
