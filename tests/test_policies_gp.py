import numpy as np
import pytest

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.policies.gp import GaussianProcess, KeypointRegression


def test_a_noisy_linear_law_is_found_and_doubt_grows_away_from_the_data():
    rng = np.random.default_rng(0)
    inputs = rng.uniform(-0.1, 0.1, (30, 6))
    law = rng.normal(size=(6, 40))
    process = GaussianProcess.fitted(inputs, inputs @ law + 0.5 + rng.normal(0, 0.002, (30, 40)))
    new = rng.uniform(-0.1, 0.1, (20, 6))
    mean, deviation = process.predict(new)
    assert np.abs(mean - new @ law - 0.5).max() < 0.02
    assert deviation.max() < 0.02
    assert process.predict(new + 1.0)[1].min() > 2 * deviation.max()


def test_a_curved_law_is_found_too():
    rng = np.random.default_rng(1)
    inputs = rng.uniform(-0.2, 0.2, (80, 2))
    process = GaussianProcess.fitted(inputs, np.sin(10 * inputs))
    new = rng.uniform(-0.15, 0.15, (20, 2))
    assert np.abs(process.predict(new)[0] - np.sin(10 * new)).max() < 0.1


def test_in_scenes_that_were_shown_it_says_about_what_was_shown(context, workbench):
    policy = KeypointRegression(features="efficientnet").fit_context(context)
    for demonstration in context.demonstrations:
        plan = policy.plan(demonstration.observation)
        assert np.abs(plan.trajectory.actions[-1] - demonstration.trajectory.actions[-1]).max() < 0.06
    plan = policy.plan(Observation.load(workbench / "observation.npz"))
    assert plan.scale.shape == plan.trajectory.actions.shape
    assert plan.scale.min() > 0
    assert policy.executions(plan) == (plan.trajectory,)
    assert plan.trajectory.gripper_state[-1] == pytest.approx(1)
