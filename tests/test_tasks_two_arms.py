"""Tasks of two arms, on aloha-sweep: one clock, one trajectory, and no hand in the other's way."""

from __future__ import annotations

import numpy as np
import pytest

from robust_instant_policy.errors import UnreachableError
from robust_instant_policy.geometry import invert_pose
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.demonstrator import Stroke, perform
from robust_instant_policy.tasks.poses import downward
from robust_instant_policy.trajectory import ACTION_DIM, Trajectory, downsample
from tests.test_tasks_aloha import stay
from tests.test_tasks_follow import Replay

SEED = 1
LEFT, RIGHT = slice(0, ACTION_DIM), slice(ACTION_DIM, 2 * ACTION_DIM)
HOLD_SECONDS, SLIP_M = 5.0, 0.002


@pytest.fixture(scope="module")
def task():
    task = make_task("aloha-sweep")
    yield task
    task.close()


@pytest.fixture(scope="module")
def attempt_and_pan(task):
    """A demonstration, and the pose ``(4, 4)`` of the pan in the hand at its end and after a pause."""
    attempt, cell = task.demonstrate(SEED), task._cell
    command = cell.measured()
    command[[6, 13]] = 0.0

    def held() -> np.ndarray:
        assert cell.is_held("dustpan", "right")
        assert not cell.failure()
        return invert_pose(cell.tool_poses()[1]) @ cell.pose_of("dustpan")

    before = held()
    stay(task, HOLD_SECONDS, command)
    return attempt, before, held()


@pytest.fixture(scope="module")
def attempt(attempt_and_pan):
    return attempt_and_pan[0]


@pytest.fixture(scope="module")
def trajectory(attempt):
    return downsample(attempt.demonstration.trajectory)


def test_both_hands_work_at_the_same_time_and_are_named_in_the_order_of_the_columns(task, attempt):
    assert attempt.success, attempt.failure
    assert task.end_effectors == ("left", "right")
    palms = attempt.demonstration.trajectory.triplets[:, :, 0]
    assert palms[0, 0, 0] < palms[0, 1, 0]  # x points from the left arm to the right one
    moving = np.linalg.norm(np.diff(palms, axis=0), axis=-1) * attempt.demonstration.rate_hz > 0.05
    assert moving.all(axis=1).sum() > 10


def test_a_held_pan_does_not_slip(attempt_and_pan):
    _, before, after = attempt_and_pan
    np.testing.assert_allclose(after[:3, 3], before[:3, 3], atol=SLIP_M)


def test_a_recording_followed_in_closed_loop_moves_both_hands(task, attempt):
    task.reset(SEED)
    recording = attempt.demonstration
    replay = Replay(recording.trajectory.actions, recording.rate_hz, chunk=16)
    execution = task.follow(replay, max_seconds=30)
    assert execution.success, execution.failure
    for arm in (LEFT, RIGHT):
        arrived = recording.trajectory.actions[2 * replay.chunk - 1, arm]
        assert np.abs(replay.seen[2][arm] - arrived).max() < 0.02


@pytest.mark.parametrize(("arm", "name"), [(LEFT, "left"), (RIGHT, "right")])
def test_what_is_refused_names_the_arm(task, trajectory, arm, name):
    task.reset(SEED)
    actions = trajectory.actions.copy()
    actions[14, arm][[2, 5, 8]] -= 0.2
    with pytest.raises(UnreachableError, match=f"step 14 .* the {name} gripper for fingertips .* inside the table"):
        task.execute(Trajectory.from_actions(actions))


def test_hands_that_would_meet_are_refused_before_anything_moves(task, trajectory):
    task.reset(SEED)
    before = task.scene_truth().poses
    actions = trajectory.actions.copy()
    actions[20, RIGHT][:9] = actions[20, LEFT][:9]
    with pytest.raises(UnreachableError, match="mm from the right one"):
        task.execute(Trajectory.from_actions(actions))
    np.testing.assert_array_equal(task.scene_truth().poses, before)


def test_a_trajectory_for_one_arm_is_no_trajectory_for_two(task, trajectory):
    task.reset(SEED)
    with pytest.raises(UnreachableError, match="for 1 grippers, this task has left and right"):
        task.execute(Trajectory.from_actions(trajectory.actions[:, LEFT]))


def test_a_stroke_that_waits_begins_when_the_other_hand_is_done():
    starts = np.stack([downward(-0.3, 0.0, 0.2), downward(0.3, 0.0, 0.2)])
    there = [downward(-0.2, 0.1, 0.1)[None], downward(0.2, 0.1, 0.1)[None]]
    for waits in (False, True):
        strokes = [Stroke(there[1], closed=True, arm=1), Stroke(there[0], closed=True, waits=waits)]
        poses, closed = perform(starts, strokes, np.random.default_rng(0), rate_hz=50.0)
        assert poses.shape == (len(closed), 2, 4, 4)
        shut = closed.argmax(axis=0)
        begun = np.argmax(np.linalg.norm(poses[:, 0, :3, 3] - starts[0, :3, 3], axis=1) > 0.01)
        assert (begun > shut[1]) == waits
        assert closed[-1].all()
