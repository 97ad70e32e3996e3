import numpy as np
import pytest

from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import UsageError
from robust_instant_policy.policies import Neighbours, Plan
from robust_instant_policy.trajectory import downsample


@pytest.fixture(scope="module")
def demonstrations(workbench):
    return load_demonstrations(workbench / "data" / "push-cube")


@pytest.fixture(scope="module")
def policy(context) -> Neighbours:
    return Neighbours(features="efficientnet", num_queries=4).fit_context(context)


def test_in_a_scene_that_was_shown_the_nearest_neighbour_is_what_was_shown(policy, demonstrations):
    nearest = Neighbours(features="efficientnet", num_queries=1).fit_context(policy.context_)
    for shown in demonstrations:
        planned = nearest.plan(shown.observation).trajectory
        expected = downsample(shown.trajectory)
        assert np.abs(planned.actions[-1] - expected.actions[-1]).max() < 0.005
        closed = [np.argmax(trajectory.gripper_state) for trajectory in (planned, expected)]
        assert np.abs(planned.actions[closed[0]] - expected.actions[closed[1]]).max() < 0.005


def test_neighbours_are_aggregated_like_samples(policy, workbench):
    plan = policy.plan(Observation.load(workbench / "observation.npz"))
    assert len(plan.candidates) == 4
    assert plan.weights.shape == (4, len(plan.trajectory))
    assert plan.confidence is not None
    assert [stage.name for stage in plan.usage.stages] == ["keypoints", "neighbours", "regression"]
    assert plan.usage.tokens == 0


def test_neighbours_refuse_a_layout_without_steps_to_transfer(demonstrations, workbench):
    policy = Neighbours(features="efficientnet", layout="sequence").fit(demonstrations)
    with pytest.raises(UsageError, match="factorised"):
        policy.plan(Observation.load(workbench / "observation.npz"))


def test_a_plan_says_in_which_frames_it_was_made_and_keeps_them_in_its_file(policy, workbench, tmp_path):
    plan = policy.plan(Observation.load(workbench / "observation.npz"))
    assert plan.frames[0].first == 0
    assert plan.frames[-1].last == len(plan.trajectory) - 1
    plan.save(tmp_path / "plan.json")
    again = Plan.load(tmp_path / "plan.json")
    assert [frame.words for frame in again.frames] == [frame.words for frame in plan.frames]
    assert np.allclose(again.frames[0].pose, plan.frames[0].pose)
