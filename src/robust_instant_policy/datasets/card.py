"""Files of a folder for readers that know nothing of this package: a dataset card, and the camera's calibration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from robust_instant_policy.datasets import layout
from robust_instant_policy.demonstration import Observation

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
    robot = info["robot_type"] or "not named"
    return CARD.format(title=" ".join(description.split()), task=task, robot=robot, **info).encode()


def calibration(observation: Observation) -> dict[str, Any]:
    """``meta/calibration.json`` in the layout of deepen-grade: intrinsics in pixels, camera to world, OpenCV axes."""
    (fx, _, cx), (_, fy, cy), _ = observation.intrinsics.tolist()
    return {
        layout.VIDEO_KEY: {
            "intrinsics": {"fx": fx, "fy": fy, "cx": cx, "cy": cy},
            "extrinsics": observation.camera_pose.ravel().tolist(),
        }
    }
