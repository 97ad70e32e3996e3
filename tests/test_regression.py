"""The robust trajectory is close to the truth, whatever is among the candidates."""

from __future__ import annotations

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import t as student_t

import robust_instant_policy.regression
from robust_instant_policy.errors import InvalidValueError, UsageError
from robust_instant_policy.regression import (
    StudentTMixture,
    StudentTNetwork,
    StudentTNumbers,
    StudentTRegression,
    diagnose,
    fit_numbers,
    robust_gripper_trajectory,
)
from tests.regression_scenes import KINDS, draw_scene

POINTS = np.zeros(9)  # nine coordinates in metres that share one scale


def points(scene):
    return [candidate[:, :9] for candidate in scene.candidates]


def error(trajectory, truth):
    return np.linalg.norm((trajectory - truth).reshape(len(truth), 3, 3), axis=-1).mean()


def relative_error(scene):
    truth = scene.truth(scene.times)[:, :9]
    fit = StudentTRegression(groups=POINTS).fit(points(scene))
    clean = [c for c, wrong in zip(points(scene), scene.hallucinated, strict=True) if not wrong]
    grids = [np.linspace(0, 1, len(c)) for c in clean]
    resampled = [
        np.stack([np.interp(scene.times, grid, column) for column in c.T], axis=1)
        for grid, c in zip(grids, clean, strict=True)
    ]
    return error(fit.mean(scene.times), truth) / error(np.mean(resampled, axis=0), truth)


@pytest.mark.parametrize(
    ("style", "hallucinated", "limit"),
    [
        ("smooth", 0, 0.95),
        ("smooth", 1, 1.0),
        ("smooth", 2, 1.3),
        ("piecewise", 0, 1.15),
        ("piecewise", 1, 1.2),
        ("piecewise", 2, 1.5),
    ],
)
def test_error_relative_to_the_mean_of_the_clean_candidates(style, hallucinated, limit):
    for kind in KINDS if hallucinated else ["offset"]:
        ratios = [
            relative_error(draw_scene(seed, style, 5, hallucinated, kind)) for seed in range(15 if hallucinated else 45)
        ]
        assert np.median(ratios) <= limit, kind


def test_a_grasp_is_not_blurred():
    scenes = [draw_scene(seed, "piecewise", 5, 1, "offset") for seed in range(15)]
    blurred, oracle = [], []
    for scene in scenes:
        truth = scene.truth(scene.times)
        change = np.flatnonzero(np.diff(truth[:, 9]))
        steps = np.concatenate([change, change + 1])
        fit = StudentTRegression(groups=POINTS).fit(points(scene)).mean(scene.times)
        clean = [c for c, wrong in zip(points(scene), scene.hallucinated, strict=True) if not wrong]
        if len({len(c) for c in clean}) == 1 and len(clean[0]) == len(truth):
            blurred.append(error(fit[steps], truth[steps, :9]))
            oracle.append(error(np.mean(clean, axis=0)[steps], truth[steps, :9]))
    assert np.mean(blurred) < np.mean(oracle)


def test_single_bad_steps_of_every_candidate_are_ignored():
    rng = np.random.default_rng(0)
    scene = draw_scene(4, "piecewise", 5, 0)
    truth = scene.truth(scene.times)[:, :9]
    candidates = truth + rng.normal(0, 0.003, (5, *truth.shape))
    bad = rng.random((5, len(truth))) < 0.3
    candidates[bad] += np.tile(rng.normal(0, 0.06, (bad.sum(), 3)), 3)
    fit = StudentTRegression(groups=POINTS).fit(candidates)
    assert error(fit.mean(), truth) < 0.003
    assert error(np.median(candidates, axis=0), truth) > 0.003
    weights = np.stack(fit.weights)
    assert weights[bad].mean() < 0.1 < 0.7 < weights[~bad].mean()


def test_candidates_of_different_lengths_leave_no_resampling_artefacts():
    rng = np.random.default_rng(1)

    def motion(times):
        return np.stack([np.sin(3 * times), times**2, np.cos(4 * times)], axis=1)

    lengths = [24, 29, 30, 33, 41]
    fit = StudentTRegression().fit([motion(np.linspace(0, 1, n)) + rng.normal(0, 1e-4, (n, 3)) for n in lengths])
    times = np.linspace(0, 1, 50)
    assert np.abs(fit.mean(times) - motion(times)).max() < 3e-3  # what straight pieces between 30 knots leave
    assert [len(weight) for weight in fit.weights] == lengths


def test_candidates_may_have_their_own_times():
    def motion(times):
        return np.stack([times, 1 - times], axis=1)

    times = [np.linspace(0, 1, 10), np.linspace(0, 0.5, 12), np.array([0.0, 0.3, 0.9, 1.0])]
    fit = StudentTRegression().fit([motion(clock) for clock in times], times)
    assert np.allclose(fit.mean(np.array([0.0, 0.25, 1.0])), motion(np.array([0.0, 0.25, 1.0])), atol=1e-3)


@pytest.mark.parametrize("dof", [0.7, 1.5, 5.0, np.inf])
@pytest.mark.parametrize("kind", ["digits", "freeze"])
def test_convergence_is_told(dof, kind):
    for seed in range(4):
        fit = StudentTRegression(dof).fit(points(draw_scene(seed, "piecewise", 5, 2, kind)))
        assert fit.converged
        assert fit.num_iterations == len(fit.log_likelihood) > 1


def test_weights_are_low_where_a_candidate_is_hallucinated():
    scene = draw_scene(2, "smooth", 5, 1, "offset")
    for estimator in (StudentTRegression(), StudentTNumbers()):
        weights = [w.mean() for w in estimator.fit(points(scene)).weights]
        assert np.argmin(weights) == np.flatnonzero(scene.hallucinated)[0]
        assert min(weights) < 0.15
        assert all(0 <= w <= 1 for w in weights)


def test_hallucinated_candidates_are_flagged_and_clean_ones_are_not():
    flagged, wrong, scores = [], [], []
    for style in ("smooth", "piecewise"):
        for kind in KINDS:
            for seed in range(5):
                scene = draw_scene(100 + seed, style, 5, 1 + seed % 2, kind)
                fit = StudentTRegression(groups=POINTS).fit(points(scene))
                verdict = diagnose(fit, points(scene))
                flagged.append(verdict.hallucinated)
                scores.append(verdict.scores)
                wrong.append(scene.hallucinated)
    flagged, wrong, scores = np.concatenate(flagged), np.concatenate(wrong), np.concatenate(scores)
    above = (scores[wrong][:, None] > scores[~wrong]).mean()
    assert above >= 0.98
    assert flagged[~wrong].mean() <= 0.02
    assert flagged[wrong].mean() >= 0.95


def test_diagnosis_names_onset_and_dimensions():
    rng = np.random.default_rng(3)
    truth = np.stack([np.linspace(0, 0.4, 30), np.linspace(0, 0.2, 30) ** 2, np.full(30, 0.1)], axis=1)
    candidates = truth + rng.normal(0, 0.002, (5, 30, 3))
    candidates[3, 12:, 1] += 0.05
    verdict = diagnose(StudentTRegression().fit(candidates), candidates)
    assert verdict.hallucinated.tolist() == [False, False, False, True, False]
    assert verdict.onset.tolist() == [-1, -1, -1, 12, -1]
    assert verdict.dimensions == ((), (), (), (1,), ())


@pytest.mark.parametrize("style", ["smooth", "piecewise"])
@pytest.mark.parametrize(("num", "hallucinated"), [(3, 1), (5, 0), (5, 2), (10, 4)])
def test_intervals_cover_the_truth_as_often_as_they_say(style, num, hallucinated):
    covered = []
    for seed in range(14):
        scene = draw_scene(300 + seed, style, num, hallucinated, list(KINDS)[seed % len(KINDS)])
        low, high = StudentTRegression(groups=POINTS).fit(points(scene)).interval(0.9, scene.times)
        truth = scene.truth(scene.times)[:, :9]
        covered.append(((low <= truth) & (truth <= high)).mean())
    assert 0.82 <= np.mean(covered) <= 0.97  # of few scenes; the benchmark measures it


@pytest.mark.parametrize("num", [3, 5])
def test_scale_and_error_are_those_of_the_noise_with_few_candidates(num):
    rng = np.random.default_rng(0)
    fits = [
        StudentTRegression(np.inf, groups=np.zeros(3)).fit(0.002 * rng.normal(size=(num, 40, 3))) for _ in range(40)
    ]
    assert np.mean([fit.scale() for fit in fits]) == pytest.approx(0.002, rel=0.07)
    told = np.sqrt(np.mean([fit.standard_error() ** 2 for fit in fits]))
    errors = np.sqrt(np.mean([fit.mean() ** 2 for fit in fits]))
    assert told == pytest.approx(errors, rel=0.2)
    assert errors < 0.5 * 0.002 / np.sqrt(num)  # smoothing counts for the Gaussian, too


@pytest.mark.parametrize(
    ("candidates", "message"),
    [
        ([], r"candidates must hold at least one"),
        ([np.zeros((0, 3))], r"candidates\[0\].*\(0, 3\)"),
        ([np.zeros((3, 0))], r"candidates\[0\].*\(3, 0\)"),
        ([np.zeros(4)], r"candidates\[0\].*\(4,\)"),
        ([np.zeros((3, 2)), np.full((3, 2), np.nan)], r"candidates\[1\].*\(3, 2\).*not finite"),
        ([np.zeros((3, 2)), np.zeros((4, 3))], r"one number of dimensions.*\(3, 2\), \(4, 3\)"),
        ([["a", "b"]], r"candidates\[0\] \(T_q, D\) must be an array of numbers"),
        ([[["1", "2"]]], r"candidates\[0\] \(T_q, D\) must be an array of numbers"),
        ([np.ones((3, 2), dtype=bool)], r"candidates\[0\].*bool"),
        ([np.ones((3, 2)) + 0j], r"candidates\[0\].*complex"),
        ([[[1.0], [1.0, 2.0]]], r"candidates\[0\] \(T_q, D\) must be an array of numbers"),
        (3, "candidates must be a list of arrays"),
        ("text", "candidates must hold at least one"),
    ],
)
@pytest.mark.parametrize("estimator", [StudentTRegression, StudentTMixture])
def test_bad_candidates_are_refused_by_name_and_shape(estimator, candidates, message):
    with pytest.raises(InvalidValueError, match=message):
        estimator().fit(candidates)


@pytest.mark.parametrize("dof", [0, -1.5, np.nan, "many", "1", None, True, [1.5], -np.inf, 1 + 0j])
@pytest.mark.parametrize(
    "entry",
    [
        StudentTRegression,
        StudentTMixture,
        StudentTNetwork,
        lambda dof: fit_numbers(np.zeros((3, 4)), dof),
        lambda dof: robust_gripper_trajectory([np.zeros((4, 10))] * 3, dof),
    ],
)
def test_bad_degrees_of_freedom_are_refused_where_they_are_given(entry, dof):
    with pytest.raises(InvalidValueError, match=r"^dof must be a positive number or inf, got [^\n]*$"):
        entry(dof)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([np.zeros(3)], "one array per candidate"),
        ([np.zeros(3), np.zeros(4)], r"times\[0\] must be \(4,\)"),
        ([np.linspace(0, 2, 4)] * 2, r"times\[0\] of shape \(4,\) must increase strictly within \[0, 1\]"),
        ([np.array([0, 0.5, 0.4, 1])] * 2, "increase strictly"),
        ([np.array([0, 0.5, np.nan, 1])] * 2, r"times\[0\].*not finite"),
        ([["0", "0.2", "0.5", "1"]] * 2, r"times\[0\].*numbers"),
        (0.5, "times must be a list"),
    ],
)
def test_bad_times_are_refused_by_name_and_shape(times, message):
    with pytest.raises(InvalidValueError, match=message):
        StudentTRegression().fit([np.zeros((4, 2))] * 2, times)


def test_other_bad_arguments_are_refused():
    with pytest.raises(InvalidValueError, match=r"groups must be \(2,\).*\(3,\)"):
        StudentTRegression(groups=[0, 0, 1]).fit([np.zeros((4, 2))])
    fit = StudentTRegression().fit([np.zeros((4, 2))])
    with pytest.raises(InvalidValueError, match=r"times must be \(T,\)"):
        fit.mean(np.zeros((2, 2)))
    with pytest.raises(InvalidValueError, match="3 dimensions"):
        diagnose(fit, [np.zeros((4, 3))])
    for level in (1.5, 0, np.nan, "0.9", True):
        with pytest.raises(InvalidValueError, match="level"):
            fit.interval(level)
    for groups in ([np.nan, np.nan], [[0], [0, 1]], "ab"):
        with pytest.raises(InvalidValueError, match="groups"):
            StudentTRegression(groups=groups).fit([np.zeros((4, 2))])


@pytest.mark.parametrize("estimator", [StudentTRegression, StudentTMixture, StudentTNetwork])
def test_asking_before_fitting_says_what_to_call(estimator):
    with pytest.raises(UsageError, match=r"call fit\(candidates\)"):
        estimator().mean()


def test_the_benchmark_runs():
    command = [sys.executable, str(Path(__file__).parents[1] / "benchmarks" / "regression.py"), "--quick"]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    for title in ("Smooth truths", "Piecewise truths", "Diagnosis", "Intervals", "Several modes", "Single bad steps"):
        assert title in printed


def test_importing_the_regression_needs_no_torch():
    code = "import robust_instant_policy.regression, sys; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def disagreeing(num_steps=20):
    """A straight way on which five candidates agree, except that at one step none does and two meet far off."""
    truth = np.linspace([0.0, 0.0, 0.3], [0.4, 0.2, 0.1], num_steps)
    candidates = np.tile(truth, (5, 1, 1)) + np.random.default_rng(0).normal(0, 0.001, (5, num_steps, 3))
    candidates[:, 10, 1] += [0.1, 0.1, -0.08, 0.15, -0.12]
    return truth, list(candidates)


def test_where_candidates_disagree_the_curve_goes_on_as_it_may_be_expected_to():
    truth, candidates = disagreeing()
    groups = np.zeros(3)
    jumps = StudentTRegression(groups=groups).fit(candidates)
    straight = StudentTRegression(groups=groups, curvature=np.full(5, 0.02 * (19 / 4) ** 2)).fit(candidates)
    assert np.abs(jumps.mean() - truth)[10].max() > 0.05
    assert np.abs(straight.mean() - truth)[10].max() < 0.015
    assert np.abs(straight.mean() - jumps.mean())[[0, 5, 15, 19]].max() < 0.001
    assert straight.standard_error()[10].max() > 1.5 * straight.standard_error()[5].max()


def test_a_curvature_far_below_the_scatter_gives_a_straight_line_not_a_failure():
    rng = np.random.default_rng(0)
    for lengths in ([20] * 5, [18, 20, 20, 21, 19]):
        candidates = [rng.normal(0, 1e4, (n, 2)) for n in lengths]
        fit = StudentTRegression(groups=np.zeros(2), curvature=[1e-6, 1e-6]).fit(candidates)
        assert np.abs(np.diff(fit.mean(np.linspace(0, 1, 20)), 2, axis=0)).max() < 1


def test_known_curvature_and_smoothing_count_alike_for_the_gaussian():
    _, candidates = disagreeing()
    sharpest = np.abs(np.diff(np.mean(candidates, axis=0), 2, axis=0)).max()
    for known in ({}, {"curvature": [0.001, 0.001]}):
        fit = StudentTRegression(np.inf, groups=np.zeros(3), **known).fit(candidates)
        assert np.abs(np.diff(fit.mean(), 2, axis=0)).max() < 0.7 * sharpest


@pytest.mark.parametrize(
    "curvature", [[0.01], [[0.01, 0.01]], [0.01, 0.0], [0.01, -0.01], [0.01, np.nan], "ab", ["0.1", "0.2"], 0.1]
)
def test_a_curvature_without_information_is_refused(curvature):
    with pytest.raises(InvalidValueError, match=r"^curvature [^\n]*$"):
        StudentTRegression(curvature=curvature)


def test_a_curvature_of_dimensions_in_different_units_is_refused():
    with pytest.raises(InvalidValueError, match="curvature needs groups"):
        StudentTRegression(curvature=[0.01, 0.01]).fit([np.zeros((4, 2))])


@pytest.mark.parametrize("noise", [0.0, 0.002])
@pytest.mark.parametrize("counts", [(2, 2), (3, 3), (2, 2, 1)])
def test_where_groups_of_one_size_disagree_no_weight_is_1(counts, noise):
    rng = np.random.default_rng(0)
    line = np.linspace([0.0, 0.0, 0.3], [0.4, 0.2, 0.1], 20)
    apart = np.linspace(0, 1, 20)[:, None] > 0.5
    places = np.repeat(np.eye(3)[: len(counts)] * 0.1, counts, axis=0)
    fit = StudentTRegression(groups=np.zeros(3)).fit([line + apart * p + rng.normal(0, noise, (20, 3)) for p in places])
    weights = np.stack(fit.weights)
    assert (weights[:, 12:] <= max(counts) / len(places)).all()
    if noise and counts != (2, 2, 1):
        assert weights[:, :8].mean() > 0.6


def test_fit_numbers_minimises_the_papers_loss():
    rng = np.random.default_rng(0)
    actions = rng.normal(0, 0.003, (5, 4)) + np.linspace(0, 0.2, 4)
    actions[2] += 0.5
    fit = fit_numbers(actions, dof=1.5)
    assert np.allclose(fit.mean, np.delete(actions, 2, axis=0).mean(axis=0), atol=0.003)
    assert (fit.weights[2] < 0.01).all()

    def papers_loss(mean, scale):
        return -student_t.logpdf(actions, 1.5, mean, scale).sum()

    least = papers_loss(fit.mean, fit.scale)
    for step in (-1e-4, 1e-4):
        assert papers_loss(fit.mean + step, fit.scale) > least
        assert papers_loss(fit.mean, fit.scale + step) > least


def test_no_module_of_the_regression_imports_itself_in_a_circle():
    folder = Path(robust_instant_policy.regression.__file__).parent
    prefix = "robust_instant_policy.regression."
    imports = {
        path.stem: {
            node.module.removeprefix(prefix)
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(prefix)
        }
        for path in folder.glob("*.py")
    }
    assert list(TopologicalSorter(imports).static_order())[-1] == "__init__"
