"""Videos of whole episodes, in the H.264 that `lerobot` and every browser decode."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.datasets.layout import REPAIR
from robust_instant_policy.demonstration import MAX_PIXELS
from robust_instant_policy.errors import DatasetError, InvalidValueError
from robust_instant_policy.files import open_regular, write_whole

CODEC = "libx264"
PIXEL_FORMAT = "yuv420p"
X264_OPTIONS = {
    "preset": "veryfast",  # a third of the default's time for a slightly larger file
    "crf": "18",  # visually lossless; lower is better and larger
    "g": "10",  # frames from one key frame to the next; training reads frames at random
    "bf": "0",  # no frames out of order
    # The lookahead's macroblock tree makes a few of a hundred encodings of the same images differ in some bytes.
    "mbtree": "0",
    "rc-lookahead": "0",
}
FILM_OPTIONS = {"preset": "veryfast", "crf": "26"}  # for videos in pages: a tenth of the size
MAX_RATE_DENOMINATOR = 1001  # as in 30000/1001 Hz


class VideoEncoder:
    """Encodes images ``(H, W, 3)`` uint8, H and W even, one by one as MP4.

    Equal images give equal bytes, and frame t has the time t / rate. ``options`` are x264's: `X264_OPTIONS` for
    images that are data, `FILM_OPTIONS` for videos in pages.
    """

    def __init__(self, rate_hz: float, options: Mapping[str, str] = X264_OPTIONS):
        self._rate = Fraction(rate_hz).limit_denominator(MAX_RATE_DENOMINATOR)  # for the clock of the video
        self._buffer = io.BytesIO()
        self._container = av.open(self._buffer, "w", format="mp4")
        self._stream = self._container.add_stream(CODEC, rate=self._rate)
        self._stream.pix_fmt = PIXEL_FORMAT
        self._stream.codec_context.time_base = 1 / self._rate
        self._stream.codec_context.thread_count = 1
        self._stream.options = dict(options)
        self.num_images = 0

    def add(self, image: NDArray[np.uint8]) -> None:
        """Append an image. Raises `InvalidValueError` unless it has the size of the first one."""
        height, width = image.shape[:2]
        if self.num_images == 0:
            self._stream.width, self._stream.height = width, height
        if image.dtype != np.uint8 or image.shape != (self._stream.height, self._stream.width, 3):
            raise InvalidValueError(
                f"a video needs images of one size, (H, W, 3) uint8, got {image.shape} {image.dtype}"
            )
        if height % 2 or width % 2:
            raise InvalidValueError(f"a video needs images of even height and width, got {width} x {height} pixels")
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame.pts = self.num_images
        frame.time_base = 1 / self._rate
        self._container.mux(self._stream.encode(frame))
        self.num_images += 1

    def finish(self) -> bytes:
        """The complete video; ends the encoding."""
        if self.num_images:
            self._container.mux(self._stream.encode(None))
        self._container.close()
        return self._buffer.getvalue() if self.num_images else b""


class VideoWriter:
    """Writes a video to ``path`` at the end of the ``with`` block; without images, an existing file is removed.

    Raises `DatasetError` where it cannot be written.

    >>> with VideoWriter("run.mp4", fps=20) as video:
    ...     task.execute(trajectory, on_frame=video.add)
    """

    def __init__(self, path: str | Path, fps: float):
        self._path = Path(path)
        self._encoder = VideoEncoder(fps)
        self.add = self._encoder.add

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, *_: object) -> None:
        content = self._encoder.finish()
        if content:
            write_whole(self._path, content)
        else:
            self._path.unlink(missing_ok=True)


def encode_video(images: NDArray[np.uint8], rate_hz: float) -> bytes:
    """MP4 of ``images (T, H, W, 3)`` uint8, T at least 1, H and W even."""
    encoder = VideoEncoder(rate_hz)
    for image in images:
        encoder.add(image)
    return encoder.finish()


def decode_video(
    path: Path, start_s: float = 0.0, stop_s: float = float("inf"), pixel_format: str = "rgb24"
) -> Iterator[NDArray]:
    """Frames ``(H, W, 3)`` uint8 of ``path`` shown within ``[start_s, stop_s)``, or in another ``pixel_format``.

    Raises `DatasetError` for a missing file or another format.
    """
    try:
        # As a file object and as MP4 only: other formats of FFmpeg may refer to other files and addresses.
        with open_regular(path) as file, av.open(file, format="mp4") as container:
            stream = container.streams.video[0]
            if stream.width * stream.height > MAX_PIXELS:
                raise DatasetError(f"{path} declares images of {stream.width} x {stream.height} pixels, too large")
            half_frame = float(1 / (2 * stream.average_rate))
            container.seek(int(start_s / stream.time_base), stream=stream)
            for frame in container.decode(stream):
                if frame.time >= stop_s - half_frame:
                    return
                if (frame.width, frame.height) != (stream.width, stream.height):
                    raise DatasetError(f"{path} holds images of several sizes: {REPAIR}")
                if frame.time >= start_s - half_frame:
                    yield frame.to_ndarray(format=pixel_format)
    # For data that a damaged file lacks, PyAV returns None or has no such attribute.
    except (
        OSError, ValueError, LookupError, TypeError, AttributeError, AssertionError, ArithmeticError, MemoryError,
        RuntimeError, av.FFmpegError,
    ) as error:  # fmt: skip
        raise DatasetError(f"{path} cannot be read as a video: {REPAIR}") from error
