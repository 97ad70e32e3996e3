"""The start-of-episode image and depth as lossless PNG files."""

import io
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from robust_instant_policy.datasets.layout import REPAIR
from robust_instant_policy.demonstration import MAX_PIXELS
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.files import open_regular

FINE_UNIT_M = 1e-4  # one step of 16-bit depth; reaches 6.5 m
COARSE_UNIT_M = 1e-3  # for cameras that read further; reaches 65.5 m
MAX_STEPS = np.iinfo(np.uint16).max


# Pillow's errors for damaged content and for too many declared pixels.
DAMAGE = (OSError, SyntaxError, EOFError, struct.error, Image.DecompressionBombError, Image.DecompressionBombWarning)


def encode_image(image: NDArray | Image.Image, form: str = "png", **options: Any) -> bytes:
    """A file of an RGB image ``(H, W, 3)`` uint8, or of a grey one ``(H, W)`` uint16, with Pillow's ``options``."""
    buffer = io.BytesIO()
    picture = image if isinstance(image, Image.Image) else Image.fromarray(np.ascontiguousarray(image))
    picture.save(buffer, format=form, **options)
    return buffer.getvalue()


def encode_depth(depth: NDArray[np.float32]) -> tuple[bytes, float]:
    """16-bit PNG of ``depth (H, W)`` metres, and the metres per step.

    No reading (NaN, infinity, zero or less) becomes 0. Raises `DatasetError` for depth beyond the
    range of 16 bits with a resolution of a millimetre.
    """
    metres = np.asarray(depth, dtype=np.float64)
    valid = np.isfinite(metres) & (metres > 0)
    furthest = float(metres[valid].max(initial=0.0))
    unit = FINE_UNIT_M if furthest <= MAX_STEPS * FINE_UNIT_M else COARSE_UNIT_M
    if furthest > MAX_STEPS * unit:
        raise DatasetError(
            f"depth has values up to {furthest:.1f} m; at most {MAX_STEPS * unit:.1f} m can be stored; "
            "set pixels beyond the workspace to NaN"
        )
    steps = np.zeros(metres.shape, dtype=np.uint16)
    steps[valid] = np.clip(np.rint(metres[valid] / unit), 1, MAX_STEPS).astype(np.uint16)
    return encode_image(steps), unit


def millimetres(depth: NDArray) -> NDArray[np.uint16]:
    """``depth (H, W)`` metres in whole millimetres, as most cameras give it; 0 where there is no reading, and beyond
    `MAX_STEPS`."""
    steps = np.rint(np.nan_to_num(np.asarray(depth, dtype=np.float64), posinf=0.0, neginf=0.0) * 1000)
    return np.where((steps > 0) & (steps <= MAX_STEPS), steps, 0).astype(np.uint16)


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """RGB image ``(H, W, 3)`` uint8."""
    return np.asarray(_open(path).convert("RGB"))


def read_depth(path: Path, unit: float) -> NDArray[np.float32]:
    """Depth ``(H, W)`` float32 metres, NaN where there is no reading."""
    image = _open(path)
    if image.mode != "I;16":
        raise DatasetError(f"{path} must be a depth image of 16 bits, got {image.mode}: {REPAIR}")
    steps = np.asarray(image).astype(np.float64)
    steps[steps == 0] = np.nan
    with np.errstate(over="ignore"):  # of a unit beyond any camera
        return (steps * unit).astype(np.float32)


def _open(path: Path) -> Image.Image:
    try:
        with open_regular(path) as file:
            return decode_image(file.read(), ("PNG",))
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path} cannot be read as an image: {REPAIR}") from error


def decode_image(content: bytes, formats: tuple[str, ...]) -> Image.Image:
    """The image in a file's ``content``; raises `ValueError` for another format and for damaged content."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(content), formats=formats)
        if image.width * image.height > MAX_PIXELS:
            raise ValueError(f"it declares {image.width} x {image.height} pixels")
        image.load()
        return image
    except DAMAGE as error:
        raise ValueError(f"it is not a {' or '.join(formats)} image") from error
