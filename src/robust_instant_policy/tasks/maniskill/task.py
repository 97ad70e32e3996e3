"""The tasks of the ManiSkill cell as `tasks.task.Task`."""

import gc
from typing import Any

import gymnasium

from robust_instant_policy.tasks.level import Level, make_level
from robust_instant_policy.tasks.maniskill.arm import EXECUTE_HZ, ur5e_hande
from robust_instant_policy.tasks.maniskill.cell import RECORD_HZ, WORKSPACE
from robust_instant_policy.tasks.maniskill.renderer import require_renderer
from robust_instant_policy.tasks.maniskill.robot import UR5eHandE
from robust_instant_policy.tasks.simulated_task import SimulatedTask, TaskSpec, Timing, spec_of

TIMING = Timing(control_hz=RECORD_HZ, record_every=1, frame_every=4, execute_hz=EXECUTE_HZ)


class ManiSkillTask(SimulatedTask):
    """A `SimulatedTask` that resets quickly.

    The simulator runs the garbage collector whenever it rebuilds a scene. Excluding the objects that exist now (torch
    and other libraries) makes a reset several times faster.
    """

    def __init__(self, *args: Any):
        super().__init__(*args)
        gc.collect()
        gc.freeze()

    def close(self) -> None:
        super().close()
        gc.unfreeze()


class CellTask(ManiSkillTask):
    """A task in the cell with the UR5e; ``objects``, ``assets`` and ``level`` as in `tasks.make_task`."""

    def __init__(self, spec: TaskSpec, objects: str, assets: str, level: Level):
        require_renderer()
        self.robot_type = UR5eHandE.uid
        env = gymnasium.make(
            spec.env_id, obs_mode="none", reward_mode="none", objects=objects, assets=assets, level=level
        )
        super().__init__(spec, env.unwrapped, [ur5e_hande()], TIMING, WORKSPACE, level)


def make(name: str, objects: str, assets: str, level: str) -> CellTask:
    """The task ``name``; its module is called like it."""
    spec = spec_of(f"{__package__}.{name.replace('-', '_')}", objects, assets)
    return CellTask(spec, objects, assets, make_level(level))
