"""The studio's interface to a cell, simulated or recorded."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, GripperTriangle
from robust_instant_policy.motion.arm import Arm


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles ``faces (F, 3)`` over ``vertices (V, 3)``, metres, in the frame of ``body``.

    ``colour (4,)`` is linear RGBA in [0, 1]; it multiplies ``texture (H, W, 3)`` uint8, where there is one, which
    ``uvs (V, 2)`` place on the vertices.
    """

    body: str
    vertices: FloatArray
    faces: NDArray[np.int64]
    colour: FloatArray
    uvs: FloatArray | None = None
    texture: NDArray[np.uint8] | None = None


class Cell(Protocol):
    """A scene with A arms, A >= 0; see the attributes and methods of the same names in `tasks.task.Task`.

    ``arms`` have the start pose of the present scene; a cell without arms can be looked at and planned for.
    ``control_hz`` is the rate of `advance`; every ``record_every``-th step belongs to a demonstration; ``execute_hz``
    is the rate of executed waypoints. ``movable`` names the bodies that `move` can place.
    """

    task: str
    description: str
    goal: str
    arms: Sequence[Arm]
    triangle: GripperTriangle
    control_hz: float
    record_every: int
    execute_hz: float
    workspace: FloatArray | None

    @property
    def movable(self) -> Sequence[str]: ...

    def reset(self, seed: int) -> Observation:
        """Draw the scene of ``seed``, arms at their start; returns its image."""
        ...

    def move(self, body: str, pose: FloatArray) -> Observation:
        """Put ``body`` at ``pose (4, 4)`` before the arms have moved; returns the image of the changed scene."""
        ...

    def surfaces(self) -> Sequence[Surface]:
        """What is to be drawn; the same until the next `reset`."""
        ...

    def poses(self) -> Mapping[str, FloatArray]:
        """Pose ``(4, 4)`` of each body that has a surface."""
        ...

    def tool_poses(self) -> FloatArray:
        """Measured tool poses ``(A, 4, 4)``."""
        ...

    def advance(self, command: FloatArray) -> None:
        """One control step; ``command`` as in `motion.arm.Motion.commands`."""
        ...

    def failure(self) -> str | None:
        """Why the task is not done, empty if it is done, None if the cell cannot tell."""
        ...

    def close(self) -> None: ...
