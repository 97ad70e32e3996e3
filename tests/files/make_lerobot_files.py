"""Makes `lerobot-0.6.1.tar.xz`: small datasets that lerobot itself wrote or edited.

    PYTHONPATH=. python tests/files/make_lerobot_files.py --python PYTHON

PYTHON is the interpreter of an environment with `lerobot[dataset]==0.6.1` (Python 3.12). The archive holds
`depth-video`, `depth-mm` and `depth-m` (a depth stream as 12-bit video, as 16-bit and as float images), `ours` (three
demonstrations written by this package), and what `lerobot-edit-dataset` makes of them: `deleted` (without the second
one), `merged` (`ours` and `deleted`), `removed` (without its video), `tasks` (with another task, in place).
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import tarfile
import tempfile
from pathlib import Path

from tests.datasets_samples import DESCRIPTION, RATE_HZ, TASK, demonstration, images

from robust_instant_policy.datasets import DatasetWriter

ARCHIVE = Path(__file__).parent / "lerobot-0.6.1.tar.xz"
WRITE = """
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

kind, metres, root = sys.argv[1], sys.argv[2] == "m", Path(sys.argv[3])
height, width = 48, 64
names = ["ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz", "ee.gripper_pos"]
dataset = LeRobotDataset.create("local/x", fps=10, root=root, use_videos=kind == "video", features={
    "observation.state": {"dtype": "float32", "shape": (7,), "names": names},
    "observation.images.front": {
        "dtype": kind, "shape": (height, width, 3), "names": ["height", "width", "channels"]
    },
    "observation.images.front_depth": {
        "dtype": kind, "shape": (height, width, 1), "names": ["height", "width", "channels"],
        "info": {"is_depth_map": True},
    },
})
depth = (600 + np.add.outer(2 * np.arange(height), np.arange(width))).astype(np.uint16)[..., None]
depth[:4] = 0
if metres:
    depth = (depth / 1000).astype(np.float32)
for episode in range(2):
    for step in range(6):
        state = [0.3 + 0.01 * step, 0.02 * episode, 0.2, np.pi, 0, 0, 100 if step < 3 else 0]
        image = np.full((height, width, 3), 40 + 20 * episode, np.uint8)
        dataset.add_frame({
            "observation.state": np.float32(state), "observation.images.front": image,
            "observation.images.front_depth": depth, "task": "push it",
        })
    dataset.save_episode()
dataset.finalize()
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", type=Path, required=True)
    options = parser.parse_args()
    offline = {**os.environ, "HF_HUB_OFFLINE": "1", "PYTHONPATH": ""}
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch) / "files"
        root.mkdir()

        def edit(operation: str, *arguments: str) -> None:
            program = options.python.parent / "lerobot-edit-dataset"
            subprocess.run([program, f"--operation.type={operation}", *arguments], check=True, env=offline)

        for name, kind, unit in (
            ("depth-video", "video", "mm"),
            ("depth-mm", "image", "mm"),
            ("depth-m", "image", "m"),
        ):
            subprocess.run([options.python, "-c", WRITE, kind, unit, root / name], check=True, env=offline)
        with DatasetWriter(root / "ours", TASK, DESCRIPTION, RATE_HZ) as writer:
            for seed in (0, 1, 2):
                writer.add(demonstration(seed, steps=20), images(seed, 20))
        ours = ["--repo_id=local/ours", f"--root={root / 'ours'}"]
        new = "--new_repo_id=local/new"
        edit("delete_episodes", *ours, new, f"--new_root={root / 'deleted'}", "--operation.episode_indices=[1]")
        edit(
            "remove_feature",
            *ours,
            new,
            f"--new_root={root / 'removed'}",
            "--operation.feature_names=['observation.images.top']",
        )
        edit(
            "merge",
            new,
            f"--new_root={root / 'merged'}",
            "--operation.repo_ids=['local/a', 'local/b']",
            f"--operation.roots=['{root / 'ours'}', '{root / 'deleted'}']",
        )
        shutil.copytree(root / "ours", root / "tasks")
        edit("modify_tasks", "--repo_id=local/tasks", f"--root={root / 'tasks'}", "--operation.new_task=push it gently")
        with tarfile.open(ARCHIVE, "w:xz") as archive:
            archive.add(root, arcname=".")
    print(ARCHIVE, ARCHIVE.stat().st_size, "bytes")


if __name__ == "__main__":
    main()
