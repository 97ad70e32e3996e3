from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from lerobot.teleoperators import Teleoperator

from robust_instant_policy.errors import UsageError
from robust_instant_policy.geometry import FloatArray

from .config_rip import RipTwinLeaderConfig
from .twin import RipTwin

HOME_SECONDS = 2.0


class RipTwinLeader(Teleoperator):
    """The operator of a `RipTwin`: demonstrates, brings the arms home, lays out the next scene, and so on.

    It says when to press ``n``, LeRobot's key for the end of an episode and for the end of the pause after it.
    """

    config_class = RipTwinLeaderConfig
    name = "rip_twin_leader"

    def __init__(self, config: RipTwinLeaderConfig):
        super().__init__(config)
        self.config = config
        self._actions: Iterator[FloatArray] | None = None

    @property
    def action_features(self) -> dict[str, Any]:
        return _twin().action_features

    @property
    def feedback_features(self) -> dict[str, Any]:
        return {}

    @property
    def is_connected(self) -> bool:
        return self._actions is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        """Nothing to calibrate."""

    def configure(self) -> None:
        """Nothing to configure."""

    def connect(self, calibrate: bool = True) -> None:
        self._actions = self._operate()

    def disconnect(self) -> None:
        self._actions = None

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """The leader feels nothing."""

    def get_action(self) -> dict[str, Any]:
        if self._actions is None:
            raise UsageError("connect the leader first")
        action = next(self._actions)
        return dict(zip(_twin().embodiment.axes, map(float, action), strict=True))

    def _operate(self) -> Iterator[FloatArray]:
        twin = _twin()
        pause, back = (round(seconds * twin.config.fps) for seconds in (self.config.pause_s, HOME_SECONDS))
        while True:
            demonstration, home = twin.demonstration(), twin.home()
            yield from demonstration
            print(f"leader: scene {twin.seed}: {twin.task.cell.failure() or 'done'}; press n", flush=True)
            yield from [demonstration[-1]] * pause
            yield from (demonstration[-1] + share * (home - demonstration[-1]) for share in np.arange(1, back) / back)
            twin.lay_out(twin.seed + 1)
            print("leader: the next scene is ready; press n", flush=True)
            yield from [home] * pause


def _twin() -> RipTwin:
    if RipTwin.connected is None:
        raise UsageError("rip_twin_leader moves the robot rip_twin only: --robot.type=rip_twin")
    return RipTwin.connected
