"""Demonstrations to prompts, answers to trajectories."""

from __future__ import annotations

import re

import numpy as np
import pytest

from robust_instant_policy.context import Prompt, SequencePrompt, write_prompt
from robust_instant_policy.context.alignment import align
from robust_instant_policy.context.discovery import find_things
from robust_instant_policy.context.frames import Anchor, Axes, Frame
from robust_instant_policy.context.step_frames import StepFrames
from robust_instant_policy.context.things import WORLD, locate, robust_fit
from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.geometry import GripperTriangle, fit_upright, invert_pose, make_pose
from robust_instant_policy.trajectory import Trajectory

TRIANGLE = GripperTriangle(length=0.1, opening=0.08)
DOWN = np.diag([1.0, -1.0, -1.0])
SHAPES = np.random.default_rng(3).uniform(-0.04, 0.04, (2, 5, 3))
HOME = np.array([0.3, 0.0, 0.35])


def turned(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


def scene(seed: int, noise: float = 0.001, length: int = 24) -> tuple[np.ndarray, Trajectory]:
    """Two objects placed and turned at random; the gripper goes from home to the first and then to the second."""
    rng = np.random.default_rng(seed)
    places = np.array([[0.4, -0.2, 0.0], [0.5, 0.2, 0.0]]) + rng.uniform(-0.1, 0.1, (2, 3)) * [1, 1, 0]
    turns = [turned(angle) for angle in rng.uniform(-1.5, 1.5, 2)]
    keypoints = np.concatenate([SHAPES[i] @ turns[i].T + places[i] for i in range(2)])
    keypoints = keypoints + rng.normal(0, noise, keypoints.shape)
    ways = [(HOME, DOWN), *((places[i] + turns[i] @ [0.02, 0.01, 0.03], turns[i] @ DOWN) for i in range(2))]
    poses, states = [], []
    for leg in range(2):
        for part in np.arange(1, length // 2 + 1) / (length // 2):
            goal = ways[leg + 1][0] if part > 0.5 else ways[leg][0]
            rotation = ways[leg + 1][1] if part > 0.5 else ways[leg][1]
            poses.append(make_pose(rotation, goal + np.array([0, 0, 0.1 * abs(np.cos(np.pi * part))])))
            states.append(float(leg))
    return keypoints, Trajectory.from_poses(np.stack(poses), np.array(states), TRIANGLE)


def demonstrations(count: int = 8, **options) -> tuple[np.ndarray, list[Trajectory]]:
    scenes = [scene(seed, **options) for seed in range(count)]
    return np.stack([keypoints for keypoints, _ in scenes]), [trajectory for _, trajectory in scenes]


def own_answers(prompt: Prompt, keypoints: np.ndarray, demo: int) -> list[str]:
    """What the prompt shows as demonstration ``demo``'s answers: every other line."""
    texts = []
    for query in prompt.queries(keypoints):
        if isinstance(prompt, SequencePrompt):
            texts.append(query.text.split("\n\n")[demo].split("\n", 1)[1])
        else:
            texts.append(query.text.splitlines()[2 * demo + 1])
    return texts


def two_arms(trajectory: Trajectory) -> Trajectory:
    moved = trajectory.actions.copy()
    moved[:, [1, 4, 7]] += 0.3
    return Trajectory.from_actions(np.concatenate([trajectory.actions, moved], axis=1))


@pytest.mark.parametrize("arms", [1, 2])
@pytest.mark.parametrize("layout", ["sequence", "factorised"])
@pytest.mark.parametrize("frames", ["world", "adaptive"])
def test_a_demonstration_comes_back_from_its_own_text(frames, layout, arms):
    keypoints, trajectories = demonstrations()
    if arms == 2:
        trajectories = [two_arms(trajectory) for trajectory in trajectories]
    prompt = write_prompt(keypoints, trajectories, frames, layout)
    for demo in (0, 5):
        texts = own_answers(prompt, keypoints[demo], demo)
        back = prompt.trajectory([prompt.read(index, text) for index, text in enumerate(texts)], keypoints[demo])
        missed = np.abs(back.triplets - trajectories[demo].triplets).max(axis=(1, 2, 3))
        assert missed[[0, 11, 12, 23]].max() < 0.0035  # rounding, and agreed numbers
        assert missed.max() < (0.0035 if layout == "sequence" else 0.0065)  # and steps between those that are asked for
        assert np.array_equal(back.gripper_state, trajectories[demo].gripper_state)


def test_whole_trajectories_in_the_world_frame_are_written_as_the_paper_does():
    actions = np.zeros((2, 10))
    actions[:, 0], actions[1, 9] = [0.1, -0.0204], 1.0
    keypoints = np.array([[[0.5, -0.25, 0.0301]]])
    prompt = write_prompt(keypoints, [Trajectory.from_actions(actions)], "world", "sequence")
    (query,) = prompt.queries(np.array([[0.4, 0.3, 0.2]]))
    assert query.text == "500 -250 30\n100 0 0 0 0 0 0 0 0 0\n-20 0 0 0 0 0 0 0 0 1\n\n400 300 200\n"


def test_trajectories_of_different_length_keep_their_lengths_in_the_papers_prompt():
    keypoints, trajectories = demonstrations(3)
    trajectories[1] = trajectories[1].subset(np.arange(0, 24, 2))
    prompt = write_prompt(keypoints, trajectories, "world", "sequence")
    blocks = prompt.queries(keypoints[0])[0].text.split("\n\n")
    assert [len(block.splitlines()) - 1 for block in blocks[:3]] == [24, 12, 24]


def test_each_part_of_the_task_is_written_in_the_frame_of_its_object():
    keypoints, trajectories = demonstrations()
    frames = write_prompt(keypoints, trajectories).frames.arms[0]
    assert str(frames[0]) == "world"
    assert str(frames[11]) == "keypoints 0-4, axes of keypoints 0-4"  # the grasp
    assert str(frames[23]) == "keypoints 5-9, axes of keypoints 5-9"  # the place


def test_the_trajectory_follows_objects_that_were_moved_and_turned():
    keypoints, trajectories = demonstrations()
    prompt = write_prompt(keypoints, trajectories)
    for seed in range(100, 110):
        new, truth = scene(seed)
        planned = prompt.median_trajectory(new)
        for step in (0, 11, 23):
            assert np.linalg.norm(planned.triplets[step] - truth.triplets[step], axis=-1).max() < 0.008


def test_each_arm_follows_the_object_that_it_is_at():
    keypoints, trajectories = demonstrations()
    prompt = write_prompt(keypoints, [there_and_back(trajectory) for trajectory in trajectories])
    for seed in range(100, 105):
        new, truth = scene(seed)
        planned, wanted = prompt.median_trajectory(new), there_and_back(truth)
        for step in (0, 23):  # one arm is at home, the other at the second object
            assert np.linalg.norm(planned.triplets[step] - wanted.triplets[step], axis=-1).max() < 0.008


def there_and_back(trajectory: Trajectory) -> Trajectory:
    """Two arms, of which the second does backwards what the first does."""
    return Trajectory.from_actions(np.concatenate([trajectory.actions, trajectory.actions[::-1]], axis=1))


def test_a_place_between_two_objects_is_followed():
    keypoints, trajectories = demonstrations()
    prompt = write_prompt(keypoints, [half_way(*pair) for pair in zip(keypoints, trajectories, strict=True)])
    frame = prompt.frames.arms[0][-1]
    share = frame.shares[0][0]
    assert str(frame) == f"{share:.0%} of the way from keypoints 0-4 to keypoints 5-9, axes of keypoints 5-9"
    assert share == pytest.approx(0.5, abs=0.03)
    for seed in range(100, 110):
        new, truth = scene(seed)
        planned = prompt.median_trajectory(new)
        assert np.linalg.norm(planned.triplets[-1] - half_way(new, truth).triplets[-1], axis=-1).max() < 0.008


def half_way(keypoints: np.ndarray, trajectory: Trajectory) -> Trajectory:
    """Turned as it was, but ends half-way between the two objects."""
    middles = keypoints.reshape(2, 5, 3).mean(axis=1)
    actions = trajectory.actions.copy()
    actions[12:, :9] += np.tile((middles[0] - middles[1]) / 2, 3)
    return Trajectory.from_actions(actions)


def test_free_motion_is_written_in_interpolated_frames_and_does_not_jump():
    starts, stops = np.random.default_rng(0).uniform(-0.15, 0.15, (2, 8, 3)) * [1, 1, 0]
    keypoints = np.concatenate([SHAPES[0] + starts[:, None], SHAPES[1] + [0.0, 0.5, 0.0] + stops[:, None]], axis=1)
    trajectories: list[Trajectory] = []
    for start, stop in zip(starts, stops, strict=True):
        way = stop - start + np.array([0.0, 0.5, 0.0])
        poses = np.stack([make_pose(DOWN, start + share * way) for share in np.linspace(0, 1, 20)])
        trajectories.append(Trajectory.from_poses(poses, np.zeros(20), TRIANGLE))
    prompt = write_prompt(keypoints[:7], trajectories[:7])
    assert sum(len(frame.ends) == 2 for frame in prompt.frames.arms[0]) >= 12
    planned = prompt.median_trajectory(keypoints[7])
    assert np.linalg.norm(planned.triplets - trajectories[7].triplets, axis=-1).max() < 0.015


def test_axes_along_a_line_turn_with_it_and_frames_say_how_far_their_origin_moves():
    keypoints, _ = demonstrations(3)
    first, second = (thing for thing in find_things(keypoints) if thing.kind == "upright")
    ends = tuple(Anchor(thing, np.array([0.01, 0.02, 0.0])) for thing in (first, second))
    scene = locate([WORLD, first, second], keypoints)
    line = ends[1].position(scene) - ends[0].position(scene)
    for in_space in (False, True):
        frame = Frame(Axes(ends, in_space), (first, second), (np.zeros(3),) * 2, (np.full(3, 0.25),))
        pose = frame.pose(keypoints[0])
        expected = line[0] if in_space else line[0] * [1, 1, 0]
        assert np.allclose(pose[:3, 0], expected / np.linalg.norm(expected))
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
        assert np.allclose(pose[:3, 3], 0.75 * scene[first].position[0] + 0.25 * scene[second].position[0])
    origin = (first, second, WORLD), (np.zeros(3),) * 3
    low, high = (np.full(3, 0.1), np.full(3, 0.3)), (np.array([0.3, 0.3, 0.2]), np.full(3, 0.2))
    steps = tuple(Frame(frame.axes, *origin, shares) for shares in (low, low, high))
    (use,) = StepFrames((steps,)).uses(keypoints[0])
    assert use.words == (
        "x 10% to 30%, y 10% to 30%, z 10% to 20% of the way from keypoints 0-4 to keypoints 5-9 "
        "and 30% to 20% of the way to the world, axes along the line from keypoints 0-4 to keypoints 5-9 in space"
    )
    assert (use.arm, use.first, use.last) == (0, 0, 2)


def test_the_expected_curvature_is_that_of_the_demonstrations_whatever_their_number():
    _, trajectories = demonstrations()
    expected = align(trajectories).curvature()
    assert expected.shape == (24,)
    assert expected.max() > 3 * expected.min()
    assert np.allclose(align(trajectories[:1] * 3).curvature(), align(trajectories[:1]).curvature())
    assert (align([trajectories[0].subset([0])]).curvature() > 0).all()
    assert write_prompt(*demonstrations(3), "world", "sequence").curvature.min() == pytest.approx(
        align(demonstrations(3)[1]).curvature().max()
    )


def test_variation_is_that_of_the_demonstrations_in_the_frames_that_suit_them():
    keypoints, trajectories = demonstrations()
    variation = write_prompt(keypoints, trajectories).variation
    assert variation.shape == (24,)
    assert variation[[11, 23]].max() < 0.004  # at both objects, wherever they are
    moved = []
    for index, trajectory in enumerate(trajectories):
        poses = TRIANGLE.poses(trajectory.triplets)
        poses[17, ..., 2, 3] += 0.03 * (-1) ** index
        moved.append(Trajectory.from_poses(poses[:, 0], trajectory.gripper_state[:, 0], TRIANGLE))
    vertical = write_prompt(keypoints, moved).variation[17] ** 2 - variation[17] ** 2
    assert np.sqrt(vertical) == pytest.approx(0.03 * np.sqrt(8 / 7 / 3), rel=0.1)  # of three coordinates one
    assert write_prompt(keypoints, trajectories, "world", "factorised").variation is None
    assert write_prompt(keypoints, trajectories, "world", "sequence").variation is None
    assert write_prompt(*demonstrations(1)).variation is None


def test_one_demonstration_is_enough_to_follow_an_object():
    keypoints, trajectories = demonstrations(1)
    prompt = write_prompt(keypoints, trajectories)
    new, truth = scene(100)
    planned = prompt.median_trajectory(new)
    assert np.linalg.norm(planned.triplets[[11, 23]] - truth.triplets[[11, 23]], axis=-1).max() < 0.012


def test_a_keypoint_found_in_the_wrong_place_does_not_carry_the_trajectory_away():
    keypoints, trajectories = demonstrations()
    rng = np.random.default_rng(0)
    for demo in range(0, 8, 2):
        keypoints[demo, rng.integers(10)] += [0.07, -0.05, 0.02]
    prompt = write_prompt(keypoints, trajectories)
    new, truth = scene(100)
    new[2] += [0.1, 0.1, 0.0]
    planned = prompt.median_trajectory(new)
    assert np.linalg.norm(planned.triplets[[11, 23]] - truth.triplets[[11, 23]], axis=-1).max() < 0.012


def test_a_pose_is_fitted_to_the_majority_of_points():
    pose = make_pose(turned(0.7), [0.4, -0.1, 0.2])
    points = SHAPES[0] @ pose[:3, :3].T + pose[:3, 3]
    points[3] += 0.2
    for upright in (True, False):
        assert np.allclose(robust_fit(SHAPES[0], points[None], upright)[0], pose, atol=2e-3)


def test_a_pose_is_fitted_to_noisy_points_nearly_as_well_as_by_least_squares():
    rng = np.random.default_rng(0)

    def scenes(count: int) -> tuple[np.ndarray, np.ndarray]:
        angles, places = rng.uniform(-3, 3, count), rng.uniform(-0.2, 0.2, (count, 1, 3))
        poses = make_pose(np.stack([turned(angle) for angle in angles]), places[:, 0])
        points = SHAPES[0] @ np.swapaxes(poses[:, :3, :3], 1, 2) + places
        return poses, points + rng.normal(0, 0.004, points.shape)

    def off(poses: np.ndarray, true: np.ndarray) -> float:
        """Mean scatter, metres, of a point 10 cm away."""
        point = (invert_pose(true) @ poses @ [0.1, 0.0, 0.0, 1.0])[:, :3]
        return float(np.linalg.norm(point - point.mean(axis=0), axis=1).mean())

    (thing, *_) = find_things(scenes(10)[1])
    assert thing.members == (0, 1, 2, 3, 4)
    true, points = scenes(100)
    found = locate([thing], points)[thing]
    best = fit_upright(np.broadcast_to(SHAPES[0], points.shape), points, np.ones(points.shape[:2]))
    assert off(make_pose(found.rotation, found.position), true) < 1.2 * off(best, true)


def test_moving_the_whole_scene_moves_the_plan_with_it_except_where_the_world_counts():
    keypoints, trajectories = demonstrations()
    prompt = write_prompt(keypoints, trajectories)
    new, _ = scene(100)
    turn, shift = turned(0.5), np.array([0.05, 0.1, 0.02])
    before = prompt.median_trajectory(new).triplets
    after = prompt.median_trajectory(new @ turn.T + shift).triplets
    kinds = set()
    for step in (0, 11, 23, len(before) - 1):  # key steps: the others lead from one to the next
        frame = prompt.frames.arms[0][step]
        if WORLD in frame.things and len(frame.things) > 1:
            continue
        kinds.add(frame.things == (WORLD,))
        expected = before[step] if frame.things == (WORLD,) else before[step] @ turn.T + shift
        assert np.allclose(after[step], expected, atol=1e-4)
    assert kinds == {True, False}


def test_numbers_are_asked_that_keypoints_predict_but_neither_frames_nor_chance():
    keypoints, trajectories = demonstrations(10)
    assert not write_prompt(keypoints, trajectories).questions
    rng = np.random.default_rng(0)
    for index, trajectory in enumerate(trajectories):
        actions = trajectory.actions.copy()
        actions[23, [0, 3, 6]] += rng.normal(0, 0.01)
        actions[23, [2, 5, 8]] += 0.3 * keypoints[index, 0, 1]
        trajectories[index] = Trajectory.from_actions(actions)
    asked = {place for question in write_prompt(keypoints, trajectories).questions for place in question.asked}
    assert (23, 2) in asked
    assert {dim for _, dim in asked} == {2}  # the displacement along x is random
    everything = write_prompt(keypoints[:2], trajectories[:2], "world")
    assert {dim for question in everything.questions for _, dim in question.asked} == set(range(6))


def test_a_state_on_which_demonstrations_differ_is_asked_for():
    keypoints, trajectories = demonstrations(6)
    for demo in (1, 4):
        actions = trajectories[demo].actions.copy()
        actions[:, 9] = np.arange(24) % 2
        trajectories[demo] = Trajectory.from_actions(actions)
    for demo in (0, 2, 3, 5):  # no majority: as many different ways as demonstrations
        actions = trajectories[demo].actions.copy()
        actions[:, 9] = np.arange(24) >= 5 + 3 * demo
        actions[demo, 9] = 1
        trajectories[demo] = Trajectory.from_actions(actions)
    prompt = write_prompt(keypoints, trajectories)
    place = next(i for i, question in enumerate(prompt.questions) if any(dim == 6 for _, dim in question.asked))
    text = own_answers(prompt, keypoints[0], 0)[place]
    assert prompt.read(place, text) is not None
    parts = text.split()
    parts[next(i for i, (_, dim) in enumerate(prompt.questions[place].asked) if dim == 6)] = "7"
    assert prompt.read(place, " ".join(parts)) is None


def test_every_example_is_what_the_grammar_would_allow():
    keypoints, trajectories = demonstrations()
    for layout in ("sequence", "factorised"):
        prompt = write_prompt(keypoints, trajectories, "adaptive", layout)
        for demo in range(8):
            for query, text in zip(prompt.queries(keypoints[0]), own_answers(prompt, keypoints[0], demo), strict=True):
                assert re.fullmatch(query.pattern, text + ("\n" if layout == "sequence" else ""))


def test_only_the_end_of_a_prompt_depends_on_the_scene():
    keypoints, trajectories = demonstrations()
    prompt = write_prompt(keypoints, trajectories)
    for one, other in zip(prompt.queries(scene(100)[0]), prompt.queries(scene(101)[0]), strict=True):
        assert one.text.rsplit("\n", 2)[0] == other.text.rsplit("\n", 2)[0]


@pytest.mark.parametrize("layout", ["sequence", "factorised"])
def test_an_answer_that_cannot_be_read_is_refused(layout):
    keypoints, trajectories = demonstrations()
    prompt = write_prompt(keypoints, trajectories, "world", layout)
    texts = own_answers(prompt, keypoints[0], 0)
    for bad in ("I am sorry, I cannot", "", "99999 " + texts[0].split(" ", 1)[1], texts[0].replace(" ", " x", 1)):
        assert prompt.read(0, bad) is None


def test_a_sequence_whose_last_row_is_missing_makes_a_shorter_trajectory():
    keypoints, trajectories = demonstrations()
    prompt = write_prompt(keypoints, trajectories, "adaptive", "sequence")
    (text,) = own_answers(prompt, keypoints[0], 0)
    short = prompt.trajectory([prompt.read(0, text.rsplit("\n", 1)[0])], keypoints[0])
    assert len(short) == 23
    assert short.times[-1] == pytest.approx(22 / 23)
    assert prompt.read(0, "\n".join(text.splitlines()[:10])) is None


def test_steps_are_aligned_at_gripper_changes():
    _, trajectories = demonstrations(5)
    trajectories[1] = trajectories[1].subset([0, 4, 8, 11, 12, 23])
    aligned = align(trajectories)
    assert aligned.actions.shape == (5, 24, 10)
    assert (aligned.actions[:, :12, 9] == 0).all()
    assert (aligned.actions[:, 12:, 9] == 1).all()
    assert aligned.key_steps == (0, 11, 12, 23)
    assert np.allclose(aligned.actions[1, [0, 11, 12, 23]], trajectories[1].actions[[0, 3, 4, 5]])


def test_a_demonstration_that_uses_the_gripper_otherwise_than_most_is_left_out():
    keypoints, trajectories = demonstrations(5)
    actions = trajectories[3].actions.copy()
    actions[15:18, 9] = 0
    trajectories[3] = Trajectory.from_actions(actions)
    assert align(trajectories).kept == (0, 1, 2, 4)
    write_prompt(keypoints, trajectories).queries(keypoints[0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda k, t: (k[0], t), r"keypoints must be \(I, K, 3\)"),
        (lambda k, t: (k[:2], t), "2 sets of keypoints for 3 trajectories"),
        (lambda k, t: (k, [t[0], two_arms(t[1]), t[2]]), "differ in their number of arms"),
        (lambda k, t: (np.where(np.arange(3) == 1, np.nan, k), t), "not finite"),
    ],
)
def test_wrong_input_is_told_in_one_line(change, message):
    keypoints, trajectories = demonstrations(3)
    with pytest.raises(InvalidValueError, match=message):
        write_prompt(*change(keypoints, trajectories))


def test_a_scene_with_another_number_of_keypoints_is_refused():
    prompt = write_prompt(*demonstrations(3))
    with pytest.raises(InvalidValueError, match=r"keypoints must be \(10, 3\)"):
        prompt.queries(np.zeros((9, 3)))


@pytest.mark.parametrize("options", [{"frames": "camera"}, {"layout": "tree"}])
def test_an_unknown_option_names_the_known_ones(options):
    with pytest.raises(InvalidValueError, match="must be '"):
        write_prompt(*demonstrations(2), **options)


@pytest.mark.filterwarnings("error")
def test_keypoints_that_coincide_are_one_thing_of_no_size():
    keypoints, trajectories = demonstrations(4)
    together = np.repeat(keypoints[:, :1], 5, axis=1)
    prompt = write_prompt(together, trajectories)
    assert np.isfinite(prompt.for_scene(together[0]).frames.poses(together)).all()


def test_nothing_to_align_is_told():
    with pytest.raises(InvalidValueError, match="no trajectories"):
        align([])


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_keypoints_that_are_not_finite_are_told(value):
    keypoints, trajectories = demonstrations(4)
    keypoints[1, 2, 0] = value
    with pytest.raises(InvalidValueError, match=r"keypoints of shape \(4, 10, 3\) holds? values that are not finite"):
        write_prompt(keypoints, trajectories)
