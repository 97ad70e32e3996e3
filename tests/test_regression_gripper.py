"""The robust gripper is rigid, opens and closes cleanly, and says what it thinks of its candidates."""

from __future__ import annotations

import numpy as np
import pytest

from robust_instant_policy.context.alignment import align
from robust_instant_policy.errors import InvalidValueError, UnknownNameError
from robust_instant_policy.geometry import GripperTriangle
from robust_instant_policy.regression import robust_gripper_trajectory
from robust_instant_policy.trajectory import Trajectory
from tests.regression_scenes import KINDS, draw_modes, draw_scene


def lengths(actions):
    palm, left, right = np.moveaxis(actions[:, :9].reshape(-1, 3, 3), 1, 0)
    return np.linalg.norm((left + right) / 2 - palm, axis=1), np.linalg.norm(left - right, axis=1)


@pytest.mark.parametrize("estimator", ["em", "em-number", "mixture", "median", "mean"])
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
    scene = draw_scene(1, "smooth", 5, 0)
    candidates = np.stack([candidate[:12] for candidate in scene.candidates])
    candidates[:, :, 9] = 0
    candidates[:, 6, 9] = 1
    assert not robust_gripper_trajectory(candidates).actions[:, 9].any()
    candidates[:, 3:9, 9] = 1
    candidates[:2, 5, 9] = 0
    assert np.flatnonzero(robust_gripper_trajectory(candidates).actions[:, 9]).tolist() == list(range(3, 9))


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
    with pytest.raises(
        UnknownNameError, match="em, em-number, network-sim, network-real, network, mixture, median, mean"
    ):
        robust_gripper_trajectory(good, estimator="mode")
    with pytest.raises(InvalidValueError, match=r"\(T_q, 10·A\).*9"):
        robust_gripper_trajectory([c[:, :9] for c in good])


@pytest.mark.parametrize(
    ("argument", "values"),
    [
        ("num_steps", [0, -3, 2.5, "5", np.nan, True, [3]]),
        ("tolerance", [0, -0.01, np.nan, np.inf, "0.015", True, None, [0.01]]),
        ("seed", [-1, 1.5, "1", np.nan, True, None]),
        ("triangle", [(0.1, 0.08), "gripper"]),
        ("curvature", ["ab", [0.1], [-0.1, 0.1]]),
        ("variation", ["ab", ["0.1"], [True]]),
    ],
)
def test_a_value_of_the_wrong_kind_is_refused_by_name(argument, values):
    good = draw_scene(0, "smooth", 3, 0).candidates
    for value in values:
        with pytest.raises(InvalidValueError, match=f"^{argument} [^\n]*$"):
            robust_gripper_trajectory(good, **{argument: value})


@pytest.mark.parametrize("noise", [0.0, 0.002])
@pytest.mark.parametrize("counts", [(1, 1), (2, 2), (3, 3), (2, 2, 1), (3, 3, 1), (2, 2, 2)])
@pytest.mark.parametrize("estimator", ["em", "mixture"])
def test_an_even_tie_of_candidates_is_low_confidence_and_not_weights_of_1(estimator, counts, noise):
    rng = np.random.default_rng(0)
    scene = draw_scene(0, "smooth", 5, 0)
    candidates = []
    for place, count in zip(np.eye(3), counts, strict=False):
        for _ in range(count):
            actions = scene.truth(scene.times)
            actions[:, :9] += np.tile(0.1 * place, 3) + rng.normal(0, noise, (len(actions), 9))
            candidates.append(actions)
    result = robust_gripper_trajectory(candidates, estimator=estimator)
    assert result.confidence < 0.1
    assert result.weights.max() <= 0.5


def test_a_majority_is_no_tie():
    for kind in KINDS:
        scene = draw_scene(7, "smooth", 5, 2, kind)
        result = robust_gripper_trajectory(scene.candidates)
        assert result.weights[~scene.hallucinated].max() > 0.8
        assert result.confidence > 0


def test_a_trajectory_of_one_step_has_no_curvature_and_yet_a_plan():
    step = GripperTriangle(length=0.1, opening=0.08).triplets(np.eye(4)[None]).reshape(1, 9)
    actions = np.concatenate([step, [[1.0]]], axis=1)
    curvature = align([Trajectory.from_actions(actions)]).curvature()
    fit = robust_gripper_trajectory([actions] * 3, curvature=curvature)
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
def test_a_variation_without_information_is_refused(variation):
    with pytest.raises(InvalidValueError, match="variation"):
        robust_gripper_trajectory(draw_scene(0, "smooth", 3, 0).candidates, variation=variation)
