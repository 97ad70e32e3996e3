"""Cells and motions that the tests of real arms share."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from robust_instant_policy.geometry import GripperTriangle
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.limits import Limits
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.emulation.client import Emulation
from robust_instant_policy.robots.models import arm_of
from robust_instant_policy.trajectory import Trajectory

WORKSPACE = [[-0.30, -0.32, -0.005], [0.35, 0.32, 0.40]]
BASES = {"left": [-0.469, 0, 0, 0, 0, 0], "right": [0.469, 0, 0, 0, 0, 180], "hand-e": [-0.5, 0, 0, 0, 0, 0]}
VIPERX = "viperx", "viperx-300", [-1.4, -0.43, 0.434, 0, 1.567, 0]
UR5E = "ur5e", "ur5e-hand-e", [0.9, -1.9, 2.2, -1.87, -1.5708, -0.67]


def write_cell(folder: Path, *names: str, pace: float = 20.0) -> Path:
    """A cell of emulated arms without a scene: "left" and "right" are ViperX 300, "hand-e" is a UR5e."""
    text = f"[cell]\nworkspace = {WORKSPACE}\n"
    for name in names:
        kind, model, park = UR5E if name == "hand-e" else VIPERX
        text += f'[[arms]]\nname = "{name}"\nmodel = "{model}"\nbase = {BASES[name]}\npark = {park}\n'
        text += f'driver = {{ kind = "{kind}" }}\n'
    path = folder / "cell.toml"
    path.write_text(f"{text}[emulation]\npace = {pace}\n")
    return path


def arms_of(path: Path) -> tuple[list[Arm], Limits]:
    config = CellConfig.load(path)
    return [arm_of(one, path.parent) for one in config.arms], config.limits


def reach(triangle: GripperTriangle, *points: tuple[float, float, float], yaw: float = 0.0, closed=()) -> Trajectory:
    """A trajectory of one gripper that points down at ``points``; ``closed`` are the steps with a closed gripper."""
    poses = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (len(points), 1, 1))
    poses[:, :3, 3] = points
    for pose, angle in zip(poses, np.linspace(0.0, yaw, len(points)), strict=True):
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        pose[:3, :3] = turn @ pose[:3, :3]
    state = np.isin(np.arange(len(points)), closed).astype(float)
    return Trajectory.from_poses(poses, state, triangle)


def after(emulation: Emulation, steps: int, action: Callable[..., object], *arguments: object) -> threading.Thread:
    """Do something once the arms executed a number of further commands."""
    begun = len(emulation.commands())

    def wait() -> None:
        while len(emulation.commands()) < begun + steps:
            time.sleep(0.01)
        action(*arguments)

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    return thread
