"""Scenes with a robot in them and a person who can show what to do.

`make_task` makes one by name; the simulators are imported only then.
"""

from __future__ import annotations

from importlib import import_module

from robust_instant_policy.errors import MissingExtraError, UnknownNameError
from robust_instant_policy.tasks.task import Attempt, Execution, FrameSink, Image, Task

TASK_NAMES = ("pick-banana", "push-cube", "open-drawer", "close-cabinet", "turn-faucet")


def make_task(name: str, objects: str = "seen") -> Task:
    """The task called ``name``, one of `TASK_NAMES`.

    ``objects="unseen"`` takes objects that no demonstration shows, for the tasks that have two sets.

    Raises `UnknownNameError` for other names, `MissingExtraError` where its simulator is not installed, and
    `RendererError` where nothing can render its camera.
    """
    if name not in TASK_NAMES:
        raise UnknownNameError("task", name, TASK_NAMES)
    try:
        simulated = import_module("robust_instant_policy.tasks.maniskill.simulated_task")
        module = import_module(f"robust_instant_policy.tasks.maniskill.{name.replace('-', '_')}")
    except ModuleNotFoundError as error:
        if error.name and error.name.startswith("robust_instant_policy"):
            raise
        raise MissingExtraError(error.name or "mani_skill", "sim") from error
    object_sets = module.SPEC.object_sets or ("seen",)
    if objects not in object_sets:
        raise UnknownNameError(f"set of objects of {name}", objects, object_sets)
    task: Task = simulated.SimulatedTask(module.SPEC, objects)
    return task


__all__ = [
    "TASK_NAMES",
    "Attempt",
    "Execution",
    "FrameSink",
    "Image",
    "Task",
    "make_task",
]
