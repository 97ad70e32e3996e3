"""A cell without a simulator or arm: the photographs of a folder of demonstrations."""

from collections.abc import Mapping, Sequence

import numpy as np

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import UsageError
from robust_instant_policy.geometry import FloatArray, GripperTriangle
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.studio.cell import Surface


class RecordedCell:
    """Scenes that were photographed, without arms; see `cell.Cell`.

    Scene 0 is the new ``observation``, where there is one; the others are those of ``demonstrations``.
    """

    arms: Sequence[Arm] = ()
    movable: Sequence[str] = ()
    goal = ""
    control_hz = execute_hz = 1.0
    record_every = 1
    workspace: FloatArray | None = None

    def __init__(self, name: str, demonstrations: Sequence[Demonstration], observation: Observation | None):
        self.task = self.description = name
        if not demonstrations:
            raise UsageError(f"{name} has no demonstrations; give a folder with --demos, or record some")
        new = {} if observation is None else {"new observation": observation}
        seen = {f"demonstration {index}": one.observation for index, one in enumerate(demonstrations, 1)}
        self._scenes = [*new.items(), *seen.items()]
        self.triangle = GripperTriangle.from_triplets(
            np.concatenate([one.trajectory.triplets.reshape(-1, 3, 3) for one in demonstrations])
        )

    def reset(self, seed: int) -> Observation:
        name, observation = self._scenes[seed % len(self._scenes)]
        self.description = f"{self.task}: {name}"
        return observation

    def move(self, body: str, pose: FloatArray) -> Observation:
        raise UsageError("a photographed scene cannot be changed")

    def surfaces(self) -> Sequence[Surface]:
        return ()

    def poses(self) -> Mapping[str, FloatArray]:
        return {}

    def tool_poses(self) -> FloatArray:
        return np.zeros((0, 4, 4))

    def advance(self, command: FloatArray) -> None:
        raise UsageError("a photographed scene has no arm")

    def failure(self) -> str | None:
        return None

    def close(self) -> None:
        pass
