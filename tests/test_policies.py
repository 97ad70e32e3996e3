"""Policies over keypoints, on recorded demonstrations; the promise that RIP succeeds, with the embedded model."""

from dataclasses import replace

import numpy as np
import pytest

import robust_instant_policy as rip
from robust_instant_policy.errors import PlanningError, RipError, UsageError
from robust_instant_policy.evaluation import scene_seed
from robust_instant_policy.llm.model import NOBODY, Tally
from robust_instant_policy.policies import (
    KeypointActionTokens,
    RobustInstantPolicy,
    Settings,
    locate,
)
from robust_instant_policy.policies.confidence import (
    UNKNOWN,
    Evidence,
    distortion,
    novelty,
    plan_confidence,
    prediction,
    recognition,
)
from robust_instant_policy.policies.context import HARDLY_RECOGNISED
from robust_instant_policy.policies.neighbours import Neighbours
from robust_instant_policy.policies.sampling import NO_SAMPLES
from robust_instant_policy.query import Answer
from robust_instant_policy.tasks import make_task

SETTINGS = Settings(features="efficientnet")


class Imitator:
    """Stands in for a language model: answers with the prompt's own examples, or with ``says``; some are ``lost``."""

    name, context_length = "imitator", None

    def __init__(self, lost=(), says=None):
        self.lost, self.says = lost, says
        self.asked: list[int] = []

    def sample(self, queries, sampling, listener=NOBODY):
        self.asked += sampling.indices
        tally = Tally(len(queries), sampling, listener)
        for number, query in enumerate(queries):
            examples = query.text.splitlines()[1:-1:2]
            for index in set(sampling.indices) - set(self.lost):
                tally.add(number, index, Answer(self.says or examples[index % len(examples)]))
        return tally.answers()


@pytest.fixture(scope="module")
def demonstrations(workbench):
    return rip.load_demonstrations(workbench / "data" / "push-cube")


@pytest.fixture(scope="module")
def observation(workbench):
    return rip.Observation.load(workbench / "observation.npz")


@pytest.fixture(scope="module")
def scene(context, observation):
    return locate(context, observation)


def test_only_a_scene_that_lacks_what_was_demonstrated_is_called_hardly_recognised(context, scene, observation):
    assert HARDLY_RECOGNISED not in scene.notes
    left, top = np.rint(scene.located.pixels.min(axis=0)).astype(int) - 12
    right, bottom = np.rint(scene.located.pixels.max(axis=0)).astype(int) + 13
    rgb, depth = observation.rgb.copy(), observation.depth.copy()
    rgb[top:bottom, left:right] = np.median(rgb.reshape(-1, 3), axis=0)
    depth[top:bottom, left:right] = np.nanmedian(depth)
    rgb[20:60, 20:26], depth[20:60, 20:26] = (200, 30, 30), np.nanmedian(depth) - 0.1  # another thing
    located = context.extractor.locate(replace(observation, rgb=rgb, depth=depth))
    extractor = context.extractor
    recognised = recognition(extractor.confidence_, located.confidence, extractor.object_of_)
    missing = replace(scene, located=located, recognition=recognised)
    assert HARDLY_RECOGNISED in missing.notes
    plan = Neighbours(SETTINGS).fit_context(context).plan_scene(missing)
    assert plan.confidence <= UNKNOWN
    assert any("confidence is lowered: the keypoints of a thing lie" in note for note in plan.notes)


def test_a_confidence_that_is_no_number_recognises_nothing():
    assert recognition(np.ones((3, 4)), np.array([np.nan, np.nan, 1.0, 1.0]), np.zeros(4)) == 0.0


@pytest.mark.parametrize("count", [2, 4, 10])
def test_one_hidden_keypoint_is_recognised_and_a_missing_half_is_not(count):
    sure = np.ones((3, count))
    one = np.zeros(count)
    assert recognition(sure, np.array([0.0, *[1.0] * (count - 1)]), one) == 1.0
    assert recognition(sure, np.repeat([0.0, 1.0], [max(2, count // 2), count - max(2, count // 2)]), one) == 0.0


def test_an_object_of_few_keypoints_must_be_recognised_as_well():
    sure, object_of = np.ones((3, 10)), np.repeat([0, 1, 2], [7, 2, 1])
    assert recognition(sure, np.repeat([1.0, 0.1, 1.0], [7, 2, 1]), object_of) < 0.2
    assert recognition(sure, np.repeat([1.0, 0.0, 1.0, 0.0], [7, 1, 1, 1]), object_of) == 1.0  # one of each is hidden


def test_objects_that_demonstrations_recognise_with_little_confidence_may_be_so_in_a_scene():
    sure, unsure = np.full((4, 10), 0.8), np.full((4, 10), 0.4)
    assert recognition(unsure, np.full(10, 0.35), np.zeros(10)) == 1
    assert recognition(sure, np.full(10, 0.35), np.zeros(10)) < 1
    assert recognition(unsure, np.full(10, 0.1), np.zeros(10)) < 0.5
    assert recognition(sure[:1], np.full(10, 0.35), np.zeros(10)) == 1  # nothing to compare with


def test_rip_and_rip_adaptive_succeed_with_the_embedded_model(demonstrations, context, observation):
    llm = rip.connect("embedded")
    try:
        plan = rip.RobustInstantPolicy(llm=llm, num_queries=5, dof=1.5).fit(demonstrations).plan(observation)
        adaptive = RobustInstantPolicy(llm, num_queries=10, adaptive=True).fit_context(context).plan(observation)
    finally:
        llm.close()
    assert len(plan.candidates) == 5
    assert 3 <= len(adaptive.candidates) <= 10
    assert plan.usage.tokens > 0
    task = make_task("push-cube")
    try:
        for one in (plan, adaptive):
            task.reset(scene_seed(0, 0))
            assert task.execute(one.trajectory).success
    finally:
        task.close()


def test_methods_plan_from_the_samples_of_each_other(context, scene):
    llm = Imitator()
    robust, samples = (
        RobustInstantPolicy(llm, SETTINGS, num_queries=4).fit_context(context).plan_from(scene, NO_SAMPLES)
    )
    tokens, _ = KeypointActionTokens(llm, SETTINGS, num_queries=3).fit_context(context).plan_from(scene, samples)
    more, _ = RobustInstantPolicy(llm, SETTINGS, num_queries=5).fit_context(context).plan_from(scene, samples)
    assert llm.asked == [0, 1, 2, 3, 4]
    assert [len(plan.candidates) for plan in (robust, tokens, more)] == [4, 3, 5]
    for one, other in zip(tokens.candidates, more.candidates, strict=False):
        np.testing.assert_array_equal(one.actions, other.actions)
    np.testing.assert_array_equal(tokens.trajectory.actions, tokens.candidates[0].actions)


def test_adaptive_queries_go_on_where_an_answer_is_lost(context, scene):
    llm = Imitator(lost=[1])
    plan = RobustInstantPolicy(llm, SETTINGS, num_queries=6, adaptive=True).fit_context(context).plan_scene(scene)
    assert len(plan.candidates) >= 3
    assert llm.asked[:4] == [0, 1, 2, 3]
    lost = Imitator(lost=[1, 2, 3, 4])
    policy = RobustInstantPolicy(lost, SETTINGS, num_queries=6, adaptive=True).fit_context(context)
    with pytest.raises(PlanningError, match="2 of 6 trajectories"):
        policy.plan_scene(scene)


def test_lost_answers_are_noted(context, scene):
    plan = RobustInstantPolicy(Imitator(lost=[2]), SETTINGS).fit_context(context).plan_scene(scene)
    assert len(plan.candidates) == 4
    assert "4 of 5 answers were usable in time" in plan.notes


def test_it_is_told_where_the_model_was_not_asked(demonstrations):
    llm = Imitator()
    plan = RobustInstantPolicy(llm, SETTINGS).fit([demonstrations[0]] * 3).plan(demonstrations[1].observation)
    assert not llm.asked
    assert any("the language model was not asked" in note for note in plan.notes)


def test_answers_that_cannot_be_read_are_quoted_and_silence_is_called_silence(context, scene):
    with pytest.raises(PlanningError, match=r"I am sorry.*model"):
        RobustInstantPolicy(Imitator(says="I am sorry"), SETTINGS).fit_context(context).plan_scene(scene)
    with pytest.raises(PlanningError, match="give it more time"):
        RobustInstantPolicy(Imitator(lost=range(5)), SETTINGS).fit_context(context).plan_scene(scene)


def test_planning_before_fitting_is_refused(observation):
    with pytest.raises(UsageError, match="fit"):
        RobustInstantPolicy(Imitator()).plan(observation)


@pytest.mark.parametrize(
    "options",
    [
        {"num_queries": "5"},
        {"num_queries": 0},
        {"num_queries": True},
        {"num_steps": 2.5},
        {"workspace": "x"},
        {"num_keypoints": 0},
        {"dof": float("nan")},
        {"dof": "1"},
        {"temperature": -1.0},
        {"frames": "camera"},
        {"layout": "tree"},
        {"downsampling": "random"},
        {"estimator": "mode"},
        {"workspace": [[1, 1, 1], [0, 0, 0]]},
        {"queries": 5},
        {"deadline_s": float("nan")},
    ],
)
def test_a_setting_that_makes_no_sense_is_refused_where_it_is_given(options):
    (name,) = options
    with pytest.raises(RipError, match=name) as caught:
        RobustInstantPolicy(Imitator(), **options)
    assert "\n" not in str(caught.value)


SURE = Evidence(
    agreement=0.9,
    vote=1.0,
    doubled=0,
    carried=0,
    recognition=1.0,
    distortion=0.5,
    frames=0.008,
    prediction=0.008,
    novelty=0.4,
    displacement=0.004,
    precision=0.004,
    doubts=0,
    errors=0,
)


@pytest.mark.parametrize(
    "worse",
    [
        {"agreement": 0.1},
        {"vote": 0.5},
        {"doubled": 1},
        {"carried": 1},
        {"recognition": 0.5},
        {"distortion": 2.9},
        {"frames": np.nan, "prediction": 0.05},
        {"frames": 0.05},
        {"novelty": 4.0},
        {"displacement": 0.04},
        {"doubts": 1},
    ],
    ids=str,
)
def test_confidence_falls_with_everything_that_speaks_against_a_plan(worse):
    assert plan_confidence(SURE) > 0.9
    assert SURE.notes == ()
    assert plan_confidence(replace(SURE, **worse)) < plan_confidence(SURE) - 0.01


def test_a_tie_or_an_error_of_a_check_leaves_no_confidence():
    assert plan_confidence(replace(SURE, agreement=0.0)) == 0
    assert plan_confidence(replace(SURE, agreement=np.nan)) == 0
    assert plan_confidence(replace(SURE, errors=1)) == 0


@pytest.mark.parametrize("unknown", [{"prediction": np.nan}, {"novelty": np.nan}], ids=str)
def test_what_cannot_be_known_bounds_the_confidence(unknown):
    assert 0.4 < plan_confidence(replace(SURE, **unknown)) < UNKNOWN
    assert len(replace(SURE, **unknown).notes) == 1


def test_notes_say_what_lowers_the_confidence():
    (note,) = replace(SURE, frames=0.05, displacement=0.03).notes
    assert "demonstrations predict each other to 50 mm; around the planned gripper" in note
    assert "30 mm beside it" in note


def test_demonstrations_are_judged_at_the_key_step_that_they_predict_best():
    assert prediction(np.array([[0.2, 0.001]] * 5)) == 0.001
    assert prediction(np.array([[0.0, 0.004, 0.08, 0.3]] * 5)) == 0.004


def test_demonstrations_of_one_scene_tell_nothing_about_others():
    one_scene = np.zeros((10, 4, 3))
    assert np.isnan(novelty(one_scene, np.full((4, 3), 0.1)))
    apart = np.random.default_rng(0).normal(0, 0.1, (10, 4, 3))
    assert novelty(apart, apart[3]) < 1
    assert novelty(apart, apart[3] + 1.0) > 3


def test_keypoints_that_slip_on_a_rigid_thing_are_measured():
    random = np.random.default_rng(0)
    thing = random.normal(0, 0.05, (6, 3))
    scenes = thing + random.normal(0, 0.1, (10, 1, 3)) + random.normal(0, 0.001, (10, 6, 3))
    new = thing + 0.1
    assert distortion(scenes, new) < 1
    new[:2] += 0.03
    assert distortion(scenes, new) > 3
    assert np.isnan(distortion(scenes[:2], new))
