"""The interface between a closed-loop policy and a task."""

from typing import Protocol

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray


class Controller(Protocol):
    """A closed-loop policy: it gets new images while it moves."""

    @property
    def rate_hz(self) -> float | None:
        """Of the waypoints it commands; None: that of the task's executed waypoints."""
        ...

    def act(self, observation: Observation, action: FloatArray) -> FloatArray | None:
        """The next waypoints ``(N, 10·A)``, N >= 1, each an action as in `Trajectory`; None once it is done.

        ``observation`` is what the camera of the start observation sees now, ``action (10·A,)`` where the grippers are
        now (points in metres, world frame) with the state they were last told to take.
        """
        ...
