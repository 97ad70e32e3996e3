"""The ALOHA tasks: physics, demonstrators, rules, camera and renderer."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from robust_instant_policy.errors import UnreachableError
from robust_instant_policy.geometry import lift, project
from robust_instant_policy.tasks import make_task
from robust_instant_policy.trajectory import Trajectory, downsample

SEEDS = (0, 1)
MOVING_PART = {"aloha-pick-banana": "banana", "aloha-cup-upright": "cup", "aloha-pick-place": "bottle"}
ENVIRONMENTS = ("RIP-AlohaPickBanana-v1",)
VISIBLE_PIXELS = 200
REST_SECONDS = 60.0
AT_REST_M = 0.001


@pytest.fixture(scope="module", params=MOVING_PART)
def task(request):
    task = make_task(request.param)
    yield task
    task.close()


@pytest.fixture(scope="module")
def attempts(task):
    return {seed: task.demonstrate(seed) for seed in SEEDS}


def test_the_demonstrator_succeeds_and_its_recording_replays_at_one_hertz(task, attempts):
    for seed, attempt in attempts.items():
        assert attempt.success, attempt.failure
        assert attempt.demonstration.rate_hz == 10.0
        task.reset(seed)
        execution = task.execute(downsample(attempt.demonstration.trajectory, "masked"))
        assert execution.success, execution.failure
        assert execution.seconds > 29.0
        assert execution.tracking_error < 0.02


def test_the_same_seed_gives_the_same_recording_bit_by_bit(task, attempts):
    again = task.demonstrate(SEEDS[0]).demonstration
    first = attempts[SEEDS[0]].demonstration
    np.testing.assert_array_equal(again.observation.rgb, first.observation.rgb)
    np.testing.assert_array_equal(again.observation.depth, first.observation.depth)
    np.testing.assert_array_equal(again.trajectory.actions, first.trajectory.actions)


def test_the_camera_sees_the_part_that_moves_and_no_robot(task):
    for seed in range(100_000, 100_004):
        task.reset(seed)
        truth = task.scene_truth()
        part = truth.names.index(MOVING_PART[task.name])
        assert (truth.parts == part).sum() > VISIBLE_PIXELS
        assert not any("vx300s" in truth.names[index] for index in np.unique(truth.parts) if index >= 0)


def test_objects_at_rest_stay_at_rest_for_a_minute(task):
    task.reset(5)
    before = task.scene_truth().poses
    cell = task._cell
    home = np.append(task._arm.home, task._arm.finger_travel)
    for _ in range(int(REST_SECONDS * task._timing.control_hz)):
        cell.advance(home)
    after = task.scene_truth().poses
    assert np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1).max() < AT_REST_M
    assert np.abs(after[:, :3, :3] - before[:, :3, :3]).max() < 0.01


def test_doing_nothing_fails_in_words(task, attempts):
    task.reset(SEEDS[0])
    first = attempts[SEEDS[0]].demonstration.trajectory.actions[:1]
    execution = task.execute(Trajectory.from_actions(np.repeat(first, 3, axis=0)))
    assert not execution.success
    assert len(execution.failure) > 10


def test_depth_and_calibration_put_the_banana_where_it_is():
    task = make_task("aloha-pick-banana")
    try:
        observation = task.reset(11)
        truth = task.scene_truth()
    finally:
        task.close()
    rows, columns = np.nonzero(truth.parts == truth.names.index("banana"))
    pixels = np.stack([columns, rows], axis=1)
    points = lift(pixels, observation.depth[rows, columns], observation.intrinsics, observation.camera_pose)
    local = truth.material_point(points, "banana")
    assert np.abs(local[:, 2]).max() < 0.025  # of its own thickness
    assert np.percentile(local[:, 2], 95) > 0.010
    np.testing.assert_allclose(project(points, observation.intrinsics, observation.camera_pose), pixels, atol=1e-6)
    table = lift([[320, 10]], observation.depth[10, 320][None], observation.intrinsics, observation.camera_pose)
    np.testing.assert_allclose(table[0, 2], 0.0, atol=0.001)


@pytest.mark.parametrize(
    ("offset", "words"),
    [((0.9, 0.0, 0.0), "cannot reach"), ((0.0, 0.0, -0.2), "inside the table"), ((0.0, 0.0, 1.5), "cannot reach")],
)
def test_an_unreachable_step_is_named_before_anything_moves(task, attempts, offset, words):
    task.reset(SEEDS[0])
    before = task.scene_truth().poses
    actions = downsample(attempts[SEEDS[0]].demonstration.trajectory).actions.copy()
    actions[14, :9] += np.tile(offset, 3)
    with pytest.raises(UnreachableError, match=words) as error:
        task.execute(Trajectory.from_actions(actions))
    assert "step 14" in str(error.value)
    np.testing.assert_array_equal(task.scene_truth().poses, before)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_plain_gymnasium_makes_and_steps_the_environment(environment):
    import gymnasium
    from gymnasium.utils.env_checker import check_env

    import robust_instant_policy.tasks.aloha.envs  # noqa: F401

    env = gymnasium.make(environment, render_mode="rgb_array")
    try:
        check_env(env.unwrapped, skip_render_check=True)
        observation, _ = env.reset(seed=0)
        assert observation["rgb"].shape == (480, 640, 3)
        _, reward, _, _, info = env.step(env.action_space.sample())
        assert not info["success"]
        assert reward == 0.0
        assert env.render().shape == (360, 480, 3)
    finally:
        env.close()


def renderer(**environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "robust_instant_policy.tasks.aloha.renderer"]
    clean = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    return subprocess.run(command, capture_output=True, text=True, check=False, env={**clean, **environment})


def test_a_renderer_is_chosen_without_a_screen_and_the_users_choice_stands():
    assert renderer().stdout.split(",")[0] in ("egl", "osmesa")
    assert renderer(MUJOCO_GL="osmesa").stdout.startswith("osmesa,")


def test_without_a_renderer_one_line_says_what_to_install():
    result = renderer(MUJOCO_GL="glfw", DISPLAY="")
    assert result.returncode == 1
    assert "make setup" in result.stderr.strip().splitlines()[-1]
