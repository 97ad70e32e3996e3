"""Reading demonstrations."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.datasets import layout
from robust_instant_policy.datasets.folder import Folder, open_folder, read_recording, read_seed
from robust_instant_policy.datasets.images import read_depth, read_rgb
from robust_instant_policy.datasets.layout import damaged
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import DatasetError, InvalidValueError
from robust_instant_policy.files import excerpt, parse_json
from robust_instant_policy.geometry import FloatArray, as_numbers
from robust_instant_policy.trajectory import Trajectory


def load_demonstrations(path: str | Path, task: str | None = None, limit: int | None = None) -> list[Demonstration]:
    """The demonstrations of a folder in recording order, at most ``limit`` of them.

    Trajectories are stored in float32, depth in steps of 0.1 mm (1 mm where the camera read beyond 6.5 m), NaN where
    there was no reading; everything else exactly. With ``task``, a folder of another task is an error.
    Raises `DatasetError` for a folder that is missing, empty, half-written, damaged or of another task.
    """
    if limit is not None and limit < 1:
        raise DatasetError(f"at least one demonstration is needed, got a limit of {limit}")
    root = Path(path)
    folder = open_folder(root, task)
    if not (root / layout.RIP_PATH).exists():
        raise DatasetError(
            f"{root} was not recorded by rip, or was edited by other software: it holds no start-of-episode depth and "
            f"camera ({layout.RIP_PATH}); {_advice(folder)}"
        )
    name = read_recording(root)["task"]
    if task is not None and name != task:
        raise DatasetError(
            f"{root} holds demonstrations of {excerpt(name)!r}, not of {task!r}; "
            f"choose another folder, or --task {excerpt(name)}"
        )
    count = len(folder.episodes) if limit is None else min(limit, len(folder.episodes))
    return [_read_demonstration(folder, episode, name) for episode in range(count)]


def _advice(folder: Folder) -> str:
    """How to make demonstrations of a folder without their start: it was ours, or is somebody else's."""
    action = folder.info["features"].get(layout.ACTION_KEY, {})
    if action.get("names") in (layout.axis_names(arms) for arms in (1, 2)):
        return f"take these from the folder that was edited: rip demos restore {folder.root} --from ORIGINAL --out NEW"
    return f"if it holds end-effector poses, convert it with: rip import {folder.root} (docs/importing.md)"


def load_frames(path: str | Path, episode: int) -> Iterator[NDArray[np.uint8]]:
    """Images ``(H, W, 3)`` uint8 of one episode, one for each step of its trajectory.

    Raises `DatasetError` when the folder was recorded without images or has no such episode.
    """
    folder = open_folder(Path(path))
    if layout.VIDEO_KEY not in folder.video_keys:
        raise DatasetError(f"{path} was recorded without images; record it again with --images")
    if not 0 <= episode < len(folder.episodes):
        raise DatasetError(f"{path} holds {len(folder.episodes)} episodes, there is no episode {episode}")
    return folder.frames(episode, layout.VIDEO_KEY)


def _read_demonstration(folder: Folder, episode: int, task: str) -> Demonstration:
    row = folder.episodes[episode]
    actions = folder.matrix(episode, layout.ACTION_KEY)
    try:
        unit = row[layout.DEPTH_UNIT_COLUMN]
        if not (isinstance(unit, float) and 0 < unit < np.inf):
            raise ValueError(f"{layout.DEPTH_UNIT_COLUMN} must be a positive number, got {unit!r}")
        observation = Observation(
            rgb=read_rgb(folder.own_file(layout.START_RGB_PATTERN, episode)),
            depth=read_depth(folder.own_file(layout.START_DEPTH_PATTERN, episode), unit),
            intrinsics=square(row[layout.INTRINSICS_COLUMN], 3),
            camera_pose=square(row[layout.CAMERA_POSE_COLUMN], 4),
        )
        return Demonstration(
            observation,
            Trajectory.from_actions(actions),
            folder.rate_hz,
            task,
            read_seed(row),
            _info(row[layout.INFO_COLUMN]),
            partial(folder.frames, episode, layout.VIDEO_KEY) if layout.VIDEO_KEY in folder.video_keys else None,
        )
    except KeyError as error:
        raise damaged(folder.root, f"meta/episodes lacks {excerpt(error)}") from None
    except (InvalidValueError, ValueError) as error:
        raise damaged(folder.root, f"episode {episode}: {excerpt(error)}") from error


def square(values: object, side: int) -> FloatArray:
    """A matrix ``(side, side)`` that was stored in a row, row-major. Raises `ValueError`."""
    if not (isinstance(values, list) and len(values) == side * side):
        raise ValueError(f"a matrix of {side} x {side} numbers is not one")
    return as_numbers("a matrix", values).reshape(side, side)


def _info(text: object) -> dict[str, str | float | int]:
    """Further facts on an episode, written as JSON."""
    try:
        facts = parse_json(text) if isinstance(text, str) else None
    except ValueError:
        facts = None
    if not isinstance(facts, dict) or not all(isinstance(fact, str | float | int) for fact in facts.values()):
        raise ValueError(f"{layout.INFO_COLUMN} must be a JSON object of strings and numbers")
    return facts
