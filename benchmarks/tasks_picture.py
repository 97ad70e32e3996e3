"""Draws the pictures of the tasks in docs/: the camera image, and the demonstrator during the task.

python benchmarks/tasks_picture.py maniskill docs/images/tasks.jpg
python benchmarks/tasks_picture.py aloha docs/images/aloha.jpg
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
from PIL import Image

from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.families import FAMILIES
from robust_instant_policy.trajectory import downsample

SEED = 4
SIDE = 240
AT_SHARE = 0.72  # of the execution, at which the second picture is taken


def columns(names: Sequence[str]) -> list[np.ndarray]:
    pictures = []
    for name in names:
        task = make_task(name)
        demonstration = task.demonstrate(SEED).demonstration
        frames: list[np.ndarray] = []
        task.reset(SEED)
        task.execute(downsample(demonstration.trajectory), frames.append)
        task.close()
        views = [demonstration.observation.rgb, frames[int(AT_SHARE * len(frames))]]
        pictures.append(np.concatenate([square(Image.fromarray(view)) for view in views]))
    return pictures


def square(picture: Image.Image) -> np.ndarray:
    """The middle of ``picture``, `SIDE` pixels wide and high."""
    left = (picture.width - picture.height) // 2
    return np.asarray(picture.crop((left, 0, left + picture.height, picture.height)).resize((SIDE, SIDE)))


if __name__ == "__main__":
    names = next(family.names for family in FAMILIES if family.module == f"{sys.argv[1]}.task")
    Image.fromarray(np.concatenate(columns(names), axis=1)).save(sys.argv[2], quality=85)
