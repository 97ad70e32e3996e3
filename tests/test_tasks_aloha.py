"""The ALOHA tasks: physics, demonstrators, rules, camera and renderer."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from robust_instant_policy.errors import UnreachableError
from robust_instant_policy.geometry import invert_pose, lift, transform_points
from robust_instant_policy.motion.arm import Motion
from robust_instant_policy.tasks import make_task
from robust_instant_policy.trajectory import Trajectory, downsample

SEED = 1
MOVING_PART = {
    "aloha-pick-banana": "banana",
    "aloha-hang": "hanger",
    "aloha-cup-upright": "cup",
    "aloha-sweep": "dust",
    "aloha-pick-place": "bottle",
}
VISIBLE_PIXELS = 200
REST_SECONDS = 15.0
AT_REST_M, AT_REST_TURN = 0.00025, 0.0025
HOLD_SECONDS, SLIP_M = 5.0, 0.002


@pytest.fixture(scope="module", params=MOVING_PART)
def task(request):
    task = make_task(request.param)
    yield task
    task.close()


@pytest.fixture(scope="module")
def attempt(task):
    return task.demonstrate(SEED)


@pytest.fixture(scope="module")
def banana():
    task = make_task("aloha-pick-banana")
    yield task
    task.close()


@pytest.fixture(scope="module")
def banana_trajectory(banana):
    return banana.demonstrate(SEED).demonstration.trajectory


def test_the_demonstrator_succeeds_and_its_recording_replays_at_one_hertz(task, attempt):
    assert attempt.success, attempt.failure
    assert attempt.demonstration.rate_hz == 10.0
    assert 4.0 < attempt.demonstration.seconds < 20.0
    task.reset(SEED)
    execution = task.execute(downsample(attempt.demonstration.trajectory, "masked"))
    assert execution.success, execution.failure
    assert execution.seconds > 29.0
    assert execution.tracking_error < 0.03


def test_the_same_seed_gives_the_same_recording_bit_by_bit(task, attempt):
    again, first = task.demonstrate(SEED).demonstration, attempt.demonstration
    np.testing.assert_array_equal(again.observation.rgb, first.observation.rgb)
    np.testing.assert_array_equal(again.observation.depth, first.observation.depth)
    np.testing.assert_array_equal(again.trajectory.actions, first.trajectory.actions)


def test_the_camera_sees_the_part_that_moves_and_no_robot(task):
    for seed in range(100_000, 100_002):
        task.reset(seed)
        truth = task.scene_truth()
        part = truth.names.index(MOVING_PART[task.name])
        assert (truth.parts == part).sum() > VISIBLE_PIXELS
        assert not any("vx300s" in truth.names[index] for index in np.unique(truth.parts) if index >= 0)


def test_objects_at_rest_stay_at_rest(task):
    task.reset(5)
    before = task.scene_truth().poses
    stay(task, REST_SECONDS)
    after = task.scene_truth().poses
    assert np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1).max() < AT_REST_M
    assert np.abs(after[:, :3, :3] - before[:, :3, :3]).max() < AT_REST_TURN


def stay(task, seconds: float, command: np.ndarray | None = None) -> None:
    """Let time pass with the arms at home, or where ``command`` says."""
    command = Motion.at_home(task._arms).commands[0] if command is None else command
    for _ in range(int(seconds * task._timing.control_hz)):
        task._cell.advance(command)


def test_what_was_grasped_does_not_slip(banana):
    attempt = banana.demonstrate(SEED)
    cell = banana._cell
    command = cell.measured()
    command[-1] = 0.0
    held = invert_pose(cell.tool_poses()[0]) @ cell.middle()
    stay(banana, HOLD_SECONDS, command)
    assert attempt.success
    assert not cell.failure()
    np.testing.assert_allclose(invert_pose(cell.tool_poses()[0]) @ cell.middle(), held, atol=SLIP_M)


@pytest.mark.parametrize("name", ["aloha-sweep", "aloha-pick-place"])
def test_unseen_objects_are_other_objects_and_can_be_used_as_well(name):
    task = make_task(name, objects="unseen")
    try:
        attempt = task.demonstrate(SEED)
        assert attempt.success, attempt.failure
    finally:
        task.close()
    task = make_task(name)
    try:
        assert not np.array_equal(task.reset(SEED).rgb, attempt.demonstration.observation.rgb)
    finally:
        task.close()


def test_doing_nothing_fails_in_words(task, attempt):
    task.reset(SEED)
    first = attempt.demonstration.trajectory.actions[:1]
    execution = task.execute(Trajectory.from_actions(np.repeat(first, 3, axis=0)))
    assert not execution.success
    assert len(execution.failure) > 10


def test_depth_and_calibration_put_the_banana_where_it_is(banana):
    observation = banana.reset(11)
    truth = banana.scene_truth()
    part = truth.names.index("banana")
    rows, columns = np.nonzero(truth.parts == part)
    pixels = np.stack([columns, rows], axis=1)
    points = lift(pixels, observation.depth[rows, columns], observation.intrinsics, observation.camera_pose)
    local = transform_points(invert_pose(truth.poses[part]), points)
    assert np.abs(local[:, 2]).max() < 0.025  # of its own thickness
    assert np.percentile(local[:, 2], 95) > 0.010
    table = lift([[320, 10]], observation.depth[10, 320][None], observation.intrinsics, observation.camera_pose)
    np.testing.assert_allclose(table[0, 2], 0.0, atol=0.001)


@pytest.mark.parametrize(
    ("offset", "words"), [((0.9, 0.0, 0.0), "cannot reach"), ((0.0, 0.0, -0.2), "inside the table")]
)
def test_an_unreachable_step_is_named_before_anything_moves(banana, banana_trajectory, offset, words):
    trajectory = downsample(banana_trajectory)
    banana.reset(SEED)
    before = banana.scene_truth().poses
    actions = trajectory.actions.copy()
    actions[14, :9] += np.tile(offset, 3)
    with pytest.raises(UnreachableError, match=words) as error:
        banana.execute(Trajectory.from_actions(actions))
    assert "step 14" in str(error.value)
    np.testing.assert_array_equal(banana.scene_truth().poses, before)


def test_simulator_and_kinematics_agree_on_the_tools(task):
    task.reset(SEED)
    np.testing.assert_allclose(task._cell.tool_poses(), [arm.home_pose for arm in task._arms], atol=2e-3)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_plain_gymnasium_makes_and_steps_the_environments():
    import gymnasium
    from gymnasium.utils.env_checker import check_env

    from robust_instant_policy.tasks.aloha.envs import ENVIRONMENTS

    assert len(ENVIRONMENTS) == len(MOVING_PART)
    for name in ENVIRONMENTS:
        env = gymnasium.make(name, render_mode="rgb_array")
        try:
            observation, _ = env.reset(seed=0)
            assert observation["rgb"].shape == (480, 640, 3)
            _, reward, _, _, info = env.step(env.action_space.sample())
            assert not info["success"]
            assert reward == 0.0
            assert env.render().shape == (360, 480, 3)
        finally:
            env.close()
    check_env(gymnasium.make(name, obs_mode="none").unwrapped, skip_render_check=True)


def renderer(**environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "robust_instant_policy.tasks.aloha.renderer"]
    clean = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    return subprocess.run(command, capture_output=True, text=True, check=False, env={**clean, **environment})


def test_a_renderer_is_chosen_without_a_screen_and_the_users_choice_stands():
    assert renderer().stdout.split(",")[0] in ("egl", "osmesa")
    chosen = renderer(MUJOCO_GL="osmesa")  # which need not be there
    assert chosen.stdout.startswith("osmesa,") or "(osmesa: " in chosen.stderr


def test_without_a_renderer_one_line_says_what_to_install():
    result = renderer(MUJOCO_GL="glfw", DISPLAY="")
    assert result.returncode == 1
    assert "make setup" in result.stderr.strip().splitlines()[-1]
