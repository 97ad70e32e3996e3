"""Recording demonstrations; a process that is killed loses at most the current episode."""

from __future__ import annotations

import json
import os
import re
import reprlib
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.datasets import layout
from robust_instant_policy.datasets.card import write_calibration, write_summary
from robust_instant_policy.datasets.folder import Folder, inside, open_folder, read_recording, read_seed
from robust_instant_policy.datasets.images import encode_depth, encode_image
from robust_instant_policy.datasets.statistics import Statistics, extended, feature_statistics, image_statistics
from robust_instant_policy.datasets.tables import (
    episode_table,
    features_of,
    frame_table,
    json_file,
    parquet,
    read_statistics,
)
from robust_instant_policy.datasets.video import encode_video
from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.files import PART_SUFFIX, excerpt, finished_files, lock_folder, make_folder, write_whole
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX

EVEN_TIMING_TOLERANCE = 1e-6  # of an episode's duration
EPISODE_FILE = re.compile(r"chunk-(\d+)/file-(\d+)\.(?:parquet|png|mp4)$")


class DatasetWriter:
    """Adds demonstrations to a new folder, or to one of an earlier writer.

    All episodes have one ``task``, its ``description`` in words, and one recording rate; ``robot_type`` names the
    robot. An episode is finished when ``meta/info.json`` counts it: its files are written first, ``info.json``
    last, each of them atomically. A killed process leaves at most uncounted files, and the next writer removes
    them.

    Raises `DatasetError` for a folder of another task or rate, one with other content, one that another
    process is writing to, and if the disk is full.
    """

    def __init__(self, path: str | Path, task: str, description: str, rate_hz: float, robot_type: str | None = None):
        self.path = Path(path)
        self.task, self.description, self.rate_hz = task, description or task, float(rate_hz)
        if not (np.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise DatasetError(f"the recording rate must be positive, got {rate_hz} Hz")
        make_folder(self.path)
        self.robot_type = robot_type
        self._folder: Folder | None = None
        self._statistics: dict[str, Statistics] = {}
        self._discarded_seeds: list[int | None] = []
        self._lock: int | None = lock_folder(self.path)
        try:
            self._resume()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> DatasetWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the folder for other processes. All added episodes are already on the disk."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @property
    def num_episodes(self) -> int:
        """Number of finished episodes, including those of earlier writers."""
        return 0 if self._folder is None else len(self._folder.episodes)

    @property
    def discarded(self) -> int:
        """Number of discarded attempts, including those of earlier writers."""
        return len(self._discarded_seeds)

    @property
    def last_seed(self) -> int | None:
        """The largest seed tried so far, stored or discarded; the next seed is one larger."""
        kept = [] if self._folder is None else [read_seed(row) for row in self._folder.episodes]
        return max((seed for seed in [*kept, *self._discarded_seeds] if seed is not None), default=None)

    def discard(self, seed: int | None = None) -> None:
        """Record a discarded attempt, with its ``seed`` if it had one."""
        self._require_open()
        self._write_own([*self._discarded_seeds, seed])

    def add(
        self,
        demonstration: Demonstration,
        images: NDArray[np.uint8] | None = None,
        grippers: FloatArray | None = None,
    ) -> None:
        """Append an episode, with ``images (T, H, W, 3)`` uint8 of all steps for all episodes or for none.

        ``grippers (T, A)``, 0 open to 1 closed, were measured, for the state; else it holds the commanded ones.

        When this returns, the episode is on the disk; when it raises, the folder is unchanged.
        """
        self._require_open()
        self._check(demonstration, images, grippers)
        try:
            self._folder, self._statistics = self._write_episode(demonstration, images, grippers)
        except BaseException:
            self._take_up()
            raise

    def _require_open(self) -> None:
        if self._lock is None:
            raise DatasetError(f"the writer of {self.path} is closed; open a new one")

    def _resume(self) -> None:
        """Read the finished episodes of earlier writers, and remove unfinished files."""
        if (self.path / layout.RIP_PATH).exists():
            own = read_recording(self.path)
            if own["task"] != self.task:
                raise DatasetError(
                    f"{self.path} holds demonstrations of {excerpt(own['task'])!r}, not of {self.task!r}"
                )
            if own.get("rate_hz") != self.rate_hz:
                raise DatasetError(
                    f"{self.path} was recorded at {reprlib.repr(own.get('rate_hz'))} Hz, not at {self.rate_hz} Hz"
                )
            self.description = own.get("description", self.description)
            self._discarded_seeds = own.get("discarded_seeds", [])
            self._take_up()
            return
        other = next(finished_files(self.path), None)
        if other is not None:
            raise DatasetError(f"{self.path} holds other files ({other.name}); choose an empty or a new folder")
        self._take_up()
        self._write_own([])

    def _take_up(self) -> None:
        """Read the finished episodes, and remove unfinished files."""
        self._folder, self._statistics = None, {}
        if (self.path / layout.INFO_PATH).exists():
            self._folder = open_folder(self.path, self.task)
            for episode in range(self.num_episodes):
                try:
                    self._statistics = extended(self._statistics, read_statistics(self.path, episode))
                except (KeyError, ValueError, TypeError, IndexError, OverflowError) as error:
                    raise DatasetError(
                        f"{self.path} is damaged: the statistics of episode {episode} are not as written "
                        f"({excerpt(error)}); restore it, or choose another folder"
                    ) from None
        self._remove_unfinished(self.num_episodes)

    def _remove_unfinished(self, count: int) -> None:
        """Remove the files of the unfinished episode ``count``; files of any later episode are an error and stay."""
        unfinished = []
        tops = (inside(self.path, top).rglob("*") for top in (*layout.EPISODE_FOLDERS, "meta"))
        for file in (*self.path.glob(f".{layout.CARD_PATH}*{PART_SUFFIX}"), *chain.from_iterable(tops)):
            match = EPISODE_FILE.search(file.as_posix())
            episode = int(match[1]) * layout.FILES_PER_CHUNK + int(match[2]) if match else -1
            if episode > count:
                raise DatasetError(
                    f"{self.path} is damaged: it holds files of episode {episode}, but {layout.INFO_PATH} counts "
                    f"{count} episodes; restore that file, or choose another folder"
                )
            if episode == count or file.name.endswith(PART_SUFFIX):
                unfinished.append(file)
        for file in unfinished:
            file.unlink(missing_ok=True)

    def _write_own(self, discarded_seeds: list[int | None]) -> None:
        own = {
            "format": layout.RIP_FORMAT,
            "task": self.task,
            "description": self.description,
            "rate_hz": self.rate_hz,
            "discarded_seeds": discarded_seeds,
        }
        write_whole(self.path / layout.RIP_PATH, json_file(own))
        self._discarded_seeds = discarded_seeds

    def _check(
        self, demonstration: Demonstration, images: NDArray[np.uint8] | None, grippers: FloatArray | None
    ) -> None:
        """Raise an error, before anything is written, for what the folder cannot hold."""
        trajectory = demonstration.trajectory
        if demonstration.task not in ("", self.task):
            raise DatasetError(f"a demonstration of {demonstration.task!r} cannot go into {self.path} of {self.task!r}")
        if demonstration.rate_hz != self.rate_hz:
            raise DatasetError(f"{self.path} is recorded at {self.rate_hz} Hz, the episode at {demonstration.rate_hz}")
        if np.abs(trajectory.times - np.linspace(0, 1, len(trajectory))).max() > EVEN_TIMING_TOLERANCE:
            raise DatasetError("a recorded trajectory must be evenly timed; resample it with Trajectory.resampled")
        if images is not None and (images.ndim != 4 or images.shape[0] != len(trajectory) or images.dtype != np.uint8):
            raise DatasetError(
                f"images must be ({len(trajectory)}, H, W, 3) uint8 like the trajectory, "
                f"got {images.shape} {images.dtype}"
            )
        if grippers is not None and np.shape(grippers) != trajectory.gripper_state.shape:
            raise DatasetError(f"grippers must be {trajectory.gripper_state.shape}, got {np.shape(grippers)}")
        if self._folder is None:
            return
        features = self._folder.info["features"]
        declared = features_of(trajectory.num_arms, images, self.rate_hz)
        for key in sorted({*features, *declared}):
            old, new = (entry.get(key, {}).get("shape") for entry in (features, declared))
            if old != new:
                raise DatasetError(
                    f"every episode of {self.path} must be alike: {key} is {old or 'absent'} in the folder, "
                    f"{new or 'absent'} in the new episode"
                )

    def _write_episode(
        self, demonstration: Demonstration, images: NDArray[np.uint8] | None, grippers: FloatArray | None
    ) -> tuple[Folder, dict[str, Statistics]]:
        """Write an episode, its own files first; returns the folder and statistics with it."""
        episode = self.num_episodes
        first_frame = 0 if self._folder is None else self._folder.info["total_frames"]
        length = len(demonstration.trajectory)
        columns = self._frame_columns(demonstration, grippers, episode, first_frame)
        statistics: dict[str, Statistics] = {
            key: feature_statistics(value.reshape(length, -1)) for key, value in columns.items()
        }
        chunk, file = layout.chunk_and_file(episode)
        row: dict[str, Any] = {
            "episode_index": episode,
            "tasks": [self.description],
            "length": length,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": first_frame,
            "dataset_to_index": first_frame + length,
            "meta/episodes/chunk_index": chunk,
            "meta/episodes/file_index": file,
        }
        if images is not None:
            self._write_file(layout.VIDEO_PATTERN, episode, encode_video(images, self.rate_hz))
            row |= {
                f"videos/{layout.VIDEO_KEY}/chunk_index": chunk,
                f"videos/{layout.VIDEO_KEY}/file_index": file,
                f"videos/{layout.VIDEO_KEY}/from_timestamp": 0.0,
                f"videos/{layout.VIDEO_KEY}/to_timestamp": length / self.rate_hz,
            }
            statistics[layout.VIDEO_KEY] = image_statistics(images)
        row |= self._write_start(demonstration, episode)
        self._write_file(layout.DATA_PATTERN, episode, parquet(frame_table(columns)))
        self._write_file(layout.EPISODES_PATTERN, episode, parquet(episode_table(row, statistics)))
        whole = extended(self._statistics, statistics)
        features = features_of(demonstration.trajectory.num_arms, images, self.rate_hz)
        seen = demonstration.observation
        write_calibration(self.path, episode, seen.intrinsics, seen.camera_pose)
        info = self._write_dataset(features, whole, episode + 1, first_frame + length)
        earlier = [] if self._folder is None else self._folder.episodes
        return Folder(self.path, info, [*earlier, row]), whole

    def _frame_columns(
        self, demonstration: Demonstration, grippers: FloatArray | None, episode: int, first_frame: int
    ) -> dict[str, NDArray]:
        steps = np.arange(len(demonstration.trajectory))
        actions = demonstration.trajectory.actions.astype(np.float32)
        state = actions.copy()
        if grippers is not None:
            state[:, STATE_INDEX::ACTION_DIM] = grippers
        return {
            layout.ACTION_KEY: actions,
            layout.STATE_KEY: state,
            "timestamp": (steps / self.rate_hz).astype(np.float32),
            "frame_index": steps,
            "episode_index": np.full_like(steps, episode),
            "index": first_frame + steps,
            "task_index": np.zeros_like(steps),
        }

    def _write_start(self, demonstration: Demonstration, episode: int) -> dict[str, Any]:
        """Write the start-of-episode images; returns the columns for the other data of the start."""
        observation = demonstration.observation
        depth, unit = encode_depth(observation.depth)
        self._write_file(layout.START_RGB_PATTERN, episode, encode_image(observation.rgb))
        self._write_file(layout.START_DEPTH_PATTERN, episode, depth)
        return {
            layout.INTRINSICS_COLUMN: observation.intrinsics.ravel().tolist(),
            layout.CAMERA_POSE_COLUMN: observation.camera_pose.ravel().tolist(),
            layout.DEPTH_UNIT_COLUMN: unit,
            layout.SEED_COLUMN: demonstration.seed,
            layout.INFO_COLUMN: json.dumps(dict(demonstration.info), sort_keys=True, default=_number),
        }

    def _write_dataset(
        self, features: dict[str, Any], statistics: Mapping[str, Statistics], num_episodes: int, num_frames: int
    ) -> dict[str, Any]:
        """Write the files about the whole folder; the last one, whose content is returned, finishes the episode."""
        info = {
            "codebase_version": layout.CODEBASE_VERSION,
            "robot_type": self.robot_type or (self._folder and self._folder.info.get("robot_type")),
            "total_episodes": num_episodes,
            "total_frames": num_frames,
            "total_tasks": 1,
            "chunks_size": layout.FILES_PER_CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": int(self.rate_hz) if self.rate_hz.is_integer() else self.rate_hz,
            "splits": {"train": f"0:{num_episodes}"},
            "data_path": layout.DATA_PATTERN,
            "video_path": layout.VIDEO_PATTERN if layout.VIDEO_KEY in features else None,
            "features": features,
        }
        write_summary(self.path, info, self.task, self.description, statistics)
        return info

    def _write_file(self, pattern: str, episode: int, content: bytes) -> None:
        write_whole(self.path / layout.episode_path(pattern, episode), content)


def _number(value: object) -> object:
    """NumPy numbers as JSON numbers."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"an episode's info holds strings and numbers, not {type(value).__name__}")
