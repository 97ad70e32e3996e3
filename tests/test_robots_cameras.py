"""Cameras: the RealSense reader on the SDK's software device, LeRobot's shape, and a folder."""

import itertools
import sys
import threading
import time

import numpy as np
import pytest

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import CellError, RobotError, UsageError
from robust_instant_policy.robots.calibration import Board
from robust_instant_policy.robots.calibration.board_pose import reprojection_px
from robust_instant_policy.robots.cameras import LeRobotCamera, RealSenseCamera, RecordedCamera, make_camera
from robust_instant_policy.robots.cameras.realsense import sdk
from robust_instant_policy.robots.cell import DeviceConfig
from tests.charuco import photograph

rs = pytest.importorskip("pyrealsense2")

WIDTH, HEIGHT = 640, 480
FOCAL = 600.0
CENTRE = (319.5, 239.5)
INTRINSICS = np.array([[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]])
BASELINE_M = 0.015  # between the depth and the colour module
DISTORTION = [0.12, -0.25, 0.001, -0.001, 0.05]


class SoftwareDevice:
    """A device of the SDK whose frames the test supplies, sent at about 100 Hz until `stop`.

    ``image()`` returns rgb ``(H, W, 3)`` uint8 and depth ``(H, W)`` uint16 in ``unit`` metres. ``one_module`` has both
    streams on one sensor, as a D405 has.
    """

    def __init__(self, image, unit=0.001, distortion=(0.0,) * 5, one_module=False, depth_focal=FOCAL):
        self.image, self.unit, self.sending, self.number = image, unit, True, 0
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.serial_number, "012345")
        depth = self.device.add_sensor("Stereo Module")
        color = depth if one_module else self.device.add_sensor("RGB Camera")
        self.lens = self._lens(FOCAL, list(distortion))
        self.streams = [
            (depth, depth.add_video_stream(self._stream(0, self._lens(depth_focal, [0.0] * 5))), 2),
            (color, color.add_video_stream(self._stream(1, self.lens)), 3),
        ]
        depth.add_read_only_option(rs.option.depth_units, unit)
        depth.add_read_only_option(rs.option.stereo_baseline, 55.0)
        between = rs.extrinsics()
        between.rotation, between.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [BASELINE_M, 0, 0]
        self.streams[0][1].register_extrinsics_to(self.streams[1][1], between)
        self.device.create_matcher(rs.matchers.default)
        self.thread = threading.Thread(target=self._send, daemon=True)
        self.thread.start()

    def stop(self):
        self.sending = False
        self.thread.join()

    def _send(self):
        while self.sending:
            self.number += 1
            rgb, depth = self.image()
            for (sensor, profile, size), pixels in zip(self.streams, (depth, rgb), strict=True):
                frame = rs.software_video_frame()
                frame.stride, frame.bpp, frame.pixels = WIDTH * size, size, pixels
                frame.timestamp, frame.domain = self.number * 33.0, rs.timestamp_domain.hardware_clock
                frame.frame_number, frame.profile = self.number, profile.as_video_stream_profile()
                if size == 2:
                    frame.depth_units = self.unit
                sensor.on_video_frame(frame)
            time.sleep(0.01)

    @staticmethod
    def _lens(focal, distortion):
        lens = rs.intrinsics()
        lens.width, lens.height, lens.ppx, lens.ppy, lens.fx, lens.fy = WIDTH, HEIGHT, *CENTRE, focal, focal
        lens.model, lens.coeffs = rs.distortion.inverse_brown_conrady, distortion
        return lens

    @staticmethod
    def _stream(index, lens):
        stream = rs.video_stream()
        stream.type, stream.fmt = [(rs.stream.depth, rs.format.z16), (rs.stream.color, rs.format.rgb8)][index]
        stream.index, stream.uid, stream.bpp = 0, index, [2, 3][index]
        stream.width, stream.height, stream.fps, stream.intrinsics = WIDTH, HEIGHT, 30, lens
        return stream


NOISE = np.random.default_rng(0).integers(-2, 3, (5, HEIGHT, WIDTH, 3), dtype=np.int16)
TURN = itertools.count()


def noisy(rgb):
    return np.clip(rgb + NOISE[next(TURN) % len(NOISE)], 0, 255).astype(np.uint8)


def grey():
    return noisy(np.full((HEIGHT, WIDTH, 3), 120)), np.full((HEIGHT, WIDTH), 800, np.uint16)


@pytest.fixture
def connected():
    """A function that connects a camera to a software device; both are stopped after the test."""
    opened = []

    def connect(image, timeout_s=20.0, **facts):  # the device's thread shares the processor with others
        device = SoftwareDevice(image, **facts)
        opened.append(device)
        camera = RealSenseCamera(device=device.device, timeout_s=timeout_s)
        camera.connect()
        opened.append(camera)
        return camera, device

    yield connect
    for one in reversed(opened):
        one.disconnect() if isinstance(one, RealSenseCamera) else one.stop()


@pytest.mark.parametrize("one_module", [False, True], ids=["D415", "D405"])
def test_depth_is_in_metres_and_aligned_to_the_colour_image(connected, one_module):
    depth = np.full((HEIGHT, WIDTH), 8000, np.uint16)
    depth[:, 240:280] = 6000  # a post in the depth module's image

    camera, _ = connected(lambda: (grey()[0], depth), unit=0.0001, one_module=one_module, depth_focal=480.0)
    frame = camera.read()
    assert camera.name == "realsense 012345"
    assert frame.depth.dtype == np.float32
    np.testing.assert_array_equal(frame.intrinsics, INTRINSICS)
    row = frame.depth[HEIGHT // 2]
    near = np.flatnonzero(np.abs(row - 0.6) < 0.003)
    expected = [FOCAL * ((u - CENTRE[0]) / 480 * 0.6 + BASELINE_M) / 0.6 + CENTRE[0] for u in (240, 280)]
    assert near[0] == pytest.approx(expected[0], abs=3)
    assert near[-1] == pytest.approx(expected[1], abs=3)
    assert np.median(row[400:600]) == pytest.approx(0.8, abs=0.001)
    assert np.abs(camera.preview() - 120.0).max() <= 2  # the colour image alone


def test_each_image_is_taken_after_the_call_and_has_a_later_time(connected):
    camera, device = connected(grey)
    first = camera.read()
    number = device.number
    second = camera.read()
    assert second.timestamp > first.timestamp
    assert second.timestamp * 1e3 / 33 > number - 1


def test_the_distortion_of_the_lens_is_undone(connected):
    board = Board()
    pose = np.array([[1, 0, 0, -0.2], [0, -1, 0, 0.15], [0, 0, -1, 0.55], [0, 0, 0, 1.0]])
    straight, _ = photograph(board, pose, np.random.default_rng(0), INTRINSICS)
    lens = SoftwareDevice._lens(FOCAL, DISTORTION)
    coarse = np.array(
        [
            [rs.rs2_deproject_pixel_to_point(lens, [float(u), float(v)], 1.0)[:2] for u in range(0, WIDTH, 8)]
            for v in range(0, HEIGHT, 8)
        ]
    )
    import cv2
    from scipy.interpolate import RectBivariateSpline

    rows, columns = np.arange(0, HEIGHT, 8), np.arange(0, WIDTH, 8)
    x, y = (RectBivariateSpline(rows, columns, coarse[..., i])(np.arange(HEIGHT), np.arange(WIDTH)) for i in (0, 1))
    bent = cv2.remap(
        straight,
        (x * FOCAL + CENTRE[0]).astype(np.float32),
        (y * FOCAL + CENTRE[1]).astype(np.float32),
        cv2.INTER_CUBIC,
    )
    camera, _ = connected(lambda: (noisy(bent), grey()[1]), distortion=DISTORTION)
    bent_error, straight_error = (
        reprojection_px(board.find(image), pose, INTRINSICS) for image in (bent, camera.read().rgb)
    )
    assert bent_error > 1.0
    assert straight_error < 0.3


def test_an_unplugged_and_a_frozen_camera_are_told(connected):
    camera, device = connected(grey, timeout_s=4.0)
    camera.read()
    still = grey()
    device.image = lambda: still
    camera.read()
    with pytest.raises(RobotError, match="012345 repeats the same image"):
        camera.read()
    device.stop()
    with pytest.raises(RobotError, match="no new pair of colour and depth for 4 s: check the cable"):
        camera.read()


def test_a_stream_that_the_camera_lacks_is_told_with_those_it_has():
    device = SoftwareDevice(grey)
    try:
        with pytest.raises(RobotError, match=r"no depth stream of 1280 x 720 .* offers: 640 x 480 at 30 Hz"):
            RealSenseCamera(width=1280, height=720, device=device.device).connect()
    finally:
        device.stop()


def test_a_camera_that_is_not_there_is_told():
    with pytest.raises(RobotError, match="no RealSense camera 999; none is connected"):
        RealSenseCamera("999").connect()


class Shape:
    """A depth camera of LeRobot's shape."""

    def connect(self):
        self.is_connected = True

    def read(self):
        return grey()[0]

    async_read = read

    def read_depth(self):
        return grey()[1]

    def disconnect(self):
        self.is_connected = False


def test_a_system_library_that_is_missing_is_named(monkeypatch, tmp_path):
    (tmp_path / "pyrealsense2.py").write_text("raise ImportError('libusb-1.0.so.0: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pyrealsense2")
    with pytest.raises(UsageError, match=r"libusb-1\.0\.so\.0.* apt install libusb-1.0-0"):
        sdk()


def test_a_lerobot_camera_is_read_in_metres_and_only_with_aligned_depth():
    camera = LeRobotCamera("top", Shape(), INTRINSICS, aligned=True)
    camera.connect()
    frame = camera.read()
    assert frame.depth.dtype == np.float32
    assert frame.depth.max() == pytest.approx(0.8)
    with pytest.raises(RobotError, match=r"no depth that is aligned"):
        LeRobotCamera("top", Shape(), INTRINSICS, aligned=False).connect()


def test_a_lerobot_camera_that_repeats_its_image_is_frozen():
    device = Shape()
    camera = LeRobotCamera("top", device, INTRINSICS, aligned=True)
    camera.connect()
    rng = np.random.default_rng(0)
    device.read = lambda: rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    for _ in range(2):
        last = camera.read().rgb
    device.read = lambda: last
    with pytest.raises(RobotError, match="top repeats the same image: it is frozen"):
        camera.read()


def test_a_folder_is_replayed_in_order_and_ends(tmp_path):
    rgb, depth = grey()
    for index in (1, 0):
        rgb[0, 0] = index
        Observation(rgb, depth * np.float32(1e-3), INTRINSICS, np.eye(4)).save(tmp_path / f"{index}.npz")
    camera = make_camera(DeviceConfig("folder", {"path": tmp_path.name}, "cell.toml: camera"), tmp_path.parent)
    camera.connect()
    assert [camera.read().rgb[0, 0, 0] for _ in range(2)] == [0, 1]
    with pytest.raises(RobotError, match=r"2 images .* are used up"):
        camera.read()
    with pytest.raises(RobotError, match=r"holds no \.npz file"):
        RecordedCamera(tmp_path / "nothing").connect()


def test_a_wrong_description_of_a_camera_is_named(tmp_path):
    with pytest.raises(CellError, match="kind must be one of realsense, lerobot, folder, emulated, not 'kinect'"):
        make_camera(DeviceConfig("kinect", {}, "cell.toml: camera"), tmp_path)
    with pytest.raises(CellError, match="widht is not known here"):
        make_camera(DeviceConfig("realsense", {"widht": 640}, "cell.toml: camera"), tmp_path)
    with pytest.raises(CellError, match="factory must be module:function"):
        make_camera(DeviceConfig("lerobot", {"factory": "nowhere:camera"}, "cell.toml: camera"), tmp_path)
