"""The simulated cell, on push-cube: physics, camera, demonstrator and execution."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from robust_instant_policy.errors import UnreachableError
from robust_instant_policy.geometry import lift, project
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.record import record
from robust_instant_policy.trajectory import Trajectory, downsample


@pytest.fixture(scope="module")
def task():
    task = make_task("push-cube")
    yield task
    task.close()


@pytest.fixture(scope="module")
def attempt(task):
    return task.demonstrate(3)


def test_the_camera_sees_the_goal_where_it_is(task):
    observation = task.reset(11)
    truth = task.scene_truth()
    rows, columns = np.nonzero(truth.parts == truth.names.index("goal"))
    centre = truth.poses[truth.names.index("goal")][:3, 3]
    seen = np.array([columns.mean(), rows.mean()])
    np.testing.assert_allclose(project(centre, observation.intrinsics, observation.camera_pose), seen, atol=0.2)
    pixels = np.stack([columns, rows], axis=1)
    points = lift(pixels, observation.depth[rows, columns], observation.intrinsics, observation.camera_pose)
    np.testing.assert_allclose(points[:, 2], 0.001, atol=0.002)


def test_the_arm_at_home_is_out_of_the_cameras_sight(task):
    task.reset(11)
    truth = task.scene_truth()
    assert {truth.names[part] for part in np.unique(truth.parts)} == {"table-workspace", "cube", "goal"}


def test_a_demonstration_pushes_the_cube_in_and_looks_like_a_persons(attempt):
    assert attempt.success, attempt.failure
    trajectory = attempt.demonstration.trajectory
    assert 3.0 < attempt.demonstration.seconds < 9.0
    palm = trajectory.triplets[:, 0, 0]
    speed = np.linalg.norm(np.diff(palm, axis=0), axis=1) * attempt.demonstration.rate_hz
    assert speed.max() < 1.0
    assert (speed < 0.02).mean() > 0.1  # pauses
    assert trajectory.gripper_state[0, 0] == 0
    assert trajectory.gripper_state[-1, 0] == 1


def test_the_same_seed_gives_the_same_scene_image_and_recording(task, attempt):
    task.demonstrate(8)
    again = task.demonstrate(3)
    np.testing.assert_array_equal(again.demonstration.observation.rgb, attempt.demonstration.observation.rgb)
    np.testing.assert_array_equal(again.demonstration.observation.depth, attempt.demonstration.observation.depth)
    np.testing.assert_array_equal(again.demonstration.trajectory.actions, attempt.demonstration.trajectory.actions)


def test_execution_does_not_depend_on_what_was_executed_before(task, attempt):
    trajectory = downsample(attempt.demonstration.trajectory)
    endings = []
    for seed in (3, 5, 3, 3):
        task.reset(seed)
        task.execute(trajectory)
        endings.append(task.scene_truth().poses)
    np.testing.assert_array_equal(endings[0], endings[2])
    np.testing.assert_array_equal(endings[0], endings[3])
    assert not np.array_equal(endings[0], endings[1])


def test_executing_twice_starts_again_from_the_scene_of_the_last_reset(task, attempt):
    trajectory = downsample(attempt.demonstration.trajectory)
    task.reset(3)
    task.execute(trajectory)
    first = task.scene_truth().poses
    task.execute(trajectory)
    np.testing.assert_array_equal(task.scene_truth().poses, first)


@pytest.mark.parametrize("method", ["masked", "uniform"])
def test_a_demonstration_replays_in_its_own_scene(task, attempt, method):
    task.reset(3)
    execution = task.execute(downsample(attempt.demonstration.trajectory, method))
    assert execution.success, execution.failure
    assert execution.tracking_error < 0.02


def test_pushing_the_wrong_cube_fails_in_words(task, attempt):
    task.reset(8)
    execution = task.execute(downsample(attempt.demonstration.trajectory))
    assert not execution.success
    assert "mm from the goal's centre" in execution.failure


def _moved(trajectory, offset, step):
    actions = trajectory.actions.copy()
    actions[step, :9] += np.tile(offset, 3)
    return Trajectory.from_actions(actions)


@pytest.mark.parametrize(
    ("offset", "words"),
    [((0.9, 0.0, 0.0), "cannot reach"), ((0.0, 0.0, -0.2), "inside the table"), ((0.0, 0.0, 1.5), "cannot reach")],
)
def test_an_unreachable_step_is_named_before_anything_moves(task, attempt, offset, words):
    task.reset(3)
    before = task.scene_truth().poses
    trajectory = _moved(downsample(attempt.demonstration.trajectory), offset, 14)
    with pytest.raises(UnreachableError, match=words) as error:
        task.execute(trajectory)
    assert "step 14" in str(error.value)
    np.testing.assert_array_equal(task.scene_truth().poses, before)


def test_three_points_that_are_no_gripper_are_refused(task, attempt):
    task.reset(3)
    actions = downsample(attempt.demonstration.trajectory).actions.copy()
    actions[5, :9] = np.tile(actions[5, :3], 3)
    with pytest.raises(UnreachableError, match="miss the gripper"):
        task.execute(Trajectory.from_actions(actions))


def test_a_far_jump_between_waypoints_is_slowed_down(task, attempt):
    task.reset(3)
    actions = downsample(attempt.demonstration.trajectory).actions[[0, -1, 0, -1, 0]]
    execution = task.execute(Trajectory.from_actions(actions))
    assert execution.seconds > 5 / task.execute_hz + 2.0
    assert execution.tracking_error < 0.05


class _Folder:
    """A writer in memory, with the interface of the one on disk."""

    discarded = 0

    def __init__(self, kept=()):
        self.kept = list(kept)

    num_episodes = property(lambda self: len(self.kept))
    last_seed = property(lambda self: self.kept[-1].seed if self.kept else None)

    def add(self, demonstration, images=None, grippers=None):
        self.kept.append(demonstration)

    def discard(self, seed):
        self.discarded += 1


def test_a_recording_cut_off_goes_on_with_the_same_episodes(task):
    whole = _Folder()
    told = []
    record(task, whole, 3, on_progress=lambda *counts: told.append(counts))
    resumed = _Folder(whole.kept[:1])
    record(task, resumed, 3)
    assert [d.seed for d in resumed.kept] == [d.seed for d in whole.kept]
    assert told[-1] == (3, 3, whole.discarded)
    for one, other in zip(whole.kept, resumed.kept, strict=True):
        np.testing.assert_array_equal(one.trajectory.actions, other.trajectory.actions)


def test_without_a_renderer_one_line_says_what_to_install():
    code = "from robust_instant_policy.tasks import make_task; make_task('push-cube')"
    result = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, "VK_ICD_FILENAMES": "/nowhere.json", "VK_DRIVER_FILES": "/nowhere.json"},
    )
    assert result.returncode == 1
    assert "RendererError" in result.stderr
    assert "make setup" in result.stderr.strip().splitlines()[-1]
