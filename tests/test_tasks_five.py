"""The simulated tasks of the UR5e cell: their objects, demonstrators and rules."""

from __future__ import annotations

import numpy as np
import pytest

from robust_instant_policy.errors import UnknownNameError
from robust_instant_policy.tasks import make_task
from robust_instant_policy.trajectory import Trajectory, downsample

SEEDS = (0, 1)
MOVING_PART = {
    "pick-banana": "banana",
    "push-cube": "cube",
    "open-drawer": "drawer",
    "close-cabinet": "door",
    "turn-faucet": "lever",
    "push-cube-anywhere": "cube",
    "stack": "cube",
    "wipe": "bar",
    "sort": "first block",
}
ENVIRONMENTS = (
    "RIP-PickBanana-v1", "RIP-PushCube-v1", "RIP-OpenDrawer-v1", "RIP-CloseCabinet-v1", "RIP-TurnFaucet-v1",
    "RIP-PushCubeAnywhere-v1", "RIP-Stack-v1", "RIP-Wipe-v1", "RIP-Sort-v1",
)  # fmt: skip
VISIBLE_PIXELS = 25
ONE_SET = ("pick-banana", "push-cube", "open-drawer")  # of objects


@pytest.fixture(scope="module", params=MOVING_PART)
def task(request):
    task = make_task(request.param)
    yield task
    task.close()


@pytest.fixture(scope="module")
def attempts(task):
    return {seed: task.demonstrate(seed) for seed in SEEDS}


def test_the_demonstrator_succeeds_and_its_recording_replays(task, attempts):
    for attempt in attempts.values():
        assert attempt.success, attempt.failure
    task.reset(SEEDS[-1])
    execution = task.execute(downsample(attempts[SEEDS[-1]].demonstration.trajectory, "masked"))
    assert execution.success, execution.failure


def test_no_two_episodes_are_performed_alike(attempts):
    seconds = [attempt.demonstration.seconds for attempt in attempts.values()]
    assert all(3.0 < each < 14.0 for each in seconds)
    assert seconds[0] != seconds[1]


def test_the_same_seed_rebuilds_the_same_object_and_episode(task, attempts):
    again = task.demonstrate(SEEDS[0]).demonstration
    first = attempts[SEEDS[0]].demonstration
    np.testing.assert_array_equal(again.observation.rgb, first.observation.rgb)
    np.testing.assert_array_equal(again.observation.depth, first.observation.depth)
    np.testing.assert_array_equal(again.trajectory.actions, first.trajectory.actions)


def test_the_camera_sees_the_part_that_moves_and_no_robot(task):
    for seed in range(100_000, 100_006):
        task.reset(seed)
        truth = task.scene_truth()
        part = next(index for index, name in enumerate(truth.names) if name.endswith(MOVING_PART[task.name]))
        assert (truth.parts == part).sum() > VISIBLE_PIXELS
        assert not any("ur5e" in truth.names[index] for index in np.unique(truth.parts) if index >= 0)


def test_doing_nothing_fails_in_words(task, attempts):
    task.reset(SEEDS[0])
    first = attempts[SEEDS[0]].demonstration.trajectory.actions[:1]
    execution = task.execute(Trajectory.from_actions(np.repeat(first, 3, axis=0)))
    assert not execution.success
    assert len(execution.failure) > 10


def test_unseen_objects_are_other_objects_and_can_be_used_as_well(task, attempts):
    if task.name in ONE_SET:
        with pytest.raises(UnknownNameError, match="known: seen"):
            make_task(task.name, objects="unseen")
        return
    other = make_task(task.name, objects="unseen")
    try:
        attempt = other.demonstrate(SEEDS[0])
        assert attempt.success, attempt.failure
    finally:
        other.close()
    seen, unseen = (one.demonstration.observation.rgb for one in (attempts[SEEDS[0]], attempt))
    assert not np.array_equal(seen, unseen)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_plain_gymnasium_makes_and_steps_the_environment(environment):
    import gymnasium

    import robust_instant_policy.tasks.maniskill.envs  # noqa: F401

    env = gymnasium.make(environment, obs_mode="rgbd", reward_mode="sparse")
    try:
        observation, _ = env.reset(seed=0)
        assert observation["sensor_data"]["top"]["rgb"].shape[1:] == (256, 256, 3)
        _, reward, _, _, info = env.step(env.action_space.sample())
        assert not bool(info["success"])
        assert float(reward) == 0.0
    finally:
        env.close()
