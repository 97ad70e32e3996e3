"""Videos of whole episodes, in the H.264 that `lerobot` and every browser decode."""

from __future__ import annotations

import io
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.errors import DatasetError, InvalidValueError

CODEC = "libx264"
PIXEL_FORMAT = "yuv420p"
QUALITY_CRF = "18"  # visually lossless; lower is better and larger
KEYFRAME_INTERVAL = "10"  # frames; training reads frames at random
MAX_RATE_DENOMINATOR = 1001  # as in 30000/1001 Hz


def rate_fraction(rate_hz: float) -> Fraction:
    """The rate as the ratio that a video's clock needs."""
    return Fraction(rate_hz).limit_denominator(MAX_RATE_DENOMINATOR)


def encode_video(images: NDArray[np.uint8], rate_hz: float) -> bytes:
    """MP4 of ``images (T, H, W, 3)`` uint8, H and W even.

    One thread and no reordered frames: the same images give the same bytes on every machine, and frame t
    is shown at exactly t / rate.
    """
    count, height, width, _ = images.shape
    if count == 0 or height % 2 or width % 2:
        raise InvalidValueError(f"a video needs at least one image of even height and width, got {images.shape}")
    rate = rate_fraction(rate_hz)
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream(CODEC, rate=rate)
        stream.width, stream.height, stream.pix_fmt = width, height, PIXEL_FORMAT
        stream.codec_context.time_base = 1 / rate
        stream.codec_context.thread_count = 1
        stream.options = {"crf": QUALITY_CRF, "g": KEYFRAME_INTERVAL, "bf": "0"}
        for step, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts = step
            frame.time_base = 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return buffer.getvalue()


def decode_video(path: Path, start_s: float = 0.0, stop_s: float = float("inf")) -> Iterator[NDArray[np.uint8]]:
    """Frames ``(H, W, 3)`` uint8 of ``path`` shown within ``[start_s, stop_s)``.

    Raises `DatasetError` for a file that is not there or not a video.
    """
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            half_frame = float(1 / (2 * stream.average_rate))
            container.seek(int(start_s / stream.time_base), stream=stream)
            for frame in container.decode(stream):
                if frame.time >= stop_s - half_frame:
                    return
                if frame.time >= start_s - half_frame:
                    yield frame.to_ndarray(format="rgb24")
    except (OSError, ValueError, IndexError) as error:
        raise DatasetError(f"{path} cannot be read as a video: restore it, or record the folder again") from error
