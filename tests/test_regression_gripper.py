"""The robust gripper is rigid, opens and closes cleanly, and says what it thinks of its candidates."""

from __future__ import annotations

import numpy as np
import pytest

from robust_instant_policy.context.alignment import align
from robust_instant_policy.errors import InvalidValueError, UnknownNameError
from robust_instant_policy.geometry import GripperTriangle
from robust_instant_policy.regression import robust_gripper_trajectory
from robust_instant_policy.regression.gripper import steady_state
from robust_instant_policy.trajectory import Trajectory
from tests.regression_scenes import KINDS, draw_modes, draw_scene


def lengths(actions):
    palm, left, right = np.moveaxis(actions[:, :9].reshape(-1, 3, 3), 1, 0)
    return np.linalg.norm((left + right) / 2 - palm, axis=1), np.linalg.norm(left - right, axis=1)


@pytest.mark.parametrize("estimator", ["em", "mixture", "median"])
@pytest.mark.parametrize("dof", [1.5, np.inf])
def test_gripper_is_rigid_with_a_clean_state(estimator, dof):
    for kind in KINDS:
        scene = draw_scene(1, "piecewise", 5, 2, kind)
        result = robust_gripper_trajectory(scene.candidates, dof, estimator)
        known = GripperTriangle.from_triplets(np.concatenate(scene.candidates)[:, :9].reshape(-1, 3, 3))
        length, opening = lengths(result.actions)
        assert np.allclose(length, known.length, rtol=0, atol=1e-12)
        assert np.allclose(opening, known.opening, rtol=0, atol=1e-12)
        poses = known.poses(result.actions[:, :9].reshape(-1, 3, 3))
        assert np.allclose(np.linalg.det(poses[:, :3, :3]), 1)
        assert set(np.unique(result.actions[:, 9])) <= {0.0, 1.0}
        assert result.weights.shape == (5, len(result.times))
        assert ((result.weights >= 0) & (result.weights <= 1)).all()
        assert 0 <= result.confidence <= 1


def test_state_changes_are_those_of_the_truth_and_in_order():
    for kind in KINDS:
        for seed in range(5):
            scene = draw_scene(seed, "piecewise", 5, 2, kind)
            result = robust_gripper_trajectory(scene.candidates, num_steps=30)
            truth = scene.truth(scene.times)[:, 9]
            assert np.abs(np.diff(result.actions[:, 9])).sum() == np.abs(np.diff(truth)).sum()
            expected, got = np.flatnonzero(np.diff(truth)), np.flatnonzero(np.diff(result.actions[:, 9]))
            assert np.abs(expected - got).max() <= 1


def test_a_blip_of_one_step_never_moves_the_gripper_but_a_release_does():
    weights = np.ones((5, 12))
    closed = np.zeros((5, 12), dtype=bool)
    closed[:, 6] = True
    assert not steady_state(closed, weights).any()
    closed[:, 3:9] = True
    closed[:2, 5] = False
    assert np.flatnonzero(steady_state(closed, weights)).tolist() == list(range(3, 9))


def test_hallucinated_candidates_are_named_with_onset_dimensions_and_weights():
    scene = draw_scene(3, "piecewise", 5, 1, "drift")
    result = robust_gripper_trajectory(scene.candidates)
    assert result.hallucinated.tolist() == scene.hallucinated.tolist()
    wrong = int(np.flatnonzero(scene.hallucinated)[0])
    assert result.onset[wrong] > 0
    assert (np.delete(result.onset, wrong) == -1).all()
    assert result.dimensions[wrong]
    assert result.weights[wrong, -1] < 0.05 < result.weights[wrong, 0]
    assert result.scores.argmax() == wrong


def test_a_candidate_that_never_closes_the_gripper_is_hallucinated():
    scene = draw_scene(5, "piecewise", 5, 0)
    candidates = [candidate.copy() for candidate in scene.candidates]
    candidates[1][:, 9] = 0
    result = robust_gripper_trajectory(candidates)
    assert result.hallucinated.tolist() == [False, True, False, False, False]
    assert result.dimensions[1] == (9,)
    assert result.actions[:, 9].any()


def test_confidence_falls_when_the_candidates_disagree():
    agreeing = draw_scene(0, "smooth", 5, 0)
    rng = np.random.default_rng(0)
    scattered = [candidate.copy() for candidate in agreeing.candidates]
    for candidate in scattered:
        candidate[:, :9] += np.tile(rng.normal(0, 0.05, 3), 3)
    assert robust_gripper_trajectory(agreeing.candidates).confidence > 0.9
    assert robust_gripper_trajectory(scattered).confidence < 0.5
    assert robust_gripper_trajectory(agreeing.candidates[:1]).confidence == 0


def test_two_arms_are_each_rigid_with_their_own_state():
    scene = draw_scene(0, "piecewise", 5, 1, "offset")
    opposite = [candidate.copy() for candidate in scene.candidates]
    for candidate in opposite:
        candidate[:, 9] = 1 - candidate[:, 9]
    result = robust_gripper_trajectory([np.hstack(arms) for arms in zip(scene.candidates, opposite, strict=True)])
    assert result.actions.shape[1] == result.scale.shape[1] == 20
    assert (result.actions[:, 9] != result.actions[:, 19]).all()
    assert np.ptp(lengths(result.actions[:, 10:])[1]) < 1e-12


def test_one_of_two_ways_is_followed_whole():
    scene = draw_modes(0, "piecewise", (3, 2))
    result = robust_gripper_trajectory(scene.candidates, estimator="mixture")
    chosen, other = (way(result.times)[:, :9] for way in scene.ways)
    assert np.abs(result.actions[:, :9] - chosen).max() < 0.25 * np.abs(other - chosen).max()
    assert not result.hallucinated.any()
    assert (result.weights[scene.modes == 1] == 0).all()


def test_length_of_the_result_can_be_chosen():
    scene = draw_scene(0, "smooth", 5, 0)
    assert len(robust_gripper_trajectory(scene.candidates, num_steps=12).actions) == 12
    ragged = [scene.truth(np.linspace(0, 1, n)) for n in (20, 24, 31)]
    assert len(robust_gripper_trajectory(ragged).actions) == 24
    assert robust_gripper_trajectory([c[:1] for c in ragged]).actions.shape == (1, 10)


def test_bad_arguments_are_refused():
    good = draw_scene(0, "smooth", 3, 0).candidates
    with pytest.raises(UnknownNameError, match="em, network, network-sim, network-real, mixture, median"):
        robust_gripper_trajectory(good, estimator="mean")
    with pytest.raises(InvalidValueError, match=r"\(T_q, 10·A\).*9"):
        robust_gripper_trajectory([c[:, :9] for c in good])
    with pytest.raises(InvalidValueError, match="num_steps"):
        robust_gripper_trajectory(good, num_steps=0)
    with pytest.raises(InvalidValueError, match="dof"):
        robust_gripper_trajectory(good, dof=-1)


def test_a_trajectory_of_one_step_has_no_bends_and_yet_a_plan():
    step = GripperTriangle(length=0.1, opening=0.08).triplets(np.eye(4)[None]).reshape(1, 9)
    actions = np.concatenate([step, [[1.0]]], axis=1)
    bends = align([Trajectory.from_actions(actions)]).usual_bends()
    fit = robust_gripper_trajectory([actions] * 3, bends=bends)
    assert np.allclose(fit.actions, actions)


@pytest.mark.parametrize("estimator", ["em", "mixture"])
def test_a_candidate_that_strays_less_than_demonstrations_differ_is_not_called_hallucinated(estimator):
    scene = draw_scene(0, "smooth", 6, 0)
    free, far = scene.candidates[1].copy(), scene.candidates[4].copy()
    free[4:10, :9] += 0.02
    far[20:26, :9] += 0.02
    candidates = [scene.candidates[0], free, *scene.candidates[2:4], far, scene.candidates[5]]
    variation = np.where(np.arange(30) < 15, 0.04, 0.002)  # a free way first, then a grasp
    known, unknown = (
        robust_gripper_trajectory(candidates, estimator=estimator, variation=v) for v in (variation, None)
    )
    assert np.flatnonzero(unknown.hallucinated).tolist() == [1, 4]
    assert np.flatnonzero(known.hallucinated).tolist() == [4]
    assert (known.actions == unknown.actions).all()
    assert known.confidence == unknown.confidence


@pytest.mark.parametrize("variation", [[], [[0.01]], [0.01, -0.01], [0.01, np.nan]])
def test_a_variation_that_says_nothing_is_refused(variation):
    with pytest.raises(InvalidValueError, match=r"variation must be \(V,\)"):
        robust_gripper_trajectory(draw_scene(0, "smooth", 3, 0).candidates, variation=variation)
