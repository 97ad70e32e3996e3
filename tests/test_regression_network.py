"""The paper's networks: its recipes, seeded, and a faster way to the same loss."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from robust_instant_policy.errors import InvalidValueError, MissingExtraError, UnknownNameError
from robust_instant_policy.regression import StudentTNetwork, network, robust_gripper_trajectory
from tests.regression_scenes import draw_scene

torch = pytest.importorskip("torch")


@pytest.fixture(scope="module")
def scene():
    return draw_scene(3, "smooth", 5, 1, "offset")


@pytest.fixture(scope="module")
def candidates(scene):
    return [candidate[:, :9] for candidate in scene.candidates]


@pytest.mark.parametrize("recipe", ["sim", "real"])
def test_a_seed_gives_the_same_fit_again_and_touches_no_global_state(candidates, recipe):
    torch.manual_seed(1)
    before = torch.random.get_rng_state()
    one = StudentTNetwork(recipe=recipe, seed=4, target=1.2).fit(candidates)
    two = StudentTNetwork(recipe=recipe, seed=4, target=1.2).fit(candidates)
    assert one.num_iterations == two.num_iterations > 1
    assert np.array_equal(one.mean(), two.mean())
    assert torch.equal(before, torch.random.get_rng_state())
    assert not np.array_equal(one.mean(), StudentTNetwork(recipe=recipe, seed=5, target=1.2).fit(candidates).mean())


def test_the_robust_network_beats_the_gaussian_and_the_fast_way_reaches_the_loss_of_the_plain_one(scene, candidates):
    truth = scene.truth(scene.times)[:, :9]
    fast = StudentTNetwork().fit(candidates)
    assert np.abs(fast.mean(scene.times) - truth).mean() < np.abs(np.mean(candidates, axis=0) - truth).mean() / 2
    plain = StudentTNetwork(recipe="sim", target=0.5).fit(candidates)
    assert plain.loss <= 0.5
    assert fast.loss < plain.loss
    assert np.argmin([weight.mean() for weight in fast.weights]) == np.flatnonzero(scene.hallucinated)[0]


def test_result_has_the_interface_of_the_regression(candidates, scene, monkeypatch):
    for steps in ("WARM_STEPS", "QUASI_NEWTON_STEPS"):
        monkeypatch.setattr(network, steps, 50)
    result = robust_gripper_trajectory(scene.candidates, estimator="network")
    assert result.actions.shape == (30, 10)
    assert np.isfinite(result.scale).all()
    again = robust_gripper_trajectory(scene.candidates, estimator="network")
    assert np.array_equal(result.actions, again.actions)


def test_bad_arguments_are_refused():
    with pytest.raises(UnknownNameError, match="sim, real, fast"):
        StudentTNetwork(recipe="slow")
    with pytest.raises(InvalidValueError, match="dof"):
        StudentTNetwork(dof=0)
    with pytest.raises(InvalidValueError, match=r"candidates\[0\].*\(4,\)"):
        StudentTNetwork().fit([np.zeros(4)])


def test_without_torch_the_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingExtraError, match=r"robust-instant-policy\[train\]"):
        StudentTNetwork().fit([np.zeros((4, 2))] * 3)


@pytest.mark.parametrize(("argument", "values"), [("seed", [-1, 1.5, "1", True]), ("target", [np.nan, "0.5", True])])
def test_a_value_of_the_wrong_kind_is_refused_by_name(argument, values):
    for value in values:
        with pytest.raises(InvalidValueError, match=argument):
            StudentTNetwork(**{argument: value})


def test_any_seed_however_large_works(candidates):
    assert np.isfinite(StudentTNetwork(seed=10**30, target=np.inf).fit(candidates).mean()).all()
