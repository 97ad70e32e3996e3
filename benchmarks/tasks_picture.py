"""Draws the picture of the tasks in docs/tasks.md: what the camera sees, and the demonstrator at work.

python benchmarks/tasks_picture.py docs/images/tasks.jpg
"""

from __future__ import annotations

import sys

import numpy as np
from PIL import Image

from robust_instant_policy.tasks import TASK_NAMES, make_task
from robust_instant_policy.trajectory import downsample

SEED = 4
SIDE = 240
AT_SHARE = 0.72  # of the execution, when the still is taken


def columns() -> list[np.ndarray]:
    pictures = []
    for name in TASK_NAMES:
        task = make_task(name)
        demonstration = task.demonstrate(SEED).demonstration
        frames: list[np.ndarray] = []
        task.reset(SEED)
        task.execute(downsample(demonstration.trajectory), frames.append)
        task.close()
        still = Image.fromarray(frames[int(AT_SHARE * len(frames))])
        left = (still.width - still.height) // 2
        views = [
            Image.fromarray(demonstration.observation.rgb),
            still.crop((left, 0, left + still.height, still.height)),
        ]
        pictures.append(np.concatenate([np.asarray(view.resize((SIDE, SIDE))) for view in views]))
    return pictures


if __name__ == "__main__":
    Image.fromarray(np.concatenate(columns(), axis=1)).save(sys.argv[1], quality=85)
