"""Calibration recovers known cameras and tools from computed photographs and touches, and names the usual mistakes."""

import tomllib
from dataclasses import asdict, replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from robust_instant_policy.errors import CalibrationError, RobotError
from robust_instant_policy.geometry import invert_pose, make_pose, transform_points
from robust_instant_policy.robots.calibration import (
    Board,
    calibrate_tool,
    check_camera,
    in_hand,
    on_table,
    pivot,
    touched_place,
)
from robust_instant_policy.robots.calibration.board_pose import board_pose
from robust_instant_policy.robots.camera import Frame
from robust_instant_policy.robots.cell import read_camera_pose, read_gripper
from tests.charuco import INTRINSICS, error_of, facing, photograph

BOARD = Board()
CAMERA = make_pose(Rotation.from_euler("xyz", [180, 3, -91], degrees=True).as_matrix(), [-0.05, 0.01, 0.85])
ON_TABLE = make_pose(Rotation.from_euler("z", 100, degrees=True).as_matrix(), [0.05, -0.1, 0.0])  # board -> world
MOUNTING = make_pose(Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix(), [0.02, 0.03, 0.1])


def seen(pose, rng, board=BOARD):
    """The frame of a board at ``pose`` board -> camera."""
    rgb, depth = photograph(board, pose, rng)
    return Frame(rgb, depth, INTRINSICS, 0.0)


@pytest.fixture(scope="module")
def table():
    """Frames of the board at five places on the table, and its first corners as touched, with 0.5 mm of error."""
    rng = np.random.default_rng(0)
    places = [ON_TABLE] + [
        make_pose(Rotation.from_euler("z", yaw, degrees=True).as_matrix(), [x, y, 0.0])
        for x, y, yaw in [(-0.25, -0.3, 10), (-0.2, 0.2, -20), (0.1, 0.15, 30), (0.15, 0.0, 80)]
    ]
    frames = [seen(invert_pose(CAMERA) @ place, rng) for place in places]
    return frames, transform_points(ON_TABLE, BOARD.outer_corners) + rng.normal(0, 0.0005, (4, 3))


@pytest.fixture(scope="module")
def held():
    """Frames of the board in the hand at a dozen poses, and the hand's poses, with 0.2 mm and 0.02 degrees of error."""
    rng = np.random.default_rng(1)
    boards = [facing(BOARD, rng) for _ in range(12)]
    hands = np.stack([CAMERA @ board @ invert_pose(MOUNTING) for board in boards])
    hands[:, :3, 3] += rng.normal(0, 0.0002, (12, 3))
    hands[:, :3, :3] = hands[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0, 0.0003, (12, 3))).as_matrix()
    return [seen(board, rng) for board in boards], hands


def test_a_board_is_located_within_a_millimetre_and_a_quarter_of_a_degree():
    rng = np.random.default_rng(2)
    for _ in range(8):
        pose = facing(BOARD, rng)
        distance, angle = error_of(board_pose(BOARD.find(seen(pose, rng).rgb), INTRINSICS), pose)
        assert distance < 1.0
        assert angle < 0.25  # a board seen from straight above says little of its tilt


def test_a_board_on_the_table_gives_the_camera(table):
    frames, touched = table
    result = on_table("realsense 1", frames, BOARD, touched_place(touched, BOARD))
    _, angle = error_of(result.pose, CAMERA)
    assert angle < 0.1
    on_the_table = transform_points(invert_pose(CAMERA), [[x, y, 0] for x in (-0.2, 0.2) for y in (-0.2, 0.2)])
    wrong = transform_points(result.pose, on_the_table) - transform_points(CAMERA, on_the_table)
    assert np.linalg.norm(wrong, axis=1).max() < 0.0015
    assert len(result.left_out_mm) == 4
    assert max(result.left_out_mm) < 1
    assert max(result.touched_mm) < 2
    assert result.depth_scale == pytest.approx(1, abs=0.01)


def test_a_board_in_the_hand_gives_the_camera(held):
    frames, hands = held
    result = in_hand("realsense 1", frames, hands, BOARD)
    distance, angle = error_of(result.pose, CAMERA)
    assert distance < 1.0
    assert angle < 0.1
    assert max(result.left_out_mm) < 1.5
    assert result.reprojection_px < 0.3


def test_a_calibration_file_is_read_back_and_serves_the_cell(table, tmp_path):
    frames, touched = table
    result = on_table("realsense 1", frames, BOARD, touched_place(touched, BOARD))
    result.save(tmp_path / "camera.toml")
    np.testing.assert_array_equal(read_camera_pose(tmp_path / "camera.toml"), result.pose)
    assert tomllib.loads((tmp_path / "camera.toml").read_text())["board"] == asdict(BOARD)
    check_camera(tmp_path / "camera.toml", "realsense 1", frames[0])
    with pytest.raises(RobotError, match="realsense 2 is connected; run rip calibrate camera"):
        check_camera(tmp_path / "camera.toml", "realsense 2", frames[0])
    wider = replace(frames[0], intrinsics=INTRINSICS * np.array([[0.75], [1], [1]]))
    with pytest.raises(RobotError, match="another crop"):
        check_camera(tmp_path / "camera.toml", "realsense 1", wider)


def test_a_square_of_another_size_is_told_with_the_size_that_would_agree(table):
    frames, touched = table
    wrong = replace(BOARD, square_m=0.030, marker_m=0.030 * BOARD.marker_m / BOARD.square_m)
    with pytest.raises(CalibrationError, match=r"1\.1\d+ times .* squares of 30 mm.* (34\.9|35\.\d) mm would agree"):
        touched_place(touched, wrong)
    place = replace(touched_place(touched, BOARD), pose=ON_TABLE)
    with pytest.raises(CalibrationError, match=r"squares of 30 mm has: .* with (34\.9|35\.\d) mm both would agree"):
        on_table("c", frames, wrong, place)


@pytest.mark.parametrize(("factor", "words"), [(1000, "in millimetres"), (1.2, "a square is 1.2"), (0.001, "square")])
def test_an_arm_in_other_units_is_told_by_the_hand(held, factor, words):
    frames, hands = held
    moved = hands.copy()
    moved[:, :3, 3] *= factor
    with pytest.raises(CalibrationError, match=words):
        in_hand("c", frames, moved, BOARD)


def test_a_hand_that_turns_about_one_axis_or_gives_degrees_or_moves_too_little_is_told(held):
    frames, hands = held
    degrees = hands.copy()
    degrees[:, :3, :3] = Rotation.from_rotvec(
        np.radians(Rotation.from_matrix(hands[:, :3, :3]).as_rotvec())
    ).as_matrix()
    with pytest.raises(CalibrationError, match="about one axis only"):
        in_hand("c", frames, degrees, BOARD)
    mixed = hands[np.roll(np.arange(12), 1)]
    with pytest.raises(CalibrationError, match="turned by different angles"):
        in_hand("c", frames, mixed, BOARD)
    with pytest.raises(CalibrationError, match="3 poses of the board are too few"):
        in_hand("c", frames[:3], hands[:3], BOARD)


def test_depth_in_millimetres_is_told(table):
    frames, touched = table
    millimetres = [replace(frame, depth=frame.depth * 1000) for frame in frames]
    with pytest.raises(CalibrationError, match="it is in millimetres"):
        on_table("c", millimetres, BOARD, touched_place(touched, BOARD))


def test_touches_in_another_order_or_unit_are_told(table):
    _, touched = table
    with pytest.raises(CalibrationError, match="mirrored order"):
        touched_place(touched[[1, 0, 3, 2]], BOARD)
    with pytest.raises(CalibrationError, match="off the board's rectangle"):
        touched_place(touched[[0, 2, 1, 3]], BOARD)
    with pytest.raises(CalibrationError, match="in millimetres"):
        touched_place(touched * 1000, BOARD)
    with pytest.raises(CalibrationError, match="horizontal"):
        touched_place(touched @ Rotation.from_euler("x", 60, degrees=True).as_matrix().T, BOARD)


def test_too_few_places_or_ones_close_together_are_told(table):
    frames, touched = table
    with pytest.raises(CalibrationError, match="3 places of the board are too few"):
        on_table("c", frames[:3], BOARD, touched_place(touched, BOARD))
    with pytest.raises(CalibrationError, match="towards the corners of the image"):
        on_table("c", frames[:1] * 4, BOARD, touched_place(touched, BOARD))


def test_mirrored_images_and_other_boards_are_told_by_name(table):
    frames, _ = table
    rgb = frames[0].rgb
    with pytest.raises(CalibrationError, match="mirrored"):
        BOARD.find(np.ascontiguousarray(rgb[:, ::-1]))
    with pytest.raises(CalibrationError, match="dictionary 4X4_50, not 6X6_250"):
        replace(BOARD, dictionary="6X6_250").find(rgb)
    with pytest.raises(CalibrationError, match="do not form a board of 5 x 7"):
        replace(BOARD, columns=5, rows=7).find(rgb)
    with pytest.raises(CalibrationError, match="no board was found"):
        BOARD.find(np.full_like(rgb, 128))


def test_intrinsics_of_another_resolution_are_told(held):
    frames, hands = held
    tilted = [replace(frame, intrinsics=INTRINSICS * np.array([[2.0], [2.0], [1.0]])) for frame in frames]
    with pytest.raises(CalibrationError, match="intrinsics are of another resolution"):
        in_hand("c", tilted, hands, BOARD)


@pytest.mark.parametrize("kind", ["png", "pdf"])
def test_the_printed_page_has_the_stated_size_and_is_found(kind, tmp_path):
    path = tmp_path / f"board.{kind}"
    path.write_bytes(BOARD.page(kind))
    if kind == "pdf":
        assert path.read_bytes().startswith(b"%PDF")
        return
    page = Image.open(path)
    view = BOARD.find(np.array(page.convert("RGB")))
    assert len(view.ids) == (BOARD.columns - 1) * (BOARD.rows - 1)
    across = np.ptp(view.pixels[:, 0]) / page.info["dpi"][0] * 0.0254
    assert across == pytest.approx((BOARD.columns - 2) * BOARD.square_m, rel=1e-3)


TOOL = make_pose(Rotation.from_euler("xyz", [2, -1, 3], degrees=True).as_matrix(), [0.002, -0.001, 0.003])
TIPS = transform_points(TOOL, [[0, 0.035, 0], [0, -0.035, 0]])  # in the frame of the model's tool


def touches(tip, rng, directions=8, tilt=40.0, noise=0.0003):
    """Hand poses at which ``tip (3,)`` of the hand's frame is at one point of the world."""
    turns = Rotation.from_euler("xyz", rng.uniform(-tilt, tilt, (directions, 3)), degrees=True).as_matrix()
    point = np.array([0.1, 0.2, 0.05]) + rng.normal(0, noise, (directions, 3))
    return np.stack([make_pose(turn, at - turn @ tip) for turn, at in zip(turns, point, strict=True)])


def test_touching_a_point_with_both_fingers_gives_the_tool_frame_and_the_opening(tmp_path):
    rng = np.random.default_rng(4)
    first, second = (pivot(touches(tip, rng)) for tip in TIPS)
    result = calibrate_tool("left", first, second, 0.1537, closed_travel=0.0, open_travel=0.0345)
    distance, angle = error_of(result.tool, TOOL)
    assert distance < 1.0
    assert angle < 2.5  # the turn about the line between the fingertips is the model's
    assert result.opening == pytest.approx(0.07, abs=0.001)
    assert max(result.left_out_mm) < 2.0
    result.save(tmp_path / "gripper.toml")
    assert read_gripper(tmp_path / "gripper.toml")[0].length == pytest.approx(0.1567, abs=0.001)


def test_touches_that_do_not_determine_the_tip_are_told():
    rng = np.random.default_rng(5)
    with pytest.raises(CalibrationError, match="tilt the gripper"):
        pivot(touches(TIPS[0], rng, tilt=5))
    with pytest.raises(CalibrationError, match="touches are too few"):
        pivot(touches(TIPS[0], rng, directions=3))
    hands = touches(TIPS[0] + [0, 0, 0.1], rng)
    hands[:, :3, 3] *= 1000
    with pytest.raises(CalibrationError, match="in millimetres"):
        pivot(hands)
    first, second = (pivot(touches(tip, rng)) for tip in TIPS)
    with pytest.raises(CalibrationError, match="did not move"):
        calibrate_tool("left", first, second, 0.15, 0.03, 0.0301)
    with pytest.raises(CalibrationError, match="touch first with the finger on the side of y"):
        calibrate_tool("left", second, first, 0.15, 0.0, 0.035)
    with pytest.raises(CalibrationError, match="first with one finger and then with the other"):
        calibrate_tool("left", first, first, 0.15, 0.0, 0.035)
