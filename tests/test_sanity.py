"""Recordings and scenes that contradict themselves are named; sound ones pass."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from benchmarks.faults import FAULTS, points, states
from scipy.spatial.transform import Rotation

from robust_instant_policy.cli import main
from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.geometry import GripperTriangle, make_pose
from robust_instant_policy.sanity import (
    DemonstrationError,
    EnvelopeError,
    GeometryError,
    Surroundings,
    View,
    check_demonstrations,
    errors,
)
from robust_instant_policy.tasks.camera_noise import CameraNoise
from robust_instant_policy.trajectory import Trajectory, downsample


@pytest.fixture(scope="module")
def demonstrations(workbench):
    return load_demonstrations(workbench / "data" / "push-cube")


@pytest.fixture(scope="module")
def scene(workbench):
    return Observation.load(workbench / "observation.npz")


@pytest.fixture(scope="module")
def report(demonstrations):
    return check_demonstrations(demonstrations)


def about_its_middle(turn, triplets):
    """Grippers turned about the middle of their fingertips."""
    middle = triplets[..., 1:, :].mean(axis=-2, keepdims=True)
    return (triplets - middle) @ turn.T + middle


def told(findings):
    return " ".join(f"{finding.message} {finding.cause}" for finding in errors(findings))


def test_sound_demonstrations_and_a_sound_scene_pass(report, scene):
    report.raise_if_wrong()
    assert report.require_observation(scene) == ()
    assert report.reference.scene_spread_m > 0.02


def test_a_person_who_takes_more_or_less_time_for_the_same_way_is_no_error(demonstrations):
    by_hand = []
    for index, shown in enumerate(demonstrations):
        times = np.linspace(0, 1, len(shown.trajectory))
        steps = np.round(times ** (0.5, 1, 2)[index % 3] * (len(times) - 1)).astype(int)
        by_hand.append(replace(shown, trajectory=Trajectory(shown.trajectory.actions[steps], times)))
    assert check_demonstrations(by_hand).findings == ()


def test_the_noise_of_a_depth_camera_is_no_error(demonstrations, scene):
    noise = CameraNoise()
    noisy = [replace(d, observation=noise.photograph(d.observation, i)) for i, d in enumerate(demonstrations)]
    report = check_demonstrations(noisy)
    report.raise_if_wrong()
    assert not errors(report.check_observation(noise.photograph(scene, 99)))


def with_images(demonstrations, change):
    return [replace(d, observation=change(d.observation)) for d in demonstrations]


def test_depth_that_is_displaced_against_colour_in_demonstrations_is_told(demonstrations):
    def upward(o):
        return replace(o, depth=np.roll(o.depth, -5, axis=0))

    one = [*with_images(demonstrations[:1], upward), *demonstrations[1:4]]
    for shown, where in ((with_images(demonstrations[:3], upward), "the demonstrations"), (one, "demonstration 0")):
        (found,) = [f for f in check_demonstrations(shown).findings if f.kind == "registration"]
        assert f"in {where} depth is displaced by +0, -5 pixels" in found.message
        assert found.severity == "warning"


def raised(o):
    return o.depth < np.median(o.depth) - 0.012


def shadow(o):
    dark = np.roll(raised(o), (4, 8), axis=(0, 1)) & ~raised(o)
    return replace(o, rgb=np.where(dark[..., None], o.rgb // 3, o.rgb))


def stripes(o):
    light = (np.arange(o.rgb.shape[1]) // 6 % 2 == 0) & ~raised(o)
    return replace(o, rgb=np.where(light[..., None], np.minimum(o.rgb, 165) + 90, o.rgb).astype(np.uint8))


def occluded(o):
    hidden = np.roll(raised(o), 6, axis=1) & ~raised(o)
    return replace(o, depth=np.where(hidden, np.float32("nan"), o.depth))


@pytest.mark.parametrize("change", [shadow, stripes, occluded])
def test_shadows_stripes_and_occlusion_are_no_displacement_of_depth(demonstrations, change):
    findings = check_demonstrations(with_images(demonstrations[:3], change)).findings
    assert not [f for f in findings if f.kind == "registration"]


def test_depth_that_is_displaced_against_colour_in_a_scene_is_told(report, demonstrations, scene):
    findings = report.require_observation(FAULTS["depth-6px:scene"].scene(scene, demonstrations))
    assert re.search(r"depth is displaced by \+6, \+0 pixels \(1\d mm\)", " ".join(map(str, findings)))


@pytest.mark.parametrize("weights", [(1 / 3, 1 / 3, 1 / 3), (0, 1, 0)], ids=["mean", "green"])
def test_monochrome_images_in_which_objects_look_like_the_table_are_no_error(demonstrations, scene, weights):
    def grey(o):
        return replace(o, rgb=np.repeat((o.rgb @ np.array(weights)).astype(np.uint8)[..., None], 3, axis=-1))

    report = check_demonstrations(with_images(demonstrations, grey))
    assert not errors((*report.findings, *report.check_observation(grey(scene))))


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("opengl-axes:demos", "OpenGL"),
        ("f-double:demos", "focal length"),
        ("f-half-and-centre:demos", "resolution"),
        ("depth-0.1:demos", "depth multiplied by 10"),
        ("depth-10:demos", "depth multiplied by 0.1"),
        ("depth-0.25:demos", "depth multiplied by 4"),
        ("upside-down:demos", "upside down"),
        ("mirrored:demos", "mirrored"),
        ("camera-10cm-low:demos", "camera"),
        ("camera-10cm-high:demos", "below the table"),
        ("depth-stripe:demos", "rows"),
        ("radians-as-degrees:demos", "Euler angles read as radians"),
        ("degrees-as-radians:demos", "Euler angles in degrees taken for radians"),
    ],
)
def test_demonstrations_whose_geometry_is_wrong_are_refused_and_the_mistake_is_named(demonstrations, fault, words):
    with pytest.raises(GeometryError, match=words):
        check_demonstrations(FAULTS[fault].demonstrations(demonstrations[:3])).raise_if_wrong()


def test_a_rod_that_colour_shows_too_is_no_error_of_the_depth(demonstrations):
    first = demonstrations[0].observation
    depth, rgb = first.depth.copy(), first.rgb.copy()
    rows = slice(depth.shape[0] // 2, depth.shape[0] // 2 + depth.shape[0] // 16)
    depth[rows] *= 0.5
    alone = replace(demonstrations[0], observation=replace(first, depth=depth))
    assert "check the depth stream" in told(check_demonstrations([alone, *demonstrations[1:]]).findings)
    rgb[rows] = (20, 25, 30)
    seen = replace(demonstrations[0], observation=replace(first, depth=depth, rgb=rgb))
    found = check_demonstrations([seen, *demonstrations[1:]]).findings
    assert "depth stream" not in told(found)
    assert any("something hides the whole of rows" in one.message for one in found)


def test_wrong_readings_below_the_table_are_no_hole_for_paths_that_lie_too_low(demonstrations):
    rng, low = np.random.default_rng(0), []
    for one in demonstrations:
        depth = one.observation.depth.copy()
        for row, col in rng.integers(1, np.array(depth.shape) - 2, (depth.size // 450, 2)):  # 2% of the pixels
            depth[row - 1 : row + 2, col - 1 : col + 2] += 0.08
        actions = one.trajectory.actions.copy()
        actions[:, [2, 5, 8]] -= 0.06
        path = Trajectory(actions, one.trajectory.times)
        low.append(replace(one, observation=replace(one.observation, depth=depth), trajectory=path))
    with pytest.raises(GeometryError, match="below the table"):
        check_demonstrations(low).raise_if_wrong()


def test_trajectories_shuffled_against_their_images_are_refused(demonstrations):
    found = check_demonstrations(FAULTS["shuffled:demos"].demonstrations(demonstrations)).findings
    assert "other images" in told(found)


def test_quaternions_read_in_the_wrong_order_are_named(demonstrations):
    turned = []
    for index, demonstration in enumerate(demonstrations):
        turn = Rotation.from_euler("z", 25.0 * index, degrees=True).as_matrix()
        turned += points(partial(about_its_middle, turn))([demonstration])
    with pytest.raises(GeometryError, match="quaternion"):
        check_demonstrations(FAULTS["quaternion-order:demos"].demonstrations(turned)).raise_if_wrong()


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("inverse-pose:scene", "inverse camera pose"),
        ("opengl-axes:scene", "OpenGL"),
        ("f-half:scene", "intrinsics"),
        ("depth-0.9:scene", "depth"),
        ("rgb-upside-down:scene", "upside down"),
        ("mirrored:scene", "mirrored"),
        ("depth-of-another:scene", "edges of depth"),
        ("camera-10cm-x:scene", "camera"),
        ("camera-10cm-low:scene", "camera"),
        ("moved-sideways:scene", "camera was moved"),
        ("lowered:scene", "camera"),
        ("no-depth:scene", "depth"),
        ("black:scene", "colour"),
        ("bgr:scene", "red and blue are exchanged"),
        ("depth-other-lens:scene", "another lens"),
        ("cropped-3%:scene", "one was cropped"),
        ("fx-half:scene", r"displaces what it shows by \d+ mm: intrinsics"),
        ("pitch-1deg:scene", r"displaces what it shows by 2\d mm: the camera pose is wrong"),
    ],
)
def test_a_scene_that_contradicts_the_demonstrations_is_refused_and_the_mistake_is_named(
    report, demonstrations, scene, fault, words
):
    with pytest.raises(GeometryError, match=words):
        report.require_observation(FAULTS[fault].scene(scene, demonstrations))


def test_another_camera_is_no_error_where_its_calibration_is_right(report, scene):
    margin = scene.rgb.shape[0] // 8
    cut = slice(margin, None), slice(2 * margin, None)  # the part of the image that a camera beside it would see
    shift = np.array([[0, 0, 2 * margin], [0, 0, margin], [0, 0, 0]])
    index = np.clip(np.arange(scene.rgb.shape[0]) + margin, 0, scene.rgb.shape[0] - 1)
    across = np.clip(np.arange(scene.rgb.shape[1]) + 2 * margin, 0, scene.rgb.shape[1] - 1)
    depth = np.full_like(scene.depth, np.nan)
    depth[:-margin, : -2 * margin] = scene.depth[cut]
    moved = replace(scene, rgb=scene.rgb[index][:, across], depth=depth, intrinsics=scene.intrinsics - shift)
    findings = report.check_observation(moved)
    assert not [finding for finding in errors(findings) if finding.kind != "scenery"]
    assert not any("texture is another" in str(finding) for finding in findings)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("actions-mm:demos", "millimetres"),
        ("one-step:demos", "step"),
        ("100x-longer:demos", "times as long"),
        ("contradicts:demos", "demonstration 4 contradicts"),
        ("tasks-mixed:demos", "several tasks"),
        ("reversed:demos", "backwards in time"),
        ("jump-0.5m:demos", "tracking was lost, or the rate is wrong"),
    ],
)
def test_demonstrations_that_do_not_belong_together_are_refused(demonstrations, fault, words):
    with pytest.raises((DemonstrationError, GeometryError), match=words):
        check_demonstrations(FAULTS[fault].demonstrations(demonstrations)).raise_if_wrong()


def test_depth_that_is_missing_where_the_gripper_works_or_a_thing_may_be_is_told(report, demonstrations, scene):
    blind = FAULTS["no-depth-at-grasps:demos"].demonstrations
    count = len(demonstrations)
    for some, severity in ((demonstrations, "warning"), (demonstrations[:1], "unchecked")):
        shown = [*blind(some), *demonstrations[len(some) :]]
        (hole,) = [finding for finding in check_demonstrations(shown).findings if finding.kind == "hole"]
        assert hole.severity == severity
        assert f"in {len(some)} of {count} demonstrations" in hole.message
    found = report.check_observation(FAULTS["no-depth-on-a-thing:scene"].scene(scene, demonstrations))
    (hole,) = [finding for finding in found if finding.kind == "hole"]
    assert hole.severity == "warning"
    assert re.search(r"a hole, \d+ mm wide, at pixel \(\d+, \d+\)", hole.message)


def test_demonstrations_that_would_take_days_at_their_rate_are_told(demonstrations):
    slow = check_demonstrations(FAULTS["rate-0.001:demos"].demonstrations(demonstrations))
    assert any("is the rate right?" in note for note in slow.notes)


@pytest.mark.parametrize(("fault", "words"), [("depth-8-bit:scene", "8 bits"), ("grey:scene", "infrared")])
def test_images_that_lost_what_the_camera_saw_are_told(report, scene, fault, words):
    assert any(words in str(finding) for finding in report.check_observation(FAULTS[fault].scene(scene, ())))


def test_what_the_camera_did_not_see_is_told_in_one_sentence(report, scene):
    half, none = np.array(scene.depth), np.full_like(scene.depth, np.nan)
    half[:, : half.shape[1] // 2] = np.nan
    for changed, words in (
        (replace(scene, rgb=np.zeros_like(scene.rgb)), "the colour image is all the same"),
        (replace(scene, depth=half), "depth is missing or unsteady in [45]\\d% of the scenery"),
        (replace(scene, depth=none), "the depth image has no readings; check the camera's depth stream"),
    ):
        (found,) = errors(report.check_observation(changed))
        assert re.match(words, found.message)


def test_states_inverted_while_pushing_are_doubted(demonstrations):
    inverted = FAULTS["state-inverted:demos"].demonstrations(demonstrations)
    assert any("are its states inverted" in note for note in check_demonstrations(inverted).notes)
    assert not any("inverted" in note for note in check_demonstrations(demonstrations).notes)


def block(middle, size=(0.12, 0.04, 0.05)):
    """A camera 0.6 m above a table with a block on it."""
    intrinsics = np.array([[300.0, 0, 99.5], [0, 300, 99.5], [0, 0, 1]])
    pose = make_pose(np.diag([1.0, -1, -1]), (0, 0, 0.6))
    rows, cols = np.mgrid[:200, :200]
    top = 0.6 - size[2]
    x, y = (cols - 99.5) * top / 300 - middle[0], -(rows - 99.5) * top / 300 - middle[1]
    inside = (np.abs(x) < size[0] / 2) & (np.abs(y) < size[1] / 2)
    grain = np.random.default_rng(0).integers(90, 160, (200, 200, 1), dtype=np.uint8)
    rgb = np.where(inside[..., None], np.uint8([200, 40, 40]), grain)
    return Observation(rgb, np.where(inside, top, 0.6).astype(np.float32), intrinsics, pose)


def grasps(by=(0.0, 0.0, 0.0), count=8):
    """Blocks at several places, each grasped from above; the paths displaced ``by`` metres."""
    found = []
    for index, middle in enumerate(np.random.default_rng(1).uniform(-0.08, 0.08, (count, 2))):
        above, low = np.array([*middle, 0.15]) + by, np.array([*middle, 0.02]) + by
        places = np.concatenate([np.linspace([0.3, 0.3, 0.3], above, 15), np.linspace(above, low, 15)])
        places = np.concatenate([places, np.repeat(low[None], 5, axis=0), np.linspace(low, above, 10)])
        poses = np.stack([make_pose(np.diag([1.0, -1, -1]), place) for place in places])
        trajectory = Trajectory.from_poses(poses, np.arange(len(places)) >= 30, GripperTriangle(0.15, 0.08))
        found.append(Demonstration(block(middle), trajectory, 20.0, "grasp", index))
    return found


def test_grasps_beside_or_above_what_the_image_shows_are_doubted():
    def doubts(by):
        return [f.message for f in check_demonstrations(grasps(by)).findings if f.kind == "grasp"]

    assert not doubts((0, 0, 0))
    assert not doubts((0.02, 0, 0))  # along the fingers' faces: as good a grasp as any
    assert re.search("whose middle lies 2[3-7] mm beside the gripper's", doubts((0, 0.025, 0))[0])
    assert "above or beside a surface" in doubts((0, 0, 0.04))[0]


def test_paths_into_a_hole_contradict_nothing_and_one_that_reaches_deeper_is_told():
    def lowered(shown, hole, below=0.05):
        """Into a hole around the block, whose middle the image shows ``hole`` metres beside it."""
        x, y = shown.trajectory.triplets[30, 0, 1:, :2].mean(axis=0)
        rows, cols = np.mgrid[:200, :200] * 0.6 / 300 - 99.5 * 0.6 / 300
        inside = (np.abs(cols - x) < 0.09) & (np.abs(-rows - y - hole) < 0.09) & (shown.observation.depth > 0.59)
        depth = np.where(inside, np.float32(0.7), shown.observation.depth)
        actions = shown.trajectory.actions.copy()
        actions[:, [2, 5, 8]] -= below * np.clip((0.15 - actions[:, [5]]) / 0.13, 0, 1)
        trajectory = Trajectory(actions, shown.trajectory.times)
        return replace(shown, observation=replace(shown.observation, depth=depth), trajectory=trajectory)

    shown = [lowered(one, 0.14 if index == 3 else 0.0) for index, one in enumerate(grasps(count=5))]
    assert check_demonstrations(shown).findings == ()
    deeper = grasps(count=5)[3]
    beside = deeper.trajectory.triplets[30, 0, 1:, :2].mean(axis=0) + np.array([0.05, 0.0])
    shown[3] = lowered(replace(deeper, observation=block(beside)), 0.14, below=0.08)
    (told,) = (one for one in check_demonstrations(shown).findings if one.kind == "contradiction")
    assert told.severity == "warning"


@pytest.mark.parametrize("count", [3, 4])
def test_one_of_few_demonstrations_that_does_not_show_the_thing_contradicts_the_others(count):
    shown = grasps(count=count)
    assert not check_demonstrations(shown).findings
    depth = shown[1].observation.depth
    empty = replace(shown[1].observation, depth=np.full_like(depth, depth.max()))
    for observation, words in ((empty, "shows nothing above"), (block((0.2, 0.2), (0.05, 0.05, 0.05)), "no nearer")):
        with pytest.raises(DemonstrationError, match=f"demonstration 1 contradicts the others: .*{words}"):
            check_demonstrations([shown[0], replace(shown[1], observation=observation), *shown[2:]]).raise_if_wrong()


def test_one_of_two_demonstrations_that_shows_nothing_is_told():
    shown = grasps(count=2)
    assert not check_demonstrations(shown).findings
    depth = shown[1].observation.depth
    empty = replace(shown[1].observation, depth=np.full_like(depth, depth.max()))
    report = check_demonstrations([shown[0], replace(shown[1], observation=empty)])
    assert not errors(report.findings)
    assert any("demonstration 1 fits its image worse" in note for note in report.notes)


def test_surroundings_that_repeat_little_but_only_with_their_own_image_are_no_error():
    rng = np.random.default_rng(0)
    shown = []
    for one in grasps():
        middle = one.trajectory.triplets[30, 0, 1:, :2].mean(axis=0) + rng.uniform(-0.04, 0.04, 2)
        shown.append(replace(one, observation=block(middle, (*rng.uniform(0.03, 0.07, 2), 0.05))))
    assert not errors(check_demonstrations(shown).findings)


def test_a_plan_beside_the_demonstrated_place_of_a_thing_is_measured():
    demonstrations = grasps(count=9)
    new, shown = demonstrations[0], demonstrations[1:]
    views = [View.of(one.observation) for one in shown]
    surroundings = Surroundings.of(views, np.stack([one.trajectory.actions for one in shown]))
    assert surroundings.precision < 0.01
    view, actions = View.of(new.observation), new.trajectory.actions
    assert surroundings.displacement(view, actions) < 0.01
    beside = actions.copy()
    beside[:, [0, 3, 6]] += 0.024
    assert surroundings.displacement(view, beside) == pytest.approx(0.024, abs=0.007)


def test_too_few_demonstrations_measure_no_displacement():
    few = grasps(count=2)
    surroundings = Surroundings.of(
        [View.of(one.observation) for one in few], np.stack([one.trajectory.actions for one in few])
    )
    assert np.isnan(surroundings.precision)
    assert np.isnan(surroundings.displacement(View.of(few[0].observation), few[0].trajectory.actions))


def test_which_of_two_arms_is_which_is_told_to_be_unchecked():
    two = [
        replace(one, trajectory=Trajectory.from_actions(np.tile(one.trajectory.actions, (1, 2)))) for one in grasps()
    ]
    assert any("which arm is which was not checked" in note for note in check_demonstrations(two).notes)


def test_grippers_that_never_close_are_doubted(demonstrations):
    held_open = states(lambda state: state * 0)(demonstrations)
    told = [str(finding) for finding in check_demonstrations(held_open).findings]
    assert any("no gripper opens or closes" in line for line in told)
    assert not any("no gripper opens" in str(finding) for finding in check_demonstrations(demonstrations).findings)


def test_demonstrations_of_one_scene_say_that_others_lie_outside(demonstrations, scene):
    report = check_demonstrations(FAULTS["one-scene:demos"].demonstrations(demonstrations))
    assert not errors(report.findings)
    assert any("one scene" in note for note in report.notes)
    assert report.reference.scene_spread_m < 0.001


def test_copies_of_one_demonstration_do_not_make_another_scene_a_moved_camera(demonstrations):
    noise = CameraNoise()
    first, second = (noise.photograph(one.observation, i) for i, one in enumerate(demonstrations[:2]))
    report = check_demonstrations([replace(demonstrations[0], observation=first)] * 3)
    assert not errors(report.check_observation(second))


def test_what_was_demonstrated_lies_inside_its_own_envelope(report, demonstrations):
    for demonstration in demonstrations:
        assert report.envelope.check(downsample(demonstration.trajectory)) == ()


@pytest.mark.parametrize("fault", [name for name in FAULTS if name.endswith(":plan") and name != "too-low-3cm:plan"])
def test_a_plan_outside_the_envelope_is_refused_with_the_step_and_the_limit(report, demonstrations, fault):
    plan = FAULTS[fault].plan(downsample(demonstrations[0].trajectory))
    with pytest.raises(EnvelopeError):
        report.envelope.require(plan)
    assert all(np.isfinite(finding.numbers["limit"]) for finding in report.envelope.check(plan))


def test_the_command_tells_what_is_wrong_with_a_scene(workbench, scene, tmp_path: Path, capsys):
    demos = str(workbench / "data" / "push-cube")
    assert main(["check", "--demos", demos, "--observation", str(workbench / "observation.npz")]) == 0
    wrong = tmp_path / "wrong.npz"
    FAULTS["inverse-pose:scene"].scene(scene, ()).save(wrong)
    assert main(["check", "--demos", demos, "--observation", str(wrong)]) == 1
    assert "inverse camera pose" in capsys.readouterr().out
