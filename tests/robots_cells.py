"""Cells and motions that the tests of real arms share."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from robust_instant_policy.geometry import GripperTriangle
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.limits import Limits
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.models import arm_of
from robust_instant_policy.trajectory import Trajectory

WORKSPACE = [[-0.30, -0.32, -0.005], [0.35, 0.32, 0.40]]
BASES = {"left": [-0.469, 0, 0, 0, 0, 0], "right": [0.469, 0, 0, 0, 0, 180]}
PARK = [-1.4, -0.43, 0.434, 0, 1.567, 0]


def write_cell(folder: Path, *names: str, pace: float = 5.0, more: str = "", kind: str = "viperx") -> Path:
    """A cell of emulated ViperX arms without a scene, on a table of its own."""
    text = f"[cell]\nworkspace = {WORKSPACE}\n{more}\n"
    for name in names:
        driver = f'{{ kind = "{kind}", port = "" }}'
        text += f'[[arms]]\nname = "{name}"\nmodel = "viperx-300"\nbase = {BASES[name]}\npark = {PARK}\n'
        text += f"driver = {driver}\n"
    text += f"[emulation]\npace = {pace}\n"
    path = folder / "cell.toml"
    path.write_text(text)
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
