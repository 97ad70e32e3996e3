"""Frames and ways that are inferred from demonstrations of relations."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robust_instant_policy.context import Prompt, write_prompt
from robust_instant_policy.context.discovery import find_things
from robust_instant_policy.context.things import locate
from robust_instant_policy.context.ways import find_ranking
from robust_instant_policy.policies import Neighbours, context_of_keypoints, scene_of_keypoints
from robust_instant_policy.policies.aggregation import take_first
from robust_instant_policy.policies.sampling import Proposal
from robust_instant_policy.trajectory import Trajectory

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from relation_families import FAMILIES, Drawn, Family, at, carry, down
from relations import key_error

WITHIN_M = 0.015


def shown(family: str | Family, count: int = 10, noise: float = 0.002, number: int = 7):
    """Set ``number`` of a family's demonstrations: keypoints, trajectories, and what draws more scenes."""
    draw = (FAMILIES[family] if isinstance(family, str) else family).scenes("tune", number, noise)
    scenes = [draw(index) for index in range(count)]
    return np.stack([scene.keypoints for scene in scenes]), [scene.trajectory for scene in scenes], draw


def errors(prompt: Prompt, draw, count: int = 6) -> np.ndarray:
    """Of the demonstrations' median at the key steps of new scenes, metres."""
    found = []
    for number in range(1000, 1000 + count):
        scene = draw(number, exact=True)
        planned = prompt.for_scene(scene.keypoints).median_trajectory(scene.keypoints)
        found.append(key_error(planned, scene.path))
    return np.array(found)


@pytest.mark.parametrize(
    ("family", "words"),
    [
        ("push-to", "along the line from"),
        ("point-to", "along the line from"),
        ("along", "of any size"),
        ("lid", "hinged to"),
        ("place", "axes of keypoints"),
        ("middle", " and 34% of the way to keypoints 4-6"),
        ("row", "x 101%, y 0%"),
    ],
)
def test_a_relation_is_inferred_carried_over_and_told_in_words(family, words):
    keypoints, trajectories, draw = shown(family)
    prompt = write_prompt(keypoints, trajectories)
    assert any(words in str(frame) for frame in prompt.frames.used)
    assert (errors(prompt, draw) < WITHIN_M).mean() > 0.8
    assert prompt.ways == (prompt,)


def test_things_of_any_size_are_found_where_two_other_keypoints_were_found_in_one_place_once():
    keypoints, trajectories, _ = shown("along")
    keypoints[3, 9] = keypoints[3, 8]
    assert any("of any size" in str(frame) for frame in write_prompt(keypoints, trajectories).frames.used)


@pytest.mark.parametrize(
    ("family", "number"),
    [
        ("nearest", 7),
        ("side", 7),
        ("side", 4),  # two of the ten come from the other side
        ("mirror", 7),
        ("flip", 7),
        ("larger", 3),
    ],
)
def test_demonstrations_that_do_different_things_are_told_apart(family, number):
    keypoints, trajectories, draw = shown(family, number=number)
    prompt = write_prompt(keypoints, trajectories)
    assert (errors(prompt, draw) < WITHIN_M).mean() > 0.8
    assert "told apart by" in " ".join(prompt.notes())


@pytest.mark.parametrize("number", [0, 1, 6])
def test_along_each_axis_the_origin_is_that_of_one_thing_with_the_point_in_it(number):
    keypoints, trajectories, draw = shown("row", number=number)
    assert (errors(write_prompt(keypoints, trajectories), draw) < WITHIN_M).all()


def test_a_place_beyond_a_line_is_on_the_points_between_which_the_line_runs():
    right = []
    for number in range(3):
        keypoints, trajectories, draw = shown("spacing", number=number)
        right += list(errors(write_prompt(keypoints, trajectories), draw) < WITHIN_M)
    assert np.mean(right) > 0.8


def test_a_keypoint_near_a_hinge_belongs_to_the_part_whose_distances_vary_least():
    keypoints, _, _ = shown("door", number=2)
    solid = [thing.members for thing in find_things(keypoints, hinges=False) if thing.kind == "upright"]
    assert solid == [(0, 1, 2, 3, 4), (5, 6, 7, 8, 9)]


def by_axis(grasp, release) -> Family:
    """Grasp and release at places ``(x, y)`` that follow from those of a point in B and of one in C."""

    def draw(kit, layout, hand):
        a, b, c = layout.things(3)
        things = [at(pose, shape[:size]) for pose, shape, size in zip((a, b, c), kit.shapes, (4, 3, 3), strict=True)]
        of_b, of_c = b @ [0.04, 0.03, 0, 1], c @ [-0.03, 0.04, 0, 1]
        return Drawn(tuple(things), carry(*(hand(down(place(of_b, of_c), 0.04, 0.0)) for place in (grasp, release))))

    return Family("by axis", "", draw)


@pytest.mark.parametrize(
    ("grasp", "release"),
    [
        (lambda b, c: (b[0], b[1]), lambda b, c: (b[0] + 1.5 * (c[0] - b[0]), c[1])),
        (lambda b, c: (b[0], c[1]), lambda b, c: (c[0], b[1])),
    ],
    ids=["beyond a thing", "two kinds"],
)
def test_places_by_axis_may_lie_beyond_a_thing_and_differ_between_grasp_and_release(grasp, release):
    right = []
    for number in range(3):
        keypoints, trajectories, draw = shown(by_axis(grasp, release), number=number)
        right += list(errors(write_prompt(keypoints, trajectories), draw) < WITHIN_M)
    assert np.mean(right) > 0.8


@pytest.mark.parametrize("number", [0, 3])
def test_one_demonstration_that_contradicts_the_others_is_no_way_of_its_own(number):
    keypoints, trajectories, draw = shown("place", 6, number=number)
    late = np.arange(len(trajectories[0]))[:, None] >= 12
    moved = trajectories[0].actions + late * np.append(np.tile([0.15, 0.1, 0.0], 3), 0)
    prompt = write_prompt(keypoints, [Trajectory.from_actions(moved), *trajectories[1:]])
    assert prompt.ways == (prompt,)
    assert (errors(prompt, draw) < WITHIN_M).mean() > 0.5


def test_things_alike_may_be_told_apart_by_their_distance_from_a_third():
    rng = np.random.default_rng(0)
    shapes = rng.uniform([-0.04, -0.04, 0], [0.04, 0.04, 0.03], (2, 3, 3))
    keypoints, hands = [], []
    for _ in range(10):
        places = np.pad(rng.uniform([0.3, -0.3], [0.7, 0.3], (3, 2)), (0, 1), constant_values=0)
        keypoints.append(np.concatenate([shapes[0] + places[0], shapes[0] + places[1], shapes[1] + places[2]]))
        nearer = np.argmin(np.linalg.norm(places[:2] - places[2], axis=1))
        hands.append(places[nearer] + shapes[0])
    noise = rng.normal(0, 0.002, (10, 9, 3))
    ranking = find_ranking(np.array(keypoints) + noise, np.array(hands)[:, None, None])
    assert str(ranking) == "the 2 things alike are told apart by their distance from keypoints 6-8"


def test_a_mirrored_thing_has_a_hand_and_is_found_in_both():
    rng = np.random.default_rng(0)
    shape = rng.uniform([-0.04, -0.04, 0], [0.04, 0.04, 0.03], (5, 3))
    hand = np.array([1, 1, -1, 1, -1, 1, 1, -1, 1, 1])
    turns = Rotation.from_rotvec(np.outer(rng.uniform(-3, 3, 10), [0, 0, 1])).as_matrix()
    mirrored = np.stack([shape * [1, own, 1] for own in hand])
    keypoints = mirrored @ np.swapaxes(turns, 1, 2) + rng.normal(0, 0.002, (10, 5, 3))
    thing = find_things(keypoints)[0]
    located = locate([thing], keypoints)[thing]
    assert abs(located.hand @ hand) == 10
    assert np.allclose(np.linalg.det(located.rotation), 1)
    grasp = turns @ [0.03, 0.0, 0.02]  # on the mirror plane
    for one in (-1, 1):
        own = np.einsum("ixy,ix->iy", located.rotation, grasp - located.position)[located.hand == one]
        assert np.ptp(own, axis=0).max() < 0.01


def test_between_two_ways_one_is_followed_whole_and_a_note_says_so():
    keypoints, trajectories, draw = shown("side")
    policy = Neighbours()
    policy.fit_context(context_of_keypoints(keypoints, trajectories, policy.settings))
    clear = draw(1000, exact=True).keypoints
    between = clear.copy()
    between[:5, 1] -= policy.context_.prompt.split.measure.value_at(clear) - policy.context_.prompt.split.threshold
    notes = {
        name: policy.plan_scene(scene_of_keypoints(k)).notes for name, k in (("clear", clear), ("between", between))
    }
    assert not any("lies between" in note for note in notes["clear"])
    assert any("lies between" in note for note in notes["between"])
    ways = policy.context_.prompt.ways
    plan = policy.plan_scene(scene_of_keypoints(between)).trajectory
    apart = [
        np.abs(way.median_trajectory(between).triplets[len(plan) // 2] - plan.triplets[len(plan) // 2]).max()
        for way in ways
    ]
    assert min(apart) < 0.02 < max(apart)


def test_a_plan_is_doubted_where_it_was_not_found_what_demonstrations_have_in_common():
    keypoints, trajectories, draw = shown("place")
    scattered = np.random.default_rng(0).normal(0, 0.15, (10, 3)) * [1, 1, 0]
    late = np.arange(30)[:, None] >= 12
    released = [
        Trajectory.from_actions(own.actions + late * np.append(np.tile(moved, 3), 0))
        for own, moved in zip(trajectories, scattered, strict=True)
    ]
    new = scene_of_keypoints(draw(1000, exact=True).keypoints)
    policy = Neighbours()
    sure, doubted = (
        policy.fit_context(context_of_keypoints(keypoints, own, policy.settings)).plan_scene(new)
        for own in (trajectories, released)
    )
    assert sure.confidence > 0.9
    assert doubted.confidence < 0.7
    assert any("the demonstrations predict each other to" in note for note in doubted.notes)


@pytest.mark.parametrize("number", [0, 2, 4])
def test_a_plan_is_doubted_where_frames_only_fit_the_demonstrations_that_they_are_fitted_to(number):
    def draw(kit, layout, hand):
        a, b, c = layout.things(3)
        things = [at(pose, shape[:size]) for pose, shape, size in zip((a, b, c), kit.shapes, (4, 3, 3), strict=True)]
        of_b, of_c = np.linalg.inv(a) @ b, np.linalg.inv(a) @ c
        release = down((a @ [of_b[0, 3], of_c[1, 3], 0, 1])[:2], 0.04, 0.0)  # x of B and y of C, in the axes of A
        return Drawn(tuple(things), carry(hand(a @ kit.grasps[0]), hand(release)))

    keypoints, trajectories, draw = shown(Family("not in the grammar", "", draw), number=number)
    policy = Neighbours()
    policy.fit_context(context_of_keypoints(keypoints, trajectories, policy.settings))
    for index in range(1000, 1004):
        scene = draw(index, exact=True)
        plan = policy.plan_scene(scene_of_keypoints(scene.keypoints))
        assert key_error(plan.trajectory, scene.path) > WITHIN_M
        assert plan.confidence < 0.9


def test_each_way_shows_a_model_its_own_demonstrations():
    keypoints, trajectories, _ = shown("side")
    prompt = write_prompt(keypoints, trajectories)
    first, second = prompt.ways
    assert sorted(first.shown + second.shown) == list(range(10))
    for way in prompt.ways:
        assert prompt.for_scene(keypoints[way.shown[0]]) is way


def test_one_demonstration_is_said_to_be_a_guess():
    keypoints, trajectories, _ = shown("place", 1)
    assert any("guess" in note for note in write_prompt(keypoints, trajectories).notes())
    keypoints, trajectories, _ = shown("place", 4)
    assert not any("guess" in note for note in write_prompt(keypoints, trajectories).notes())


def test_a_scene_that_stretches_what_was_shown_is_outside():
    keypoints, trajectories, _ = shown("push-to")
    prompt = write_prompt(keypoints, trajectories)
    far = keypoints[0].copy()
    far[5:, 0] += 0.6
    assert prompt.outside(keypoints[0]) == 0
    assert prompt.outside(far) > 0.5
    assert prompt.scene_notes(keypoints[0]) == ()
    assert any("extrapolation" in note for note in prompt.scene_notes(far))


def test_where_things_are_farther_apart_a_plan_passes_less_surely_and_a_fault_is_still_refused():
    keypoints, trajectories, draw = shown("place")
    policy = Neighbours()
    policy.fit_context(context_of_keypoints(keypoints, trajectories, policy.settings))
    carried = 0
    for number in range(1000, 1012):
        far = draw(number, exact=True, condition="twice as far")
        scene = scene_of_keypoints(far.keypoints)
        plan = policy.plan_scene(scene)
        if not plan.evidence["carried"]:  # within what was demonstrated, or much too far
            continue
        carried += 1
        assert key_error(plan.trajectory, far.path) < WITHIN_M
        assert 0.5 < plan.confidence < 0.9
        for fault in (np.add, np.multiply):
            actions = plan.trajectory.actions.copy()
            jump = [0, 3, 6] if fault is np.add else list(range(9))
            actions[15:20, jump] = fault(actions[15:20, jump], 0.4 if fault is np.add else 2.0)
            wrong = take_first(policy.context_, scene, Proposal((Trajectory.from_actions(actions),)))
            assert any(note.startswith("error: ") for note in wrong.notes)
        for sign in (-1, 1):  # a little beside what is carried over, at all steps alike
            beside = plan.trajectory.actions + sign * np.append(np.tile([0.1, 0.0, 0.0], 3), 0)
            wrong = take_first(policy.context_, scene, Proposal((Trajectory.from_actions(beside),)))
            assert not any("carried over into this scene do the same" in note for note in wrong.notes)
    assert carried > 2
    elsewhere = draw(1000, exact=True).keypoints + np.array([1.0, 0.0, 0.0])
    plan = policy.plan_scene(scene_of_keypoints(elsewhere))
    assert plan.confidence == 0  # a metre away no frame supports a plan


def test_frames_excuse_distances_alone_and_only_where_they_carry_the_demonstrations_there():
    keypoints, trajectories, draw = shown("place")
    policy = Neighbours()
    policy.fit_context(context_of_keypoints(keypoints, trajectories, policy.settings))
    keypoints = draw(1000, exact=True).keypoints
    scene = scene_of_keypoints(keypoints)
    plan = policy.plan_scene(scene)
    assert plan.confidence > 0
    actions = plan.trajectory.actions.copy()
    actions[:, [0, 3, 6]] += policy.context_.report.envelope.upper[0, 0] + 0.02 - actions[:, [0, 3, 6]].max()
    aside = Proposal((Trajectory.from_actions(actions),))
    (told,) = (note for note in take_first(policy.context_, scene, aside).notes if "position" in note)
    assert told.startswith("error: ")
    sunk = policy.plan_scene(scene_of_keypoints(keypoints - np.array([0.0, 0.0, 0.05])))
    (told,) = (note for note in sunk.notes if "too low" in note)
    assert told.startswith("error: ")
    assert sunk.confidence == 0


def test_changes_of_frame_side_by_side_correct_a_jump_once():
    from robust_instant_policy.context.joins import joined

    hands = np.tile([[0.0, 0.0, 0.1], [0.0, 0.04, 0.0], [0.0, -0.04, 0.0]], (12, 1, 1))
    hands[:, :, 0] += 0.01 * np.arange(12)[:, None]
    hands[5:, :, 1] += 0.05
    still = np.zeros((11, 2))
    once = joined(hands, np.full(12, 0.03), {0, 11}, {5}, still)
    for changes in ({5, 6}, {4, 5, 6}):
        np.testing.assert_allclose(joined(hands, np.full(12, 0.03), {0, 11}, changes, still), once, atol=1e-9)
    assert np.diff(once[:, 0, 1]).max() < 0.03
    np.testing.assert_allclose(joined(hands, np.full(12, 0.03), {0, 11}, (), still), hands, atol=1e-9)
