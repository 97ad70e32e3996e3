"""Intel RealSense D400 cameras, through pyrealsense2.

stereo module ─ depth ─┐                ┌ disparity ─ spatial ─ temporal ─ depth ─┐
                       ├ syncer ─ pair ─┤                                         ├ align to colour ─ undistort ─ Frame
colour module ─ rgb  ──┘                └─────────────────────────────────────────┘

The temporal filter starts anew with each `read`, so that no image is mixed with one from before the arm moved.
"""

import contextlib
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from robust_instant_policy.errors import RobotError, needs_extra
from robust_instant_policy.robots.calibration.board import opencv
from robust_instant_policy.robots.camera import Frame, check_alive

WARM_UP_FRAMES = 30  # until exposure and white balance are stable: 1 s
BURST = 6  # frames that the temporal filter combines
TIMEOUT_S = 1.0  # without a new pair of frames
MAX_MODULE_GAP = 0.6  # of a frame interval, between colour and depth of a pair
GRID_PX = 16  # on which the lens's distortion is evaluated
STRAIGHT_PX = 0.05  # distortion below it is not undone


class RealSenseCamera:
    """A D415, D405, D435 or D455; see `robots.camera.Camera`.

    ``serial`` empty takes the only one connected. A ``device`` of the SDK may be given instead of a serial number.
    `read` waits for a new pair of frames for ``timeout_s``.
    """

    def __init__(
        self,
        serial: str = "",
        width: int = 640,
        height: int = 480,
        rate_hz: int = 30,
        device: Any | None = None,
        timeout_s: float = TIMEOUT_S,
    ):
        self.name = f"realsense {serial}".strip()
        self._serial, self._device, self._timeout_s = serial, device, timeout_s
        self._width, self._height, self._rate_hz = width, height, rate_hz
        self._sensors: list[Any] = []
        self._last = (-1, -1)  # numbers of the last depth and colour frame
        self._before: NDArray[np.uint8] | None = None

    def connect(self) -> None:
        rs = sdk()
        device = self._device if self._device is not None else _find(rs, self._serial)
        self.name = f"realsense {_info(rs, device, rs.camera_info.serial_number)}".strip()
        self._syncer, self._align = rs.syncer(), rs.align(rs.stream.color)
        modules = list(device.query_sensors())
        chosen = [
            self._profile(modules, rs.stream.depth, rs.format.z16),
            self._profile(modules, rs.stream.color, rs.format.rgb8),
        ]
        self._intrinsics = chosen[1][1].as_video_stream_profile().get_intrinsics()
        self._maps = _undistortion(rs, self._intrinsics)
        try:
            # A D405 has both streams on one module, which must be opened with both.
            for index in sorted({index for index, _ in chosen}):
                modules[index].open([profile for owner, profile in chosen if owner == index])
                self._sensors.append(modules[index])
            for sensor in self._sensors:
                sensor.start(self._syncer)
            for _ in range(WARM_UP_FRAMES):
                self._pair()
        except RuntimeError as error:
            self.disconnect()
            raise RobotError(f"{self.name} cannot be started: {error}; is another program using it?") from None
        except BaseException:
            self.disconnect()
            raise

    def read(self) -> Frame:
        rs = sdk()
        to_disparity, to_depth = rs.disparity_transform(True), rs.disparity_transform(False)
        spatial, temporal = rs.spatial_filter(), rs.temporal_filter()
        self._drain()
        for _ in range(BURST):
            pair = self._pair()
            for stage in (to_disparity, spatial, temporal, to_depth):
                pair = stage.process(pair).as_frameset()
        aligned = self._align.process(pair).as_frameset()
        depth, color = aligned.get_depth_frame(), aligned.get_color_frame()
        rgb = np.array(color.get_data())
        metres = np.asarray(depth.get_data()) * np.float32(depth.get_units())
        check_alive(self.name, rgb, self._before)
        self._before = rgb
        if self._maps is not None:
            cv2, (columns, rows) = opencv(), self._maps
            rgb = cv2.remap(rgb, columns, rows, cv2.INTER_LINEAR)
            metres = cv2.remap(metres, columns, rows, cv2.INTER_NEAREST)
        lens = self._intrinsics
        intrinsics = np.array([[lens.fx, 0, lens.ppx], [0, lens.fy, lens.ppy], [0, 0, 1.0]])
        return Frame(rgb, metres.astype(np.float32), intrinsics, color.get_timestamp() / 1e3)

    def preview(self) -> NDArray[np.uint8]:
        self._drain()
        return np.array(self._pair().get_color_frame().get_data())

    def disconnect(self) -> None:
        for sensor in self._sensors:
            for close in (sensor.stop, sensor.close):
                with contextlib.suppress(RuntimeError):  # unplugged
                    close()
        self._sensors = []

    def _profile(self, modules: Sequence[Any], stream: Any, format: Any) -> tuple[int, Any]:
        """Index of the module and stream profile of the wanted size and rate."""
        sizes = set()
        for index, sensor in enumerate(modules):
            for profile in sensor.get_stream_profiles():
                if profile.stream_type() != stream or profile.format() != format:
                    continue
                video = profile.as_video_stream_profile()
                size = (video.width(), video.height(), profile.fps())
                if size == (self._width, self._height, self._rate_hz):
                    return index, profile
                sizes.add(size)
        offered = ", ".join("{} x {} at {} Hz".format(*size) for size in sorted(sizes)) or "none"
        raise RobotError(
            f"{self.name} has no {stream.name} stream of {self._width} x {self._height} at {self._rate_hz} Hz (USB 2 "
            f"has few); it offers: {offered}"
        )

    def _drain(self) -> None:
        """Drop what arrived before the call."""
        while self._syncer.poll_for_frames():
            pass

    def _pair(self) -> Any:
        """The next frameset with new frames of both streams, taken at one time."""
        deadline = time.monotonic() + self._timeout_s
        while (left := deadline - time.monotonic()) > 0:
            found, frames = self._syncer.try_wait_for_frames(max(round(left * 1e3), 1))
            if not found:
                break
            depth, color = frames.get_depth_frame(), frames.get_color_frame()
            if not (depth and color):
                continue
            numbers = depth.get_frame_number(), color.get_frame_number()
            apart = abs(depth.get_timestamp() - color.get_timestamp())
            repeated = any(number == last for number, last in zip(numbers, self._last, strict=True))
            if repeated or apart > MAX_MODULE_GAP * 1e3 / self._rate_hz:
                continue
            self._last = numbers
            return frames
        raise RobotError(
            f"{self.name} has sent no new pair of colour and depth for {self._timeout_s:g} s: check the cable and the "
            "USB 3 port, then connect again"
        )


def sdk() -> Any:
    """The module ``pyrealsense2``; raises `MissingExtraError` or `RobotError` where it cannot be imported."""
    with needs_extra("robots", library="libusb-1.0-0"):
        import pyrealsense2
    return pyrealsense2


def _find(rs: Any, serial: str) -> Any:
    """The connected device with a serial number, or the only one."""
    devices = list(rs.context().query_devices())
    numbers = [_info(rs, device, rs.camera_info.serial_number) for device in devices]
    if serial in numbers:
        return devices[numbers.index(serial)]
    if not serial and len(devices) == 1:
        return devices[0]
    present = f"connected: {', '.join(numbers)}" if numbers else "none is connected (lsusb shows Intel devices as 8086)"
    raise RobotError(f"no RealSense camera{' ' + serial if serial else ' is chosen by serial'}; {present}")


def _info(rs: Any, device: Any, what: Any) -> str:
    return device.get_info(what) if device.supports(what) else ""


def _undistortion(rs: Any, lens: Any) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """For each pixel of the straight image, where to look in the camera's, ``(H, W)`` columns and rows; or None.

    The SDK maps pixels to rays for each of its lens models; the inverse is found by fixed-point iteration on a spline
    of the displacements.
    """
    if lens.model == rs.distortion.modified_brown_conrady and any(lens.coeffs):
        raise RobotError(
            "this camera's lens model, modified Brown-Conrady, cannot be undone; use another colour stream"
        )
    rows, columns = (np.unique([*range(0, size, GRID_PX), size - 1]) for size in (lens.height, lens.width))
    moved = np.zeros((2, len(rows), len(columns)))
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            x, y, _ = rs.rs2_deproject_pixel_to_point(lens, [float(column), float(row)], 1.0)
            moved[:, i, j] = x * lens.fx + lens.ppx - column, y * lens.fy + lens.ppy - row
    if np.abs(moved).max() < STRAIGHT_PX:
        return None
    to_right, to_below = (RectBivariateSpline(rows, columns, one) for one in moved)
    straight_row, straight_column = np.meshgrid(rows.astype(float), columns.astype(float), indexing="ij")
    row, column = straight_row, straight_column
    for _ in range(8):
        row, column = straight_row - to_below.ev(row, column), straight_column - to_right.ev(row, column)
    every = np.arange(lens.height), np.arange(lens.width)
    column, row = (RectBivariateSpline(rows, columns, one)(*every).astype(np.float32) for one in (column, row))
    return column, row
