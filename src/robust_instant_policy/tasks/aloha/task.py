"""The five tasks of the ALOHA cell as `tasks.task.Task`."""

import gymnasium

import robust_instant_policy.tasks.aloha.envs  # noqa: F401  (registers them)
from robust_instant_policy.tasks.aloha.cell import CONTROL_HZ, WORKSPACE, AlohaEnv
from robust_instant_policy.tasks.aloha.robot import viperx
from robust_instant_policy.tasks.level import Level, make_level
from robust_instant_policy.tasks.simulated_task import SimulatedTask, TaskSpec, Timing, spec_of

# "recorded at 10 Hz, but will be 1 Hz during the test phase to ensure stability" (Oh et al. 2025, Sec. V-A.1)
TIMING = Timing(control_hz=CONTROL_HZ, record_every=5, frame_every=10, execute_hz=1.0)


class CellTask(SimulatedTask):
    """A task of one arm or both; ``objects`` and ``level`` as in `tasks.make_task`, with one source of ``assets``."""

    def __init__(self, spec: TaskSpec, objects: str, assets: str, level: Level):
        env = gymnasium.make(spec.env_id, objects=objects, obs_mode="none", level=level)
        cell: AlohaEnv = env.unwrapped
        self.robot_type = "vx300s" if len(cell.end_effectors) == 1 else "bi_vx300s"
        super().__init__(spec, cell, [viperx(side) for side in cell.end_effectors], TIMING, WORKSPACE, level)


def make(name: str, objects: str, assets: str, level: str) -> CellTask:
    """The task ``name``; its module is called like it."""
    spec = spec_of(f"{__package__}.{name.removeprefix('aloha-').replace('-', '_')}", objects, assets)
    return CellTask(spec, objects, assets, make_level(level))
