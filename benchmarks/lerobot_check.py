"""Compares `lerobot` and this package: both read our folders, and this package imports a dataset of `lerobot`.

    python benchmarks/lerobot_check.py [--demos DIR] [--venv VENV]

`lerobot` needs another version of torch, so it is installed in a separate environment at VENV (8 GB, with CUDA
libraries). Every frame of the folder is read with both libraries and compared; without --demos a small folder is
generated. With the system's `ffmpeg` installed, lerobot decodes with torchcodec, otherwise with PyAV. In the other
direction, lerobot writes a small dataset of end-effector poses and the importer reads it. The result
goes to docs/tables/lerobot.md.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from robust_instant_policy.datasets import DatasetWriter, load_demonstrations, load_frames
from robust_instant_policy.datasets.importers import GripperCommand, Rig, import_demonstrations
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.geometry import GripperTriangle, make_pose
from robust_instant_policy.trajectory import Trajectory

LEROBOT = "lerobot==0.4.4"
TABLE = Path(__file__).parent.parent / "docs" / "tables" / "lerobot.md"
EPISODES, STEPS, RATE_HZ = 3, 120, 55.0
HEIGHT, WIDTH = 120, 160
OFFLINE = {"HF_HUB_OFFLINE": "1", "HOME": str(Path.home())}
MAX_POSE_DIFFERENCE = 1e-5  # float32
MAX_IMAGE_DIFFERENCE = 3.0  # grey levels, mean: both decode the same H.264, each with its own colour conversion

READ_WITH_LEROBOT = """
import json, platform, sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

root, out, backend = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
dataset = LeRobotDataset("local/demonstrations", root=root, video_backend=backend)
steps = {"action": [], "observation.state": [], "timestamp": [], "episode_index": [], "frame_index": []}
images = []
for item in torch.utils.data.DataLoader(dataset, batch_size=None):
    for key, values in steps.items():
        values.append(item[key].numpy())
    for key in dataset.meta.camera_keys:
        images.append((item[key].numpy() * 255).round().astype(np.uint8).transpose(1, 2, 0))
window = LeRobotDataset(
    "local/demonstrations", root=root, video_backend=backend, delta_timestamps={"action": [0, 1 / dataset.fps]}
)[0]["action"]
np.savez(out, images=np.array(images), window=window.numpy(), **{key: np.array(value) for key, value in steps.items()})
print(json.dumps({
    "lerobot": version("lerobot"), "torch": version("torch"), "torchvision": version("torchvision"),
    "python": platform.python_version(), "episodes": dataset.num_episodes, "frames": dataset.num_frames,
    "fps": dataset.fps, "task": item["task"], "features": list(dataset.features), "stats": sorted(dataset.meta.stats),
}))
"""

WRITE_WITH_LEROBOT = """
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

root, given = Path(sys.argv[1]), np.load(sys.argv[2])
names = ["ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz", "ee.gripper_pos"]
height, width = given["depth"].shape
dataset = LeRobotDataset.create("local/theirs", fps=int(sys.argv[3]), root=root, features={
    "observation.state": {"dtype": "float32", "shape": (7,), "names": names},
    "observation.depth": {"dtype": "float32", "shape": (height, width), "names": ["height", "width"]},
    "observation.images.front": {
        "dtype": "video", "shape": (height, width, 3), "names": ["height", "width", "channels"]
    },
})
for states in given["states"]:
    for step, state in enumerate(states):
        image = np.full((height, width, 3), 10 + step, np.uint8)
        dataset.add_frame({"observation.state": state.astype(np.float32), "observation.depth": given["depth"],
                           "observation.images.front": image, "task": "push the cube"})
    dataset.save_episode()
dataset.finalize()
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demos", type=Path, help="folder to check; made up when not given")
    parser.add_argument("--venv", type=Path, default=Path(tempfile.gettempdir()) / "lerobot-venv")
    options = parser.parse_args()
    python = environment(options.venv)
    with tempfile.TemporaryDirectory() as scratch:
        demos = options.demos or make_up(Path(scratch) / "demos")
        rows = [check(python, demos, backend, Path(scratch) / "frames.npz") for backend in ("pyav", "torchcodec")]
        back = check_import(python, Path(scratch))
    text = (
        table(rows, options.demos.name if options.demos else f"{EPISODES} generated episodes")
        + f"\nIn the other direction: {back}\n"
    )
    print(text)
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    TABLE.write_text(text)


def environment(folder: Path) -> Path:
    """Interpreter of an environment with `lerobot`, created if it is missing."""
    python = folder / "bin" / "python"
    if not python.exists():
        venv.create(folder, with_pip=True)
    if subprocess.run([python, "-c", "import lerobot"], capture_output=True).returncode:
        print(f"installing {LEROBOT} into {folder}", flush=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", LEROBOT], check=True)
    return python


def make_up(folder: Path) -> Path:
    """A folder of a few episodes with images, a gap in the depth, and a seed that is missing."""
    random = np.random.default_rng(0)
    ramp = np.linspace(40, 200, WIDTH).astype(np.uint8)
    with DatasetWriter(folder, "push-cube", "push the cube to the goal", RATE_HZ) as writer:
        for episode in range(EPISODES):
            positions = random.normal(size=(STEPS, 3)).cumsum(axis=0) * 0.005
            poses = np.stack([make_pose(np.eye(3), position) for position in positions])
            closed = np.arange(STEPS) > STEPS // 2
            trajectory = Trajectory.from_poses(poses, closed, GripperTriangle(length=0.1, opening=0.08))
            depth = random.uniform(0.5, 1.5, (HEIGHT, WIDTH)).astype(np.float32)
            depth[:8] = np.nan
            rgb = random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
            intrinsics = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
            images = np.tile(ramp[None, None, :, None], (STEPS, HEIGHT, 1, 3))
            for step in range(STEPS):
                images[step, 40:60, step : step + 20] = (200, 60 + 40 * episode, 60)
            writer.add(
                Demonstration(
                    Observation(rgb, depth, intrinsics, np.eye(4)), trajectory, RATE_HZ, "push-cube", episode or None
                ),
                images,
            )
    return folder


def check(python: Path, folder: Path, backend: str, frames: Path) -> dict[str, object]:
    """Read ``folder`` with both libraries; a row of what was compared. Stops if they differ."""
    command = [python, "-c", READ_WITH_LEROBOT, folder.resolve(), frames, backend]
    done = subprocess.run(
        command, capture_output=True, text=True, env={"HF_HUB_OFFLINE": "1", "HOME": str(Path.home())}
    )
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        return {"decoder": backend, "result": f"lerobot could not read it: {reason}"}
    told = json.loads(done.stdout.strip().splitlines()[-1])
    theirs = np.load(frames)
    ours = load_demonstrations(folder)
    actions = np.concatenate([demo.trajectory.actions for demo in ours])
    lengths = [len(demo.trajectory) for demo in ours]
    steps = np.concatenate([np.arange(length) for length in lengths])
    agree = {
        "episodes": told["episodes"] == len(ours),
        "frames": told["frames"] == len(actions),
        "episode_index": np.array_equal(theirs["episode_index"], np.repeat(np.arange(len(ours)), lengths)),
        "frame_index": np.array_equal(theirs["frame_index"], steps),
        "timestamp": np.allclose(theirs["timestamp"], steps / ours[0].rate_hz, atol=1e-4),
        "action": np.array_equal(theirs["action"], actions),
        "observation.state": np.array_equal(theirs["observation.state"], actions),
        "delta_timestamps": np.array_equal(theirs["window"], actions[:2]),
    }
    difference = 0.0
    if len(theirs["images"]):
        try:
            images = np.stack([image for episode in range(len(ours)) for image in load_frames(folder, episode)])
        except DatasetError as error:
            sys.exit(str(error))
        difference = float(np.abs(theirs["images"].astype(float) - images).mean(axis=(1, 2, 3)).max())
        agree["images"] = difference <= MAX_IMAGE_DIFFERENCE
    wrong = [name for name, same in agree.items() if not same]
    if wrong:
        sys.exit(f"{folder}: lerobot ({backend}) and this package differ in {', '.join(wrong)}")
    result = f"equal: {', '.join(agree)}"
    return {**told, "decoder": backend, "images": len(theirs["images"]), "difference": difference, "result": result}


def check_import(python: Path, scratch: Path) -> str:
    """Import a dataset that lerobot wrote; a sentence on what was compared. Stops if something differs."""
    random = np.random.default_rng(1)
    poses = np.tile(np.eye(4), (2, 40, 1, 1))
    turns = random.normal(size=(2, 40, 3)).cumsum(axis=1) * 0.02
    poses[..., :3, :3] = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(2, 40, 3, 3)
    poses[..., :3, 3] = random.normal(size=(2, 40, 3)).cumsum(axis=1) * 0.005
    opening = np.repeat([100.0, 0.0], 20)
    states = np.concatenate([poses[..., :3, 3], turns, np.tile(opening, (2, 1))[..., None]], axis=-1)
    depth = random.uniform(0.5, 1.5, (64, 96)).astype(np.float32)
    np.savez(scratch / "given.npz", states=states, depth=depth)
    command = [python, "-c", WRITE_WITH_LEROBOT, scratch / "theirs", scratch / "given.npz", "20"]
    subprocess.run(command, check=True, capture_output=True, text=True, env=OFFLINE)
    triangle = GripperTriangle(length=0.1, opening=0.08)
    rig = Rig(
        triangle,
        intrinsics=np.array([[90.0, 0, 47.5], [0, 90.0, 31.5], [0, 0, 1]]),
        camera_pose=np.eye(4),
        tool=np.eye(4),
        gripper=GripperCommand(open=100, closed=0),
        depth_key="observation.depth",
        depth_unit_m=1.0,
    )
    demos = import_demonstrations(scratch / "theirs", "push-cube", rig)
    largest = max(
        np.abs(triangle.poses(demo.trajectory.triplets[:, 0]) - given).max()
        for demo, given in zip(demos, poses, strict=True)
    )
    agree = {
        "poses": largest < MAX_POSE_DIFFERENCE,
        "gripper": all((demo.trajectory.gripper_state[:, 0] == (opening < 50)).all() for demo in demos),
        "depth": all(np.array_equal(demo.observation.depth, depth) for demo in demos),
        "first image": all(abs(float(demo.observation.rgb.mean()) - 10) < MAX_IMAGE_DIFFERENCE for demo in demos),
        "rate": all(demo.rate_hz == 20.0 for demo in demos),
    }
    wrong = [name for name, same in agree.items() if not same]
    if wrong:
        sys.exit(f"imported from lerobot, {', '.join(wrong)} differ from what was given")
    return (
        f"two episodes written by {LEROBOT.replace('==', ' ')} and imported agree in {', '.join(agree)} "
        f"(largest difference of a pose entry {largest:.1e})."
    )


def table(rows: list[dict[str, object]], folder: str) -> str:
    lines = [
        f"Written by `benchmarks/lerobot_check.py`: {folder}, read with {LEROBOT.replace('==', ' ')} and this package.",
        "",
        "| decoder | torch, torchvision | episodes | frames | images | largest mean difference of an image | result |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        if "lerobot" not in row:
            lines.append(f"| {row['decoder']} | | | | | | {row['result']} |")
            continue
        lines.append(
            f"| {row['decoder']} | {row['torch']}, {row['torchvision']} | {row['episodes']} | {row['frames']} "
            f"| {row['images']} | {row['difference']:.2f} of 255 | {row['result']} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
