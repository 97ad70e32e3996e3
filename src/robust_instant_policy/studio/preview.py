"""Animation of a plan: a translucent copy of the arms moves along it."""

import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Any, TypeVar

import numpy as np
import viser

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.waypoints import plan_waypoints
from robust_instant_policy.studio.cell import Cell
from robust_instant_policy.studio.stage import place
from robust_instant_policy.trajectory import Trajectory

RATE_HZ, NUM_STEPS = 25.0, 125
T = TypeVar("T")
COLOUR, OPACITY = (46, 134, 171), 0.35


class Preview:
    """Shows one animation at a time in ``scene``, in its own thread."""

    def __init__(self, scene: viser.SceneApi):
        self._scene = scene
        self._stopped = threading.Event()

    def stop(self) -> None:
        self._stopped.set()

    def start(self, trajectory: Trajectory, cell: Cell | None) -> None:
        """Move a copy of the arms of ``cell``, or of the gripper's three points if it has none, along ``trajectory``.
        Raises `UnreachableError`."""
        self.stop()
        self._stopped = stopped = threading.Event()
        if cell is None or not cell.arms:
            sweep = partial(self._sweep_triangle, trajectory, stopped)
        else:  # poses are computed here: the kinematics belong to the session's thread
            joints = plan_waypoints(trajectory, cell.arms, cell.execute_hz, cell.control_hz).joints
            shown = joints[np.linspace(0, len(joints) - 1, NUM_STEPS).astype(int)]
            poses = [
                {
                    name: pose
                    for arm, own in zip(cell.arms, step, strict=True)
                    for name, pose in arm.kinematics.body_poses(own).items()
                }
                for step in shown
            ]
            moving = [name for name, start in poses[0].items() if any((at[name] != start).any() for at in poses)]
            sweep = partial(self._sweep, self._ghost(cell, moving), poses, stopped)
        threading.Thread(target=sweep, name="preview", daemon=True).start()

    def _sweep_triangle(self, trajectory: Trajectory, stopped: threading.Event) -> None:
        node = self._scene.add_line_segments(
            "/ghost/triangle", np.zeros((1, 2, 3)), COLOUR, thickness=6.0, thickness_units="screen"
        )
        for points in _paced(trajectory.resampled(np.linspace(0, 1, NUM_STEPS)).triplets, stopped):
            node.points = np.concatenate([points[:, [0, 1]], points[:, [0, 2]]]).astype(np.float32)
        node.remove()

    def _sweep(self, ghost: dict[str, Any], path: list[dict[str, FloatArray]], stopped: threading.Event) -> None:
        for poses in _paced(path, stopped):
            for name, node in ghost.items():
                place(node, poses[name])
        for node in ghost.values():
            node.remove()

    def _ghost(self, cell: Cell, names: Sequence[str]) -> dict[str, Any]:
        ghost = {}
        for name in names:
            parts = [surface for surface in cell.surfaces() if surface.body == name]
            if parts:
                starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
                ghost[name] = self._scene.add_mesh_simple(
                    f"/ghost/{name.replace('/', '.')}",
                    np.concatenate([part.vertices for part in parts]),
                    np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
                    color=COLOUR,
                    opacity=OPACITY,
                )
        return ghost


def _paced(steps: Iterable[T], stopped: threading.Event) -> Iterator[T]:
    """``steps``, one each 1 / `RATE_HZ` seconds, until ``stopped`` is set."""
    for step in steps:
        if stopped.is_set():
            return
        yield step
        time.sleep(1 / RATE_HZ)
