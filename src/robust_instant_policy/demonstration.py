"""What the camera saw and what the person did."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tokenize import TokenError
from types import MappingProxyType

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from robust_instant_policy.errors import DatasetError, InvalidValueError
from robust_instant_policy.files import write_whole
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.trajectory import Trajectory

FARTHEST_CAMERA_M = 50.0  # from the origin of the world; farther, it is not in metres


@dataclass(frozen=True, eq=False)
class Observation:
    """One RGB-D image with its calibrated camera.

    ``rgb (H, W, 3)`` uint8; ``depth (H, W)`` float32 metres along the optical axis, NaN or 0 where there is
    no reading; ``intrinsics (3, 3)``; ``camera_pose (4, 4)`` camera to world, OpenCV axes.
    Raises `InvalidValueError` for anything else.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    intrinsics: FloatArray
    camera_pose: FloatArray

    def __post_init__(self) -> None:
        rgb = np.array(self.rgb)  # a copy: a camera's driver may write the next image into the same memory
        if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
            raise InvalidValueError(f"rgb must be (H, W, 3) uint8, got {rgb.shape} {rgb.dtype}")
        depth = np.array(self.depth, dtype=np.float32)
        if depth.shape != rgb.shape[:2]:
            raise InvalidValueError(f"depth must be {rgb.shape[:2]} like the image, got {depth.shape}")
        intrinsics = np.array(self.intrinsics, dtype=np.float64)
        camera_pose = np.array(self.camera_pose, dtype=np.float64)
        if intrinsics.shape != (3, 3) or not np.isfinite(intrinsics).all():
            raise InvalidValueError(f"intrinsics must be (3, 3) and finite, got {intrinsics.shape}")
        if camera_pose.shape != (4, 4) or not np.isfinite(camera_pose).all():
            raise InvalidValueError(f"camera_pose must be (4, 4) and finite, got {camera_pose.shape}")
        rotation = camera_pose[:3, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
            raise InvalidValueError("camera_pose (4, 4) must hold a proper rotation")
        if not np.allclose(camera_pose[3], [0, 0, 0, 1], atol=1e-6):
            raise InvalidValueError("the last row of camera_pose (4, 4) must be 0 0 0 1; is it transposed?")
        if np.abs(camera_pose[:3, 3]).max() > FARTHEST_CAMERA_M:
            raise InvalidValueError(f"camera_pose puts the camera at {camera_pose[:3, 3]}; is that in metres?")
        for name, value in (
            ("rgb", rgb),
            ("depth", depth),
            ("intrinsics", intrinsics),
            ("camera_pose", camera_pose),
        ):
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    @classmethod
    def load(cls, path: str | Path) -> Observation:
        """Read an ``.npz`` file that holds arrays named like the fields; raises `DatasetError` in one line."""
        names = ("rgb", "depth", "intrinsics", "camera_pose")
        try:
            loaded = np.load(path, allow_pickle=False)
            if not isinstance(loaded, NpzFile):
                raise ValueError
            with loaded as arrays:
                missing = [name for name in names if name not in arrays]
                if missing:
                    raise DatasetError(
                        f"{path} lacks {', '.join(missing)}; an observation is an .npz with {', '.join(names)}"
                    )
                return cls(*(arrays[name] for name in names))
        except FileNotFoundError:
            raise DatasetError(f"no observation at {path}") from None
        except InvalidValueError as error:
            raise DatasetError(f"{path}: {error}") from None
        except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, TokenError):
            raise DatasetError(f"{path} is not an .npz file with {', '.join(names)}") from None

    def save(self, path: str | Path) -> None:
        """Write the observation as an ``.npz`` file that `load` reads."""
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer, rgb=self.rgb, depth=self.depth, intrinsics=self.intrinsics, camera_pose=self.camera_pose
        )
        write_whole(Path(path), buffer.getvalue())


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One episode: the observation at its start, the gripper's trajectory, and what is known about it.

    ``rate_hz`` is the recording rate, so the episode lasted ``(len(trajectory) - 1) / rate_hz`` seconds.
    ``info`` holds further facts worth keeping (strings and numbers only). ``frames()`` reads the images
    ``(H, W, 3)`` uint8 along the way, one for each step of the trajectory, where they were recorded.
    """

    observation: Observation
    trajectory: Trajectory
    rate_hz: float
    task: str = ""
    seed: int | None = None
    info: Mapping[str, str | float | int] = field(default_factory=lambda: MappingProxyType({}))
    frames: Callable[[], Iterator[NDArray[np.uint8]]] | None = field(default=None, repr=False)

    @property
    def seconds(self) -> float:
        return (len(self.trajectory) - 1) / self.rate_hz
