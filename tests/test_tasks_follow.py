import numpy as np
import pytest

from robust_instant_policy.motion.waypoints import GRIPPER_SECONDS
from robust_instant_policy.tasks import make_task

SEED, EVERY = 3, 5


class Replay:
    """Commands the waypoints of a recording, a few at a time, and remembers what it was shown."""

    def __init__(self, actions, rate_hz, chunk=8):
        self.actions, self.rate_hz, self.chunk = actions, rate_hz, chunk
        self.images, self.seen, self.next = [], [], 0

    def act(self, observation, action):
        self.images.append(observation.rgb)
        self.seen.append(action)
        waypoints = self.actions[self.next : self.next + self.chunk]
        self.next += self.chunk
        return waypoints if len(waypoints) else None


@pytest.fixture(scope="module")
def task():
    task = make_task("push-cube")
    yield task
    task.close()


@pytest.fixture(scope="module")
def attempt(task):
    return task.demonstrate(SEED, with_images=True, every=EVERY)


def test_every_fifth_step_is_kept_and_the_last_one_is_among_them(task, attempt):
    whole = task.demonstrate(SEED).demonstration
    kept = attempt.demonstration
    assert kept.rate_hz == whole.rate_hz / EVERY
    np.testing.assert_array_equal(kept.trajectory.actions[::-1], whole.trajectory.actions[::-1][::EVERY])
    assert len(attempt.images) == len(kept.trajectory)
    assert (attempt.images[0] != attempt.images[-1]).any()


def test_a_recording_followed_in_closed_loop_does_the_task_again(task, attempt):
    task.reset(SEED)
    recording = attempt.demonstration
    replay = Replay(recording.trajectory.actions, recording.rate_hz)
    execution = task.follow(replay, max_seconds=20)
    assert execution.success, execution.failure
    played = len(recording.trajectory) / recording.rate_hz
    assert execution.seconds == pytest.approx(played + GRIPPER_SECONDS, rel=0.05)  # the gripper closes once
    # What is seen on the way is what was seen when recording, and the hand is where it was told to go.
    for index in (1, 3):
        shown, then = replay.images[index].astype(int), attempt.images[index * replay.chunk].astype(int)
        assert np.abs(shown - then).mean() < 2
        arrived = recording.trajectory.actions[index * replay.chunk - 1]
        assert np.abs(replay.seen[index] - arrived).max() < 0.02


def test_the_clock_ends_an_episode(task, attempt):
    task.reset(SEED)
    execution = task.follow(Replay(attempt.demonstration.trajectory.actions, 11.0), max_seconds=1.0)
    assert not execution.success
    assert 1.0 <= execution.seconds < 2.0 + GRIPPER_SECONDS  # the waypoints under way are finished


def test_a_waypoint_that_is_refused_ends_the_episode_and_says_why(task, attempt):
    task.reset(SEED)
    actions = np.array(attempt.demonstration.trajectory.actions)
    actions[8:, [2, 5, 8]] -= 0.5
    execution = task.follow(Replay(actions, 11.0), max_seconds=20)
    assert not execution.success
    assert "inside the table" in execution.failure
    assert "refused after" in execution.failure
