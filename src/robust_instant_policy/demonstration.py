"""An RGB-D observation, and a demonstration."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from robust_instant_policy.checks import checked_array, checked_pose, checked_positive
from robust_instant_policy.errors import DatasetError, InvalidValueError
from robust_instant_policy.files import UNREADABLE_NPZ, npz, open_regular, write_whole
from robust_instant_policy.geometry import FloatArray, as_numbers, lift
from robust_instant_policy.trajectory import Trajectory

FARTHEST_CAMERA_M = 50.0  # from the origin of the world; farther, it is not in metres
MAX_PIXELS = 2**25  # of an image; one of 7680 x 4320 has fewer
FOCAL_LENGTHS = (0.01, 1000.0)  # times the larger edge of the image: fields of view of 179 and 0.06 degrees
MAX_SKEW = 1e-3  # of the focal length; pixels of real cameras are rectangular
MAX_ARRAY_BYTES = 8 * MAX_PIXELS  # depth in float64
ARRAYS = ("rgb", "depth", "intrinsics", "camera_pose")  # of an observation file


@dataclass(frozen=True, eq=False)
class Observation:
    """One RGB-D image with its calibrated camera.

    ``rgb (H, W, 3)`` uint8; ``depth (H, W)`` float32 metres along the optical axis, NaN or 0 where there is
    no reading (infinite and negative values become NaN); ``intrinsics (3, 3)`` in pixels, ``[[fx, 0, cx], [0, fy, cy],
    [0, 0, 1]]``; ``camera_pose (4, 4)`` camera to world, OpenCV axes.
    Raises `InvalidValueError` for anything else.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    intrinsics: FloatArray
    camera_pose: FloatArray

    def __post_init__(self) -> None:
        rgb = np.array(self.rgb)  # a copy: a camera's driver may write the next image into the same memory
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or rgb.size == 0:
            raise InvalidValueError(f"rgb must be (H, W, 3) uint8, not empty, got {rgb.shape} {rgb.dtype}")
        depth = as_numbers("depth", self.depth, np.float32)
        if depth.shape != rgb.shape[:2]:
            raise InvalidValueError(f"depth must be {rgb.shape[:2]} like the image, got {depth.shape}")
        depth[np.isinf(depth) | (depth < 0)] = np.nan
        intrinsics = checked_array("intrinsics", self.intrinsics, "(3, 3)")
        _check_intrinsics(intrinsics, *rgb.shape[:2])
        camera_pose = checked_pose("camera_pose", self.camera_pose)
        if np.abs(camera_pose[:3, 3]).max() > FARTHEST_CAMERA_M:
            raise InvalidValueError(f"camera_pose puts the camera at {camera_pose[:3, 3]}; is that in metres?")
        arrays: tuple[NDArray, ...] = (rgb, depth, intrinsics, camera_pose)
        for name, value in zip(ARRAYS, arrays, strict=True):
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    def points(self, most: int | None = None) -> tuple[FloatArray, NDArray[np.uint8]]:
        """The points ``(N, 3)`` of all pixels with depth, metres, world, and their colours ``(N, 3)``; evenly thinned
        out to at ``most`` so many."""
        rows, columns = np.nonzero(self.depth > 0)
        every = 1 if most is None else max(1, -(-len(rows) // most))
        rows, columns = rows[::every], columns[::every]
        pixels = np.column_stack([columns, rows])
        return lift(pixels, self.depth[rows, columns], self.intrinsics, self.camera_pose), self.rgb[rows, columns]

    @classmethod
    def load(cls, path: str | Path) -> Observation:
        """Read an ``.npz`` file that holds arrays named like the fields; raises `DatasetError` in one line.

        What the file declares is checked before memory is reserved for it; nothing is unpickled.
        """
        try:
            with open_regular(path) as file:
                return cls.read(file, path)
        except FileNotFoundError:
            raise DatasetError(f"no file at {path}; an observation is an .npz with {', '.join(ARRAYS)}") from None

    @classmethod
    def read(cls, file: BinaryIO, name: str | Path) -> Observation:
        """`load` from an open ``.npz`` file, called ``name`` in errors."""
        try:
            with zipfile.ZipFile(file) as archive:
                missing = [array for array in ARRAYS if f"{array}.npy" not in archive.namelist()]
                if missing:
                    raise DatasetError(
                        f"{name} lacks {', '.join(missing)}; an observation is an .npz with {', '.join(ARRAYS)}"
                    )
                return cls(*(_read_array(archive, array) for array in ARRAYS))
        except InvalidValueError as error:
            raise DatasetError(f"{name}: {error}") from None
        except UNREADABLE_NPZ:
            raise DatasetError(f"{name} is not an .npz file with {', '.join(ARRAYS)}") from None

    def save(self, path: str | Path) -> None:
        """Write the observation as an ``.npz`` file that `load` reads."""
        write_whole(Path(path), self.npz())

    def npz(self) -> bytes:
        """The content of such a file."""
        return npz({name: getattr(self, name) for name in ARRAYS})


def _check_intrinsics(intrinsics: FloatArray, height: int, width: int) -> None:
    """Raises `InvalidValueError` unless they are those of a pinhole camera with an image of this size in pixels."""
    (fx, skew, cx), (other_skew, fy, cy), last = intrinsics
    if not np.allclose(last, [0, 0, 1], atol=1e-6):
        raise InvalidValueError("the last row of intrinsics (3, 3) must be 0 0 1; is it transposed?")
    if fx <= 0 or fy <= 0:
        raise InvalidValueError(f"the focal lengths of intrinsics (3, 3) must be positive, got fx {fx:g}, fy {fy:g}")
    shortest, longest = (factor * max(height, width) for factor in FOCAL_LENGTHS)
    if not (shortest <= min(fx, fy) and max(fx, fy) <= longest):
        raise InvalidValueError(
            f"the focal lengths of intrinsics (3, 3) must be in pixels, from {shortest:g} to {longest:g} for {width} x "
            f"{height}, got fx {fx:g}, fy {fy:g}"
        )
    if max(abs(skew), abs(other_skew)) > MAX_SKEW * min(fx, fy):
        raise InvalidValueError(f"intrinsics (3, 3) have a skew of {skew or other_skew:g}; rectify the image first")
    if not (-width <= cx <= 2 * width and -height <= cy <= 2 * height):
        raise InvalidValueError(
            f"intrinsics (3, 3) put the principal point at ({cx:g}, {cy:g}) of an image of {width} x {height} pixels; "
            "are they another camera's, or of another resolution?"
        )


def _read_array(archive: zipfile.ZipFile, name: str) -> NDArray:
    """One array of an ``.npz``; raises `InvalidValueError` for one of an odd type or size, before it is read."""
    entry = archive.getinfo(f"{name}.npy")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # the two that NumPy writes
        raise InvalidValueError(f"{name} is compressed in a way that NumPy does not write")
    with archive.open(entry) as stream:
        version = npy.read_magic(stream)
        read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[version]
        shape, fortran_order, dtype = read_header(stream)
        if dtype.kind not in "biuf":
            raise InvalidValueError(f"{name} must hold real numbers, got {dtype}")
        num_bytes = math.prod(shape) * dtype.itemsize
        if len(shape) > 3 or min(shape, default=1) < 0 or num_bytes > MAX_ARRAY_BYTES:
            raise InvalidValueError(f"{name} must be an image or a matrix, its header says {str(shape)[:80]} {dtype}")
        content = stream.read(num_bytes)
    if len(content) != num_bytes:
        raise InvalidValueError(f"{name} is cut short")
    return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran_order else "C")


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One episode: the observation at its start, the gripper's trajectory, and what is known about it.

    ``rate_hz`` is the recording rate, so the episode lasted ``(len(trajectory) - 1) / rate_hz`` seconds.
    ``info`` holds further facts worth keeping (strings and numbers only). ``frames()`` reads the images
    ``(H, W, 3)`` uint8 along the way, one for each step of the trajectory, where they were recorded.
    Raises `InvalidValueError` for a rate that is not finite and positive.
    """

    observation: Observation
    trajectory: Trajectory
    rate_hz: float
    task: str = ""
    seed: int | None = None
    info: Mapping[str, str | float | int] = field(default_factory=lambda: MappingProxyType({}))
    frames: Callable[[], Iterator[NDArray[np.uint8]]] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        checked_positive("rate_hz", self.rate_hz)

    @property
    def seconds(self) -> float:
        return (len(self.trajectory) - 1) / self.rate_hz
