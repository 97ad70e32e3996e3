"""`rip robot`: check the devices of a cell, or emulate one."""

import argparse
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import CellError
from robust_instant_policy.motion.state import Command
from robust_instant_policy.robots.cell import PACES, CellConfig
from robust_instant_policy.robots.check import check_cell
from robust_instant_policy.robots.emulation.client import devices_of
from robust_instant_policy.robots.emulation.server import serve
from robust_instant_policy.robots.emulation.twin import LaggingTwin, Twin, TwinState
from robust_instant_policy.robots.models import arm_of
from robust_instant_policy.tasks import make_task


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(required=True, metavar="ACTION")
    for name, action, summary in (
        ("check", _check, "look for each device of a cell, and say what is wrong with it and what to do"),
        ("emulate", _emulate, "emulate the devices of a cell with a table [emulation], until standard input ends"),
    ):
        command = actions.add_parser(name, help=summary, description=summary)
        command.add_argument("--robot", type=Path, required=True, metavar="FILE", help="file of the cell")
        command.set_defaults(action=action)


def run(options: argparse.Namespace) -> int:
    return int(options.action(CellConfig.load(options.robot)))


def _check(config: CellConfig) -> int:
    with devices_of(config) as (config, _):
        return check_cell(config, print)


def _emulate(config: CellConfig) -> int:
    serve(config, _twin(config))
    return 0


def _twin(config: CellConfig) -> Twin:
    """The physics that the table [emulation] names: the scene ``seed`` of a ``task``, or arms without a scene."""
    section = config.emulation_section()
    name, seed = section.text("task", ""), section.whole("seed", 0)
    section.number("pace", 1.0, *PACES)
    section.finish()
    if not name:
        arms = [arm_of(arm, config.path.parent) for arm in config.arms]
        return LaggingTwin([arm.home for arm in arms], [arm.finger_travel for arm in arms])
    return TaskTwin(name, seed, len(config.arms))


class TaskTwin:
    """The scene ``seed`` of a simulated task as the physics of emulated arms."""

    def __init__(self, name: str, seed: int, num_arms: int):
        self._renderer = ThreadPoolExecutor(1)  # an OpenGL context belongs to the thread that made it
        task: Any = self._renderer.submit(make_task, name).result()
        if len(task.end_effectors) != num_arms:
            raise CellError(
                f"the task {task.name} has {len(task.end_effectors)} arms ({', '.join(task.end_effectors)}), "
                f"the cell's file {num_arms}"
            )
        self._task = task
        self.reset(seed)

    def reset(self, seed: int) -> None:
        self._renderer.submit(self._task.reset, seed).result()
        self._cell = self._task.cell

    def advance(self, commands: Sequence[Command]) -> None:
        self._cell.advance(np.concatenate([np.append(one.joints, one.finger_travel) for one in commands]))

    def states(self) -> Sequence[TwinState]:
        measured, loads = self._cell.measured(), self._cell.grip_loads()
        rows = measured.reshape(len(loads), -1)
        return [TwinState(row[:-1], float(row[-1]), float(load)) for row, load in zip(rows, loads, strict=True)]

    def photograph(self) -> Callable[[], Observation]:
        cell = self._cell
        if not isinstance(getattr(cell, "data", None), mujoco.MjData):  # SAPIEN renders the scene itself
            seen = self._renderer.submit(cell.photograph).result()
            return lambda: seen
        still = copy(cell)
        still.data = copy(cell.data)
        return self._renderer.submit(still.photograph).result

    def failure(self) -> str:
        return str(self._cell.failure())
