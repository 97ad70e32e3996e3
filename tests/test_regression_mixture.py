"""Several good ways stay several; one way stays one."""

from __future__ import annotations

import numpy as np
import pytest

from robust_instant_policy.regression import StudentTMixture
from tests.regression_scenes import KINDS, draw_modes, draw_scene

POINTS = np.zeros(9)


def fit(scene):
    return StudentTMixture(groups=POINTS).fit([candidate[:, :9] for candidate in scene.candidates])


def distance(one, other):
    return np.linalg.norm((one - other).reshape(len(one), 3, 3), axis=-1).mean(axis=1)


@pytest.mark.parametrize("style", ["smooth", "piecewise"])
@pytest.mark.parametrize("sizes", [(3, 2), (5, 5), (4, 3, 3)])
def test_the_result_is_one_coherent_way(style, sizes):
    coherent, largest, counted = [], [], []
    for seed in range(25):
        scene = draw_modes(seed, style, sizes)
        mixture = fit(scene)
        ways = [way(scene.times)[:, :9] for way in scene.ways]
        errors = [distance(mixture.mean(scene.times), way).max() for way in ways]
        chosen = int(np.argmin(errors))
        apart = min(distance(ways[chosen], way).max() for k, way in enumerate(ways) if k != chosen)
        coherent.append(errors[chosen] < 0.25 * apart)
        largest.append(sizes[chosen] == max(sizes))
        counted.append(mixture.num_modes == len(sizes))
    assert np.mean(coherent) >= 0.96
    assert np.mean(largest) >= 0.96
    assert np.mean(counted) >= 0.92


@pytest.mark.parametrize("style", ["smooth", "piecewise"])
@pytest.mark.parametrize("num", [2, 3, 5, 10])
def test_one_way_is_not_split(style, num):
    assert all(fit(draw_modes(seed, style, (num,))).num_modes == 1 for seed in range(20))


@pytest.mark.parametrize("kind", KINDS)
def test_a_hallucinated_candidate_is_not_a_way(kind):
    for seed in range(4):
        mixture = fit(draw_scene(seed, "smooth", 5, 1, kind))
        assert mixture.num_modes == 1


def test_other_ways_are_kept_with_their_members():
    scene = draw_modes(1, "smooth", (3, 2))
    mixture = fit(scene)
    assert mixture.num_modes == len(mixture.modes) == 2
    assert mixture.support.tolist() == [0.6, 0.4]
    assert (mixture.labels == scene.modes).all()
    other = scene.ways[1](scene.times)[:, :9]
    assert distance(mixture.modes[1].mean(scene.times), other).max() < 0.02
    for label, weight in zip(mixture.labels, mixture.weights, strict=True):
        assert (weight == 0).all() == (label == 1)


def test_order_does_not_choose_between_equal_ways():
    scene = draw_modes(2, "smooth", (5, 5))
    mixture = fit(scene)
    backwards = StudentTMixture(groups=POINTS).fit([candidate[:, :9] for candidate in scene.candidates[::-1]])
    assert np.allclose(mixture.mean(), backwards.mean(), atol=1e-6)


def test_ways_that_part_in_one_dimension_of_many_still_ones_are_found():
    rng = np.random.default_rng(0)
    truth = np.column_stack([np.linspace(0, 0.4, 30), np.zeros((30, 5)), np.full((30, 3), 0.1)])
    side = np.outer(np.sin(np.linspace(0, np.pi, 30)), np.eye(9)[1]) * 0.1
    candidates = [truth + sign * side + rng.normal(0, 0.003, truth.shape) for sign in (1, -1, 1, 1, -1)]
    mixture = StudentTMixture().fit(candidates)
    assert mixture.labels.tolist() == [0, 1, 0, 0, 1]
    assert np.abs(mixture.mean() - truth - side).max() < 0.015
