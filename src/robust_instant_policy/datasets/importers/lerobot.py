"""LeRobot v3 datasets whose frames carry end-effector poses, or joint positions and a URDF.

The format does not store the camera's intrinsics and pose or the meaning of gripper values, so the user supplies them.
Which features hold poses and grippers, see `lerobot_poses`.
"""

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from robust_instant_policy.datasets import coded_depth, layout
from robust_instant_policy.datasets.folder import Folder, open_folder
from robust_instant_policy.datasets.images import decode_image
from robust_instant_policy.datasets.importers.depth import PIXEL_FORMAT, dequantised, is_depth, unit_of
from robust_instant_policy.datasets.importers.lerobot_poses import grippers_in, poses_in
from robust_instant_policy.datasets.importers.source import Rig, SourceEpisode, choose_camera
from robust_instant_policy.datasets.importers.timing import even_steps, held, resampled, seconds_of
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.files import excerpt
from robust_instant_policy.geometry import FloatArray, as_numbers

ADVICE = (
    "A LeRobot dataset names the axes of a pose ee.x, ee.y, ee.z and a rotation (ee.wx …, rx …, roll …, qx … qw), or "
    "the rig says where it is (pose_key, rotation) or how to compute it (joints: urdf, link), and which feature holds "
    "the depth (depth_key, depth_unit_m)"
)


def read_lerobot(path: Path, rig: Rig) -> Iterator[SourceEpisode]:
    """The episodes of a LeRobot v3 dataset."""
    folder = open_folder(path)
    if (path / layout.RIP_PATH).exists():
        raise DatasetError(f"{path} is already a demonstrations folder of rip; read it with load_demonstrations")
    features = folder.info["features"]
    for key in (rig.depth_key, rig.pose_key):
        if key is not None and key not in features:
            raise DatasetError(f"{path} has no feature {key!r}; it has: {excerpt(', '.join(features))}")
    images = [key for key, feature in features.items() if feature["dtype"] in ("video", "image")]
    cameras = [key for key in images if key != rig.depth_key and not is_depth(features[key])]
    camera = choose_camera(path, cameras, rig.camera)
    depth_key = rig.depth_key or _depth_stream(features, camera)
    for episode in range(len(folder.episodes)):
        poses, gripper = poses_in(folder, episode, rig), grippers_in(folder, episode, rig)
        rgb = None if camera is None else _first_image(folder, episode, camera)
        depth = None if depth_key is None else _first_depth(folder, episode, depth_key, rig.depth_unit_m)
        name = f"{path} (episode {episode})"
        tasks = told if isinstance(told := folder.episodes[episode].get("tasks"), list) else []
        frames = np.arange(folder.episodes[episode]["length"])
        seconds = None if rig.rate_hz is not None else _seconds(folder, episode, name)
        if seconds is not None:
            times = even_steps(seconds, folder.rate_hz)
            frames = held(seconds, times)
            poses = None if poses is None else resampled(poses, seconds, times)
            gripper = None if gripper is None else gripper[frames]
        yield SourceEpisode(
            name=name,
            rgb=rgb,
            depth=depth,
            poses=poses,
            gripper_values=gripper,
            rate_hz=folder.rate_hz,
            images=partial(_images, folder, episode, camera, frames) if camera in folder.video_keys else None,
            info={"source": path.name, "episode": episode, "description": "; ".join(map(str, tasks))},
            advice=ADVICE if poses is None or depth is None else "",
        )


def _seconds(folder: Folder, episode: int, name: str) -> FloatArray | None:
    if "timestamp" not in folder.info["features"]:
        return None
    stamps = folder.matrix(episode, "timestamp")[:, 0]
    if folder.info["features"]["timestamp"]["dtype"] == "float32" and len(stamps) > 1:
        step = np.spacing(np.abs(stamps).max().astype(np.float32))
        if step > 0.5 * np.ptp(stamps) / (len(stamps) - 1):  # as for times of day: too coarse for frames
            return None
    return seconds_of(name, stamps, folder.rate_hz)


def _images(folder: Folder, episode: int, key: str, frames: NDArray[np.intp]) -> NDArray[np.uint8]:
    return np.stack(list(folder.frames(episode, key)))[frames]


def _depth_stream(features: Mapping[str, Any], camera: str | None) -> str | None:
    """The depth stream of ``camera``, or the only one."""
    streams = [key for key, feature in features.items() if is_depth(feature)]
    own = [key for key in streams if key == f"{camera}_depth"]
    return (own or streams)[0] if len(own or streams) == 1 else None


def _first_depth(folder: Folder, episode: int, key: str, unit_m: float | None) -> NDArray[np.float32]:
    """Depth ``(H, W)``, or ``(H·W,)`` where it is stored so, metres, of the first frame."""
    feature = folder.info["features"][key]
    if key in folder.video_keys and is_depth(feature):
        codes = next(folder.frames(episode, key, PIXEL_FORMAT))
        return dequantised(codes, feature, f"{folder.root}: {key}")
    image = _first_image(folder, episode, key)
    if image.ndim == 3 and image.shape[2] == 3:
        coded = coded_depth.decode(image)
        if coded is None:
            raise DatasetError(
                f"{folder.root}: {key} is a colour image, which holds no depth; record depth as a depth stream of "
                "lerobot 0.6, as a feature with one number a pixel, or coded as rip_twin does with --robot.depth=coded"
            )
        return coded
    unit = unit_m or unit_of(feature)
    if unit is None:
        raise DatasetError(
            f"{folder.root} does not say the unit of {key!r}; give depth_unit_m, metres per step, in the rig"
        )
    depth = as_numbers(key, image, np.float32) * np.float32(unit)
    return depth[..., 0] if depth.ndim == 3 and depth.shape[2] == 1 else depth


def _first_image(folder: Folder, episode: int, key: str) -> NDArray:
    """The first frame of an image feature: from a video, from stored image files, or from numbers."""
    if key in folder.video_keys:
        return next(folder.frames(episode, key))
    try:
        value = folder.columns(episode, [key])[key][0].as_py()
        if not isinstance(value, Mapping):
            return as_numbers(key, value, np.float32)
        if not isinstance(value.get("bytes"), bytes):
            raise ValueError("its images are not stored in the table")
        return np.asarray(decode_image(value["bytes"], ("PNG", "JPEG", "TIFF")))
    except (ValueError, OverflowError, pa.ArrowException) as error:
        raise DatasetError(
            f"{folder.root}: episode {episode} has no readable image {excerpt(key)!r} ({excerpt(error)})"
        ) from error
