"""What must hold for any candidates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robust_instant_policy.regression import (
    StudentTMixture,
    StudentTNumbers,
    StudentTRegression,
    robust_gripper_trajectory,
)
from robust_instant_policy.regression.candidates import Candidates
from robust_instant_policy.regression.likelihood import evaluate, log_likelihood
from robust_instant_policy.regression.student_t import solve
from tests.regression_scenes import KINDS, draw_scene

SETTINGS = settings(max_examples=25, derandomize=True, suppress_health_check=[HealthCheck.too_slow])


@st.composite
def candidates(draw, min_candidates=1, equal_lengths=False, hallucinated=True):
    """Q noisy copies of a walk, some of them off, of equal or different lengths."""
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    count = draw(st.integers(min_candidates, 7))
    dimension = draw(st.integers(1, 6))
    length = draw(st.integers(1, 20))
    walk = np.cumsum(rng.normal(0, 0.05, (40, dimension)), axis=0)
    result = []
    for _ in range(count):
        steps = length if equal_lengths else length + draw(st.integers(0, 3))
        at = np.linspace(0, 39, steps)
        curve = np.stack([np.interp(at, np.arange(40), column) for column in walk.T], axis=1)
        result.append(curve + rng.normal(0, 0.003, curve.shape))
    if hallucinated and draw(st.booleans()):
        result[0] = result[0] + rng.normal(0, 0.3, dimension)
    return result


AT = np.linspace(0, 1, 17)


def motion_of(array):
    return max(float(np.ptp(np.concatenate(array), axis=0).max()), 1e-3)


@SETTINGS
@given(candidates(), st.randoms(use_true_random=False))
def test_order_of_candidates_does_not_matter(given_candidates, random):
    order = list(range(len(given_candidates)))
    random.shuffle(order)
    one = StudentTRegression().fit(given_candidates)
    other = StudentTRegression().fit([given_candidates[q] for q in order])
    assert np.allclose(one.mean(AT), other.mean(AT), atol=1e-6 * motion_of(given_candidates))
    for place, q in enumerate(order):
        assert np.allclose(one.weights[q], other.weights[place], atol=1e-4)


@SETTINGS
@given(candidates(), st.floats(1e-3, 1e3), st.floats(-100, 100))
def test_scaling_and_shifting_the_input_move_the_output_alike(given_candidates, factor, shift):
    one = StudentTRegression().fit(given_candidates)
    other = StudentTRegression().fit([candidate * factor + shift for candidate in given_candidates])
    tolerance = 1e-5 * motion_of(given_candidates)
    assert np.allclose((other.mean(AT) - shift) / factor, one.mean(AT), atol=tolerance + 1e-12 * abs(shift) / factor)
    if len(given_candidates[0]) > 2:
        assert np.allclose(other.scale(AT) / factor, one.scale(AT), rtol=1e-2, atol=tolerance)


@settings(max_examples=10, derandomize=True)
@given(st.integers(0, 1000), st.sampled_from(list(KINDS)), st.sampled_from(["em", "mixture"]))
def test_rigid_motions_of_the_input_move_the_output_alike(seed, kind, estimator):
    scene = draw_scene(seed, "piecewise", 5, 1, kind)
    rng = np.random.default_rng(seed)
    rotation, shift = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3)

    def moved(actions):
        result = np.array(actions)
        result[:, :9] = (result[:, :9].reshape(-1, 3, 3) @ rotation.T + shift).reshape(-1, 9)
        return result

    one = robust_gripper_trajectory(scene.candidates, estimator=estimator)
    other = robust_gripper_trajectory([moved(candidate) for candidate in scene.candidates], estimator=estimator)
    # the start is a median of coordinates, which turns with the axes only roughly; where it leads to does not
    assert np.allclose(other.actions, moved(one.actions), atol=1e-4)
    assert other.hallucinated.tolist() == one.hallucinated.tolist()


@SETTINGS
@given(candidates(equal_lengths=True))
def test_the_gaussian_ablation_is_the_same_estimator_at_the_end_of_nu(given_candidates):
    gaussian = StudentTRegression(dof=np.inf).fit(given_candidates)
    nearly = StudentTRegression(dof=1e9).fit(given_candidates)
    assert np.allclose(nearly.mean(), gaussian.mean(), atol=1e-4)
    assert np.allclose(nearly.scale(), gaussian.scale(), atol=1e-4)


@SETTINGS
@given(candidates(equal_lengths=True))
def test_the_gaussian_of_every_number_is_the_mean(given_candidates):
    fit = StudentTNumbers(dof=np.inf).fit(given_candidates)
    assert np.allclose(fit.mean(), np.mean(given_candidates, axis=0), atol=1e-9)
    assert all((weight == 1).all() for weight in fit.weights)


@SETTINGS
@given(candidates(min_candidates=4, hallucinated=False), st.integers(0, 3))
def test_a_candidate_moved_to_infinity_changes_nothing(given_candidates, which):
    def fit_with(distance):
        moved = list(given_candidates)
        moved[which] = moved[which] + distance
        return StudentTRegression().fit(moved)

    far, farther = fit_with(1e5), fit_with(1e8)
    assert np.allclose(far.mean(AT), farther.mean(AT), atol=1e-5)
    assert far.weights[which].max() < 1e-3
    rest = [candidate for q, candidate in enumerate(given_candidates) if q != which]
    if len({len(candidate) for candidate in given_candidates}) == 1:
        assert np.abs(far.mean(AT) - StudentTRegression().fit(rest).mean(AT)).max() < 0.01


@settings(max_examples=200, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(
    candidates(),
    st.sampled_from([0.5, 1.5, 5.0, 40.0, np.inf]),
    st.sampled_from([None, 1, 2]),
    st.sampled_from([None, 0.001, 0.1]),
)
def test_every_answer_is_finite_and_the_likelihood_never_falls(given_candidates, dof, num_groups, curvature):
    dimension = given_candidates[0].shape[1]
    groups = None if num_groups is None else np.arange(dimension) * num_groups // dimension
    known = None if curvature is None or num_groups != 1 else [curvature, 2 * curvature]
    fit = StudentTRegression(dof, groups, known).fit(given_candidates)
    assert np.isfinite(fit.mean(AT)).all()
    assert (fit.scale(AT) >= 0).all()
    assert np.isfinite(fit.scale(AT)).all()
    assert (np.diff(fit.log_likelihood) >= 0).all()
    assert fit.converged


@SETTINGS
@given(candidates(min_candidates=3, equal_lengths=True), st.sampled_from([0.5, 1.5, 5.0]))  # of two, the middle
def test_the_fit_is_where_no_small_change_of_the_curve_is_likelier(given_candidates, dof):
    data = Candidates.from_arrays(given_candidates)
    solution = solve(data, dof, np.eye(data.num_dimensions), None)
    problem, fit = solution.problem, solution.fit
    best = log_likelihood(problem, fit)
    rng = np.random.default_rng(0)
    for size in (0.1, 1.0):
        moved = fit.curve + size * np.sqrt(fit.squared_scale) * rng.normal(size=fit.curve.shape)
        assert log_likelihood(problem, evaluate(problem, moved, fit.squared_scale, fit.profile)) < best + 1e-3


@pytest.mark.parametrize("estimator", [StudentTRegression, StudentTMixture])
@pytest.mark.parametrize("dof", [1.5, np.inf])
def test_degenerate_candidates_give_sensible_answers(estimator, dof):
    line = np.stack([np.linspace(0, 0.3, 10), np.full(10, 0.2), np.zeros(10)], axis=1)
    for same in ([line], [line] * 2, [line] * 5):
        fit = estimator(dof).fit(same)
        assert np.allclose(fit.mean(np.linspace(0, 1, 10)), line, atol=1e-9)
        assert fit.scale().max() < 1e-3
        assert np.isfinite(fit.scale()).all()
    between = estimator(dof).fit([line, line + 0.1]).mean(np.linspace(0, 1, 10))
    assert ((between > line - 0.01) & (between < line + 0.11)).all()
    assert np.allclose(estimator(dof).fit([line[:1], line[:1]]).mean(np.array([0.0, 0.5])), line[0])
    assert np.isfinite(estimator(dof).fit([line[:1], line]).mean(AT)).all()


def test_an_outlier_of_a_thousand_kilometres_is_ignored():
    rng = np.random.default_rng(0)
    truth = np.cumsum(rng.normal(0, 0.02, (30, 9)), axis=0)
    candidates = truth + rng.normal(0, 0.003, (5, 30, 9))
    candidates[2, 7, 4] = 1e6
    candidates[3] += 1e6
    for estimator in (StudentTRegression(), StudentTMixture()):
        assert np.abs(estimator.fit(candidates).mean() - truth).max() < 0.015


def test_the_error_of_a_single_candidate_is_unknown():
    fit = StudentTRegression().fit([np.zeros((4, 2))])
    assert np.isinf(fit.standard_error()).all()
