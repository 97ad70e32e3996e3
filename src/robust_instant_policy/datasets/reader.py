"""Reading demonstrations back."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.datasets import layout
from robust_instant_policy.datasets.folder import Folder, open_folder, read_json
from robust_instant_policy.datasets.images import read_depth, read_rgb
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import DatasetError, InvalidValueError
from robust_instant_policy.trajectory import Trajectory


def load_demonstrations(path: str | Path, task: str | None = None, limit: int | None = None) -> list[Demonstration]:
    """The demonstrations of a folder in the order they were recorded, at most ``limit`` of them.

    Trajectories come back to float32, depth to 0.1 mm (1 mm where the camera read beyond 6.5 m) and NaN where
    there was no reading, everything else exactly. With ``task``, a folder of another task is refused.
    Raises `DatasetError` for a folder that is missing, empty, half-written, damaged or of another task.
    """
    if limit is not None and limit < 1:
        raise DatasetError(f"at least one demonstration is needed, got a limit of {limit}")
    root = Path(path)
    folder = open_folder(root, task)
    if not (root / layout.RIP_PATH).exists():
        raise DatasetError(
            f"{root} was not recorded by rip: it holds no start-of-episode depth and camera ({layout.RIP_PATH}); "
            "if its actions are end-effector poses, convert it with robust_instant_policy.datasets.importers"
        )
    recorded = read_json(root / layout.RIP_PATH)
    name = str(recorded.get("task", ""))
    if task is not None and name != task:
        raise DatasetError(
            f"{root} holds demonstrations of {name!r}, not of {task!r}; choose another folder, or --task {name}"
        )
    count = len(folder.episodes) if limit is None else min(limit, len(folder.episodes))
    return [_read_demonstration(folder, episode, name) for episode in range(count)]


def load_frames(path: str | Path, episode: int) -> Iterator[NDArray[np.uint8]]:
    """Images ``(H, W, 3)`` uint8 along the way of one episode, one for each step of its trajectory.

    Raises `DatasetError` when the folder was recorded without images or has no such episode.
    """
    folder = open_folder(Path(path))
    if layout.VIDEO_KEY not in folder.video_keys:
        raise DatasetError(f"{path} was recorded without images along the way; record it again with images")
    if not 0 <= episode < len(folder.episodes):
        raise DatasetError(f"{path} holds {len(folder.episodes)} episodes, there is no episode {episode}")
    return folder.frames(episode, layout.VIDEO_KEY)


def _read_demonstration(folder: Folder, episode: int, task: str) -> Demonstration:
    row = folder.episodes[episode]
    actions = np.array(folder.columns(episode, [layout.ACTION_KEY])[layout.ACTION_KEY].to_pylist())
    try:
        observation = Observation(
            rgb=read_rgb(folder.root / layout.episode_path(layout.START_RGB_PATTERN, episode)),
            depth=read_depth(
                folder.root / layout.episode_path(layout.START_DEPTH_PATTERN, episode), row[layout.DEPTH_UNIT_COLUMN]
            ),
            intrinsics=np.array(row[layout.INTRINSICS_COLUMN]).reshape(3, 3),
            camera_pose=np.array(row[layout.CAMERA_POSE_COLUMN]).reshape(4, 4),
        )
        return Demonstration(
            observation,
            Trajectory.from_actions(actions),
            folder.rate_hz,
            task,
            row[layout.SEED_COLUMN],
            _info(row),
            partial(folder.frames, episode, layout.VIDEO_KEY) if layout.VIDEO_KEY in folder.video_keys else None,
        )
    except (InvalidValueError, KeyError, ValueError) as error:
        raise DatasetError(
            f"{folder.root} is damaged: episode {episode}: {error}; restore it, or record again"
        ) from error


def _info(row: Mapping[str, Any]) -> dict[str, str | float | int]:
    return json.loads(row[layout.INFO_COLUMN])
