import numpy as np
import pytest

from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import UsageError
from robust_instant_policy.policies import KeypointContext, Neighbours
from robust_instant_policy.trajectory import downsample


@pytest.fixture(scope="module")
def demonstrations(workbench):
    return load_demonstrations(workbench / "data" / "push-cube")


@pytest.fixture(scope="module")
def context(demonstrations) -> KeypointContext:
    return KeypointContext(features="efficientnet").fit(demonstrations)


def test_in_a_scene_that_was_shown_the_nearest_neighbour_is_what_was_shown(context, demonstrations):
    policy = Neighbours(context, num_queries=1).fit(demonstrations)
    for shown in demonstrations:
        planned = policy.plan(shown.observation).trajectory
        expected = downsample(shown.trajectory)
        assert np.abs(planned.actions[-1] - expected.actions[-1]).max() < 0.005
        closed = [np.argmax(trajectory.gripper_state) for trajectory in (planned, expected)]
        assert np.abs(planned.actions[closed[0]] - expected.actions[closed[1]]).max() < 0.005


def test_neighbours_are_aggregated_like_samples(context, demonstrations, workbench):
    plan = Neighbours(context, num_queries=4).fit(demonstrations).plan(Observation.load(workbench / "observation.npz"))
    assert len(plan.candidates) == 4
    assert plan.weights.shape == (4, len(plan.trajectory))
    assert plan.confidence is not None
    assert [stage.name for stage in plan.usage.stages] == ["keypoints", "neighbours", "regression"]
    assert plan.usage.tokens == 0


def test_what_was_seen_is_not_looked_at_again(context, demonstrations, workbench):
    keypoints, observation = context.keypoints_, Observation.load(workbench / "observation.npz")
    located, _ = context.locate(observation)
    assert context.fit(list(demonstrations)).keypoints_ is keypoints
    assert context.locate(observation)[0] is located


def test_a_context_that_was_fitted_to_other_demonstrations_since_is_refused(demonstrations, workbench):
    shared, seen = KeypointContext(), Observation.load(workbench / "observation.npz")
    policy = Neighbours(shared).fit(demonstrations)
    Neighbours(shared).fit(demonstrations[:2])
    with pytest.raises(UsageError, match="fit again"):
        policy.plan(seen)
    policy.fit(demonstrations).plan(seen)


def test_planning_before_fitting_is_refused(workbench):
    with pytest.raises(UsageError, match="fit"):
        Neighbours(KeypointContext()).plan(Observation.load(workbench / "observation.npz"))
