"""The file of a cell: what it says arrives, and a wrong line is named."""

import numpy as np
import pytest

from robust_instant_policy.errors import CellError, UnreachableError
from robust_instant_policy.motion.guard import check_home
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.models import arm_of
from tests.robots_cells import arms_of

CELL = """
[cell]
turn_per_step = 45
workspace = [[-0.30, -0.32, -0.005], [0.22, 0.32, 0.40]]

[[arms]]
name = "left"
model = "viperx-300"
base = [-0.469, 0, 0, 0, 0, 90]
park = [-1.4, -0.43, 0.434, 0.0, 1.567, 0.0]
gripper = "gripper.toml"
driver = { kind = "viperx", port = "/dev/ttyDXL" }
joint_speed = 1.5

[camera]
kind = "realsense"
calibration = "camera.toml"
serial = "123"
"""


@pytest.fixture
def cell(tmp_path):
    (tmp_path / "gripper.toml").write_text("length = 0.15\nopening = 0.07\n")
    (tmp_path / "camera.toml").write_text(f"pose = {np.diag([1.0, -1, -1, 1]).tolist()}\n")
    path = tmp_path / "cell.toml"
    path.write_text(CELL)
    return path


def test_a_cell_is_read_with_its_calibration_and_gripper(cell):
    config = CellConfig.load(cell)
    (arm,) = config.arms
    assert (arm.gripper.length, arm.gripper.opening) == (0.15, 0.07)
    np.testing.assert_allclose(arm.base[:3, 0], [0, 1, 0], atol=1e-12)
    assert config.limits.turn_per_step == pytest.approx(np.pi / 4)
    assert arm.joint_speed == 1.5
    assert arm.driver.section().text("port") == "/dev/ttyDXL"
    np.testing.assert_array_equal(config.camera_pose, np.diag([1.0, -1, -1, 1]))
    assert config.camera.section().text("serial") == "123"


def test_another_calibration_or_gripper_has_another_digest(cell):
    before = CellConfig.load(cell).digest
    (cell.parent / "gripper.toml").write_text("length = 0.16\nopening = 0.07\n")
    assert CellConfig.load(cell).digest != before


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("park = [", "prak = [", "park is missing"),
        ("-0.32, -0.005]", "-0.32]", "workspace must be 2 x 3 numbers"),
        ("[0.22, 0.32, 0.40]", "[-0.4, 0.32, 0.40]", "workspace must be the lower and then the upper corner"),
        ("[0.22, 0.32, 0.40]", "[0.22, nan, 0.40]", "workspace must be 2 x 3 finite numbers"),
        ("[0.22, 0.32, 0.40]", "[0.22, 0.32, 400]", "workspace must be in metres: 400"),
        ("[-0.30, -0.32, -0.005], [0.22, 0.32, 0.40]", "[0, 0, -1], [1, 1, 0]", "must reach above the table"),
        ("joint_speed = 1.5", "joint_speed = -1", "joint_speed must be a number from 0.001 to 6.28"),
        ("joint_speed = 1.5", "joint_speed = 3", "left: joint_speed is 3, a viperx-300 has at most 2.51; lower it"),
        ("turn_per_step = 45", "rate_hz = 0", "rate_hz must be a number from 20 to 500"),
        ("turn_per_step = 45", "execute_hz = 1000", "execute_hz must be a number from 0.1 to 50"),
        ("turn_per_step = 45", "table_depth = 10", "table_depth must be a number from 0 to 0.05"),
        ("turn_per_step = 45", 'name = "../cell"', "name must be letters, digits"),
        ("-0.43, 0.434", "-24, 0.434", "park turns joint 2 to -24 rad, its range is"),
        ("[-0.469,", "[-469,", "base must begin with x, y, z in metres"),
        ('"viperx",', '"ur5e",', "kind must be viperx or lerobot for a viperx-300"),
        (
            'DXL" }',
            'DXL" }\nleader = { kind = "aloha", port = "/dev/ttyDXL" }',
            "driver of left and the leader of left have",
        ),
        ("joint_speed = 1.5", "joint_sped = 1.5", "joint_sped is not known here; is it misspelt"),
        ('model = "viperx-300"', "model = 3", "model must be text"),
        ("[cell]", "[cell", "is not a TOML file"),
        ("[cell]", "[sell]", r"lacks the table \[cell\]; docs/robots.md shows"),
        ("[[arms]]", "[[legs]]", r"lacks the table \[\[arms\]\]"),
        ('"gripper.toml"', '"other.toml"', "no file at"),
    ],
)
def test_a_wrong_line_is_named(cell, old, new, words):
    cell.write_text(CELL.replace(old, new))
    with pytest.raises(CellError, match=words):
        arm_of(CellConfig.load(cell).arms[0], cell.parent)


@pytest.mark.parametrize(
    ("rotation", "height", "words"),
    [
        ([1, 1, -1], 0.8, "no right-handed rotation"),
        ([1, -1, -1], 800, "must be in metres"),
        ([1, -1, -1], -0.8, "must not be below the table"),
    ],
)
def test_a_camera_that_is_mirrored_in_millimetres_or_below_the_table_is_refused(cell, rotation, height, words):
    pose = np.diag([*rotation, 1.0])
    pose[2, 3] = height
    (cell.parent / "camera.toml").write_text(f"pose = {pose.tolist()}\n")
    with pytest.raises(CellError, match=words):
        CellConfig.load(cell)


def test_a_park_pose_at_the_table_is_refused(cell):
    cell.write_text(CELL.replace("-1.4, -0.43, 0.434, 0.0, 1.567, 0.0", "0.0, 1.0, 0.5, 0.0, 0.5, 0.0"))
    arms, limits = arms_of(cell)
    with pytest.raises(UnreachableError, match=r"the park pose is refused \(left.* below the table"):
        check_home(arms, limits, 50.0)
