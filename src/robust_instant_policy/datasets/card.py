"""Files of a folder for readers that know nothing of this package: a dataset card, and the camera's calibration."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robust_instant_policy.datasets import layout
from robust_instant_policy.datasets.statistics import Statistics
from robust_instant_policy.datasets.tables import json_file, listed, parquet, task_table
from robust_instant_policy.files import write_whole
from robust_instant_policy.geometry import FloatArray

AllStatistics = Mapping[str, Statistics]  # by feature
CARD = """\
---
task_categories:
- robotics
tags:
- LeRobot
configs:
- config_name: default
  data_files: data/*/*.parquet
---

# {title}

{total_episodes} demonstrations, {total_frames} steps at {fps:g} Hz; task `{task}`; robot `{robot}`. A
LeRobotDataset {codebase_version}: `LeRobotDataset("NAME", root=FOLDER)` opens it, `rip view --demos FOLDER` shows it.

- `action`: for each arm the gripper point, both fingertips when the gripper is open (metres, world frame), and the
  commanded gripper state (0 open, 1 closed).
- `observation.state`: the same points, and how far the gripper is closed, measured where the robot measures it.
- `start/`: colour image and depth of each episode's start; `meta/episodes` holds the camera's intrinsics and pose
  (`rip/…`), `meta/calibration.json` repeats them where they are the same in all episodes.
"""


def dataset_card(info: Mapping[str, Any], task: str, description: str) -> bytes:
    """``README.md`` of a folder with the content ``info`` of ``meta/info.json``."""
    robot = info.get("robot_type") or "not named"
    return CARD.format_map({**info, "title": " ".join(description.split()), "task": task, "robot": robot}).encode()


def write_summary(root: Path, info: Mapping[str, Any], task: str, description: str, statistics: AllStatistics) -> None:
    """Write the files about a whole folder; ``meta/info.json`` last, as it counts the episodes."""
    write_whole(root / layout.TASKS_PATH, parquet(task_table(description)))
    write_whole(root / layout.CARD_PATH, dataset_card(info, task, description))
    write_whole(root / layout.STATS_PATH, json_file({key: listed(value) for key, value in statistics.items()}))
    write_whole(root / layout.INFO_PATH, json_file(info))


def write_calibration(root: Path, episode: int, intrinsics: FloatArray, camera_pose: FloatArray) -> None:
    """Write the camera ``(3, 3)`` pixels, ``(4, 4)`` camera to world, of the first ``episode``; remove the file with
    the first one whose camera differs.

    The layout of ``meta/calibration.json`` is that of deepen-grade.
    """
    (fx, _, cx), (_, fy, cy), _ = intrinsics.tolist()
    camera = {"intrinsics": {"fx": fx, "fy": fy, "cx": cx, "cy": cy}, "extrinsics": camera_pose.ravel().tolist()}
    path, content = root / layout.CALIBRATION_PATH, json_file({layout.VIDEO_KEY: camera})
    if episode == 0:
        write_whole(path, content)
    elif path.exists() and path.read_bytes() != content:
        path.unlink()
