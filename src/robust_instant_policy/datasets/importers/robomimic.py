"""robomimic's HDF5 files (``docs/datasets/overview.md`` of robomimic), with observations extracted from robosuite.

Each ``data/demo_i`` holds ``actions (T, D)``, ``obs/robot0_eef_pos`` and ``obs/robot0_eef_quat`` (x, y, z, w), those of
``robot1`` where there are two, ``obs/CAMERA_image`` and, when extracted with ``--depth``, ``obs/CAMERA_depth``
(metres); its attribute ``camera_info`` gives each camera's intrinsics and its pose in the world, OpenCV axes.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from robust_instant_policy.datasets.importers.hdf5 import (
    members,
    nested,
    open_hdf5,
    read,
    read_json_attribute,
)
from robust_instant_policy.datasets.importers.layouts import Columns, poses_of
from robust_instant_policy.datasets.importers.source import GripperCommand, SourceEpisode, choose_camera
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.files import excerpt
from robust_instant_policy.geometry import FloatArray, as_numbers

MAX_ARMS = 2
ROBOSUITE = 1  # type of robosuite's environments
XYZ_XYZW = Columns("", (0, 1, 2), (3, 4, 5, 6), "quat_xyzw")
ROBOSUITE_GRIPPER = GripperCommand(open=-1.0, closed=1.0)  # the same for all of robosuite's grippers
TOOL_FRAMES = {"Panda": np.eye(4)}  # robots whose right_hand body already is the tool frame of `geometry`
DEMONSTRATION = re.compile(r"demo_[0-9]{1,9}")
HAND_CAMERA = "eye_in_hand"  # robomimic writes the pose of these relative to the hand
ADVICE = (
    "Extract the observations with: python -m robomimic.scripts.dataset_states_to_obs --dataset {path} "
    "--output_name depth.hdf5 --camera_names agentview --camera_height 240 --camera_width 320 --depth"
)


def read_robomimic(path: Path, camera: str | None) -> Iterator[SourceEpisode]:
    """The episodes of a robomimic file, in the order of their numbers."""
    with open_hdf5(path) as file:
        data = file["data"]
        environment = read_json_attribute(data, "env_args")
        names = sorted(filter(DEMONSTRATION.fullmatch, members(file, "data")), key=lambda name: int(name[5:]))
        if not names:
            raise DatasetError(f"{path} holds no demonstrations")
        for name in names:
            yield _read_episode(path, name, data[name], camera, environment)


def _read_episode(
    path: Path, name: str, group: Any, camera: str | None, environment: Mapping[str, Any]
) -> SourceEpisode:
    cameras = [key.removesuffix("_image") for key in members(group, "obs") if key.endswith("_image")]
    chosen = choose_camera(path, [one for one in cameras if HAND_CAMERA not in one], camera)
    images = read(group, f"obs/{chosen}_image", 4)
    depth = read(group, f"obs/{chosen}_depth", 4, 3, 2)  # robomimic writes (T, H, W, 1)
    calibration = nested(read_json_attribute(group, "camera_info"), str(chosen))
    where, actions = f"{path} ({excerpt(name)})", read(group, "actions", 2)
    arms = [poses for arm in range(MAX_ARMS) if (poses := _poses(where, group, arm)) is not None]
    grippers = None
    if actions is not None:  # those of each arm end with its gripper
        size, rest = divmod(actions.shape[1], max(len(arms), 1))
        if rest:
            raise DatasetError(f"{where}: {actions.shape[1]} numbers of an action do not belong to {len(arms)} arms")
        grippers = actions[:, size - 1 :: size].astype(np.float64)
    from_robosuite = environment.get("type", environment.get("env_type")) == ROBOSUITE
    settings = nested(environment, "env_kwargs")
    robots = settings.get("robots", "")
    robot = robots[0] if isinstance(robots, list) and robots and robots == robots[:1] * len(robots) else robots
    return SourceEpisode(
        name=f"{path.name} ({excerpt(name)})",
        rgb=None if images is None else images[0],
        depth=None if depth is None else as_numbers("depth", depth[0], np.float32).squeeze(),
        intrinsics=calibration.get("intrinsics"),
        camera_pose=calibration.get("extrinsics"),
        poses=np.stack(arms, axis=1) if arms else None,
        tool=TOOL_FRAMES.get(robot) if from_robosuite and isinstance(robot, str) else None,
        gripper_values=grippers,
        gripper=ROBOSUITE_GRIPPER if from_robosuite else None,
        rate_hz=settings.get("control_freq"),
        images=None if images is None else lambda: images,
        info={"source": path.name, "episode": name, "environment": str(environment.get("env_name", ""))},
        advice=ADVICE.format(path=path) if depth is None or not arms or not calibration else "",
    )


def _poses(where: str, group: Any, arm: int) -> FloatArray | None:
    """Poses ``(T, 4, 4)`` of one arm; None where they are missing."""
    position, quaternion = (read(group, f"obs/robot{arm}_eef_{kind}", 2) for kind in ("pos", "quat"))
    if position is None or quaternion is None:
        return None
    if position.shape != (len(quaternion), 3) or quaternion.shape[1] != 4:
        raise DatasetError(f"{where}: robot{arm}_eef_pos and _quat must be (T, 3) and (T, 4)")
    return poses_of(where, np.hstack([position, quaternion]), XYZ_XYZW)
