"""ManiSkill's trajectory files: ``NAME.h5`` beside ``NAME.json``, as its ``RecordEpisode`` wrapper writes them.

Each ``traj_i`` holds T actions and, where observations were recorded, T + 1 of them: ``obs/extra/tcp_pose``
(position and quaternion w, x, y, z), ``obs/sensor_data/CAMERA/{rgb, depth}`` (depth int16 millimetres, 0 = no
reading) and ``obs/sensor_param/CAMERA/{intrinsic_cv, extrinsic_cv}`` (world to camera, OpenCV axes).
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from robust_instant_policy.datasets.importers.hdf5 import (
    first_matrix,
    has,
    members,
    nested,
    open_hdf5,
    read,
)
from robust_instant_policy.datasets.importers.layouts import Columns, poses_of
from robust_instant_policy.datasets.importers.source import GripperCommand, SourceEpisode, choose_camera
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.files import excerpt, read_json
from robust_instant_policy.geometry import as_numbers, invert_pose

MILLIMETRE = 1e-3
# ManiSkill's Panda: the last action runs from -1 (closed) to 1 (open), and its tcp is the tool frame of `geometry`.
XYZ_WXYZ = Columns("", (0, 1, 2), (4, 5, 6, 3), "quat_xyzw")
PANDAS = ("panda", "panda_wristcam")
PANDA_GRIPPER = GripperCommand(open=1.0, closed=-1.0)
ADVICE = (
    "Replay the file with: python -m mani_skill.trajectory.replay_trajectory --traj-path {path} --obs-mode rgbd "
    "--save-traj --use-env-states"
)


def read_maniskill(path: Path, camera: str | None) -> Iterator[SourceEpisode]:
    """The successful episodes of a trajectory file. Raises `DatasetError` when there are none."""
    description = read_json(path.with_suffix(".json"))
    kwargs = nested(description, "env_info", "env_kwargs")
    episodes = description.get("episodes", [])
    if not isinstance(episodes, list) or not all(isinstance(episode, dict) for episode in episodes):
        raise DatasetError(f"{path.with_suffix('.json')} must list its episodes as objects")
    successful = [episode for episode in episodes if episode.get("success", True)]
    if not successful:
        raise DatasetError(f"{path} holds {len(episodes)} episodes, none of them successful")
    with open_hdf5(path) as file:
        for episode in successful:
            number = episode.get("episode_id")
            if not isinstance(number, int):
                told = excerpt(repr(number))
                raise DatasetError(f"{path.with_suffix('.json')}: episode_id must be a whole number, got {told}")
            name = f"traj_{number}"
            if not has(file, name):
                raise DatasetError(f"{path} has no {name}, which its .json lists")
            yield _read_episode(path, name, file[name], camera, episode, kwargs)


def _read_episode(
    path: Path, name: str, group: Any, camera: str | None, episode: Mapping[str, Any], kwargs: Mapping[str, Any]
) -> SourceEpisode:
    chosen = choose_camera(path, members(group, "obs/sensor_data"), camera)
    images, depth = (read(group, f"obs/sensor_data/{chosen}/{kind}", 4) for kind in ("rgb", "depth"))
    intrinsics = first_matrix(read(group, f"obs/sensor_param/{chosen}/intrinsic_cv", 3))
    extrinsics = first_matrix(read(group, f"obs/sensor_param/{chosen}/extrinsic_cv", 3))
    if extrinsics is not None and extrinsics.shape != (3, 4):
        raise DatasetError(f"{path} ({name}): extrinsic_cv must be (T, 3, 4), got matrices of {extrinsics.shape}")
    tcp = read(group, "obs/extra/tcp_pose", 2)
    actions = read(group, "actions", 2)
    articulations = members(group, "env_states/articulations")  # moving ones
    robots = [str(kwargs["robot_uids"])] if "robot_uids" in kwargs else articulations
    panda = set(robots) & set(PANDAS)
    return SourceEpisode(
        name=f"{path.name} ({name})",
        rgb=None if images is None else images[0],
        depth=None if depth is None else as_numbers("depth", depth[0, ..., 0], np.float32) * np.float32(MILLIMETRE),
        intrinsics=intrinsics,
        camera_pose=None if extrinsics is None else invert_pose(np.vstack([extrinsics, [0, 0, 0, 1]])),
        poses=None if tcp is None else poses_of(f"{path} ({name})", tcp, XYZ_WXYZ),
        tool=np.eye(4) if panda else None,
        # The command at each observation; the last observation has none, so the previous command is repeated.
        gripper_values=None if actions is None else np.append(actions[:, -1], actions[-1, -1]).astype(np.float64),
        gripper=PANDA_GRIPPER if panda else None,
        rate_hz=nested(kwargs, "sim_config").get("control_freq"),
        images=None if images is None else lambda: images,
        info={"source": path.name, "episode": name, "source_seed": str(episode.get("episode_seed"))},
        advice=ADVICE.format(path=path) if tcp is None or depth is None else "",
    )
