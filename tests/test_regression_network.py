"""The paper's networks: its recipes, seeded, and a faster way to the same loss."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from robust_instant_policy.errors import InvalidValueError, MissingExtraError, UnknownNameError
from robust_instant_policy.regression import StudentTNetwork, robust_gripper_trajectory
from robust_instant_policy.regression.network import RECIPES
from tests.regression_scenes import draw_scene

torch = pytest.importorskip("torch")


@pytest.fixture(scope="module")
def scene():
    return draw_scene(3, "smooth", 5, 1, "offset")


@pytest.fixture(scope="module")
def candidates(scene):
    return [candidate[:, :9] for candidate in scene.candidates]


def test_recipes_are_those_of_the_table():
    assert (RECIPES["sim"].steps, RECIPES["sim"].learning_rate) == (40_000, 1e-2)
    assert (RECIPES["real"].steps, RECIPES["real"].learning_rate) == (100_000, 5e-2)


def test_networks_are_those_of_the_table(candidates):
    fit = StudentTNetwork(recipe="sim", target=np.inf).fit(candidates)
    for network in fit._networks:
        layers = [layer for layer in network if isinstance(layer, torch.nn.Linear)]
        assert [(layer.in_features, layer.out_features) for layer in layers] == [(1, 64), (64, 64), (64, 9)]


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


def test_result_has_the_interface_of_the_regression(candidates, scene):
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


def test_the_estimators_names_say_which_recipe_trains_the_network(monkeypatch, scene):
    trained = []
    monkeypatch.setattr(StudentTNetwork, "_train_fast", lambda *_: trained.append("fast") or 0)
    monkeypatch.setattr(StudentTNetwork, "_train_adam", lambda self, x, y, recipe, g: trained.append(recipe.steps) or 0)
    for estimator in ("network", "network-sim", "network-real"):
        robust_gripper_trajectory(scene.candidates, estimator=estimator)
    assert trained == ["fast", 40_000, 100_000]
