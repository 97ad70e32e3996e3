import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robust_instant_policy import Observation, Trajectory
from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.geometry import GripperTriangle, fit_rigid, lift, make_pose, project
from robust_instant_policy.trajectory import STATE_INDEX, downsample, masked_steps, uniform_steps

TRIANGLE = GripperTriangle(length=0.12, opening=0.05)


def rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else q[:, [1, 0, 2]]


def grasping(length: int, changes: list[int]) -> Trajectory:
    actions = np.zeros((length, 10))
    actions[:, 0] = np.arange(length)
    for change in changes:
        actions[change:, STATE_INDEX] = 1 - actions[change:, STATE_INDEX]
    return Trajectory.from_actions(actions)


def test_a_pose_comes_back_from_its_triplet():
    poses = np.stack([make_pose(rotation(seed), [0.1 * seed, -0.2, 0.3]) for seed in range(20)])
    np.testing.assert_allclose(TRIANGLE.poses(TRIANGLE.triplets(poses)), poses, atol=1e-12)


def test_a_noisy_triplet_still_gives_a_proper_rotation_and_the_grippers_own_lengths():
    noisy = TRIANGLE.triplets(make_pose(rotation(1), [0, 0, 0])) + np.random.default_rng(0).normal(0, 0.01, (50, 3, 3))
    poses = TRIANGLE.poses(noisy)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0)
    refitted = GripperTriangle.from_triplets(TRIANGLE.triplets(poses))
    assert (refitted.length, refitted.opening) == pytest.approx((TRIANGLE.length, TRIANGLE.opening))


def test_a_mirrored_point_set_is_not_fitted_by_a_reflection():
    points = np.random.default_rng(0).normal(size=(10, 3))
    assert np.linalg.det(fit_rigid(points, points * [-1, 1, 1])[:3, :3]) == pytest.approx(1.0)


def test_a_gripper_without_extent_is_refused():
    with pytest.raises(InvalidValueError, match="three distinct points"):
        GripperTriangle.from_triplets(np.zeros((4, 3, 3)))


def test_pixels_lift_to_the_points_they_were_projected_from():
    intrinsics = np.array([[300.0, 0, 128], [0, 310.0, 127], [0, 0, 1]])
    camera = make_pose(rotation(3), [0.2, 0.1, 1.0])
    local = np.random.default_rng(1).uniform([-0.3, -0.3, 0.5], [0.3, 0.3, 1.5], (40, 3))
    world = local @ camera[:3, :3].T + camera[:3, 3]
    np.testing.assert_allclose(lift(project(world, intrinsics, camera), local[:, 2], intrinsics, camera), world)


@given(
    length=st.integers(2, 400),
    target=st.integers(2, 60),
    changes=st.lists(st.integers(1, 399), max_size=6, unique=True),
)
def test_masked_downsampling_keeps_ends_and_both_sides_of_every_gripper_change(length, target, changes):
    trajectory = grasping(length, [change for change in changes if change < length])
    steps = masked_steps(trajectory, target)
    state = trajectory.gripper_state[:, 0]
    changed = np.flatnonzero(np.diff(state))
    kept = {0, length - 1, *changed, *(changed + 1)}
    assert kept <= set(steps.tolist())
    assert len(steps) <= max(target, len(kept))
    if length > target:
        assert len(steps) >= min(target, len(kept))
    assert (np.diff(steps) > 0).all()


def test_a_grasp_that_is_measured_as_it_closes_is_kept_too():
    actions = np.random.default_rng(0).normal(size=(200, 10))
    actions[:, STATE_INDEX] = np.clip((np.arange(200) - 150) / 4, 0, 1)
    assert {152, 153} <= set(masked_steps(Trajectory.from_actions(actions)))


def test_downsampling_reaches_the_paper_length():
    trajectory = grasping(330, [100, 250])
    assert len(masked_steps(trajectory)) == 30
    assert len(uniform_steps(trajectory)) == 30


def test_uniform_downsampling_can_lose_the_moment_of_the_grasp_and_masked_cannot():
    trajectory = grasping(300, [104, 112])
    assert downsample(trajectory, "uniform").gripper_state.max() == 0
    assert downsample(trajectory, "masked").gripper_state.max() == 1


def test_the_gripper_state_is_held_between_steps():
    trajectory = grasping(3, [1])
    assert trajectory.resampled([0.0, 0.49, 0.5, 1.0]).gripper_state[:, 0].tolist() == [0, 0, 1, 1]


def test_two_arms_are_two_triplets():
    actions = np.arange(60.0).reshape(3, 20)
    actions[:, STATE_INDEX::10] = [[0, 1], [1, 0.5], [1, 0]]
    trajectory = Trajectory.from_actions(actions)
    assert trajectory.num_arms == 2
    assert trajectory.triplets[0, 1].ravel().tolist() == list(range(10, 19))
    assert trajectory.gripper_state.tolist() == [[0, 1], [1, 0.5], [1, 0]]


def test_the_poses_of_two_arms_stand_side_by_side():
    poses = np.stack([make_pose(rotation(seed), [0.1 * seed, -0.2, 0.3]) for seed in range(6)]).reshape(3, 2, 4, 4)
    states = np.array([[0, 0], [0, 1], [1, 1]])
    both = Trajectory.from_poses(poses, states, TRIANGLE)
    alone = [Trajectory.from_poses(poses[:, arm], states[:, arm], TRIANGLE) for arm in (0, 1)]
    np.testing.assert_array_equal(both.actions, np.concatenate([one.actions for one in alone], axis=1))


@pytest.mark.parametrize(
    ("actions", "times", "words"),
    [
        (np.zeros((3, 9)), None, r"\(3, 9\)"),
        (np.zeros((0, 10)), None, r"\(0, 10\)"),
        (np.full((3, 10), np.nan), None, "not finite"),
        (np.zeros((2, 10)), [0.0, 0.0], "increase"),
        (np.zeros((2, 10)), [0.0, 1.5], "increase"),
        (np.zeros((2, 10)), [0.0], r"\(2,\)"),
        (np.full((2, 10), 255.0), None, "0 .open. to 1 .closed."),
        (np.full((2, 10), -1.0), None, "0 .open. to 1 .closed."),
        ([["0"] * 10], None, "numbers"),
        ([[0.0] * 10, [0.0] * 9], None, "numbers"),
        (np.zeros((2, 10)) + 1j, None, "numbers"),
    ],
)
def test_a_trajectory_that_breaks_its_contract_is_refused(actions, times, words):
    with pytest.raises(InvalidValueError, match=words):
        Trajectory.from_actions(actions) if times is None else Trajectory(actions, times)


def test_a_trajectory_cannot_be_changed_by_accident():
    trajectory = grasping(3, [])
    with pytest.raises(ValueError, match="read-only"):
        trajectory.actions[0, 0] = 1.0


@pytest.mark.parametrize("focal", [1e-300, 0.1, 1e6, 1e300])
def test_focal_lengths_that_are_not_in_pixels_are_refused_in_a_short_line(focal):
    intrinsics = np.array([[focal, 0, 32], [0, 90, 32], [0, 0, 1]])
    with pytest.raises(InvalidValueError, match="must be in pixels") as told:
        Observation(np.zeros((64, 64, 3), np.uint8), np.ones((64, 64)), intrinsics, np.eye(4))
    assert len(str(told.value)) < 200
