"""Tasks: a scene, a robot and a demonstrator.

`make_task` makes one by name and imports its simulator.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module

from robust_instant_policy.errors import MissingExtraError, UnknownNameError
from robust_instant_policy.tasks.level import make_level
from robust_instant_policy.tasks.task import Attempt, Execution, FrameSink, Image, Task


@dataclass(frozen=True)
class Family:
    """Tasks that share a simulator: their ``names``, which after ``prefix`` name the modules of a ``package``."""

    package: str
    extra: str
    prefix: str
    names: tuple[str, ...]

    def module_of(self, name: str) -> str:
        return name.removeprefix(self.prefix).replace("-", "_")


FAMILIES = (
    Family("maniskill", "sim", "", ("pick-banana", "push-cube", "open-drawer", "close-cabinet", "turn-faucet")),
    Family("maniskill", "sim", "", ("push-cube-anywhere", "stack", "wipe", "sort")),  # relations between things
    Family(
        "aloha",
        "aloha",
        "aloha-",
        ("aloha-pick-banana", "aloha-hang", "aloha-cup-upright", "aloha-sweep", "aloha-pick-place"),
    ),
)
# Those with a second set of objects, which no demonstration shows.
UNSEEN_TASKS = (
    "close-cabinet", "turn-faucet", "push-cube-anywhere", "stack", "wipe", "sort", "aloha-pick-place", "aloha-sweep",
)  # fmt: skip
TASK_NAMES = tuple(name for family in FAMILIES for name in family.names)


def make_task(name: str, objects: str = "seen", assets: str = "code", level: str = "paper") -> Task:
    """The task called ``name``, one of `TASK_NAMES`.

    ``objects="unseen"`` uses objects that no demonstration shows, for tasks with two sets;
    ``level`` "paper" or "hard", see `level.Level`;
    ``assets="maniskill"`` uses YCB and PartNet-Mobility models, if they have been downloaded for ManiSkill.

    Raises `UnknownNameError` for other names, `MissingExtraError` if its simulator is not installed, and
    `RendererError` if its camera cannot be rendered.
    """
    if name not in TASK_NAMES:
        raise UnknownNameError("task", name, TASK_NAMES)
    family = next(family for family in FAMILIES if name in family.names)
    try:
        package = f"robust_instant_policy.tasks.{family.package}"
        make = import_module(f"{package}.task").CellTask
        module = import_module(f"{package}.{family.module_of(name)}")
    except ModuleNotFoundError as error:
        if error.name and error.name.startswith("robust_instant_policy"):
            raise
        raise MissingExtraError(error.name or family.extra, family.extra) from error
    if objects not in module.SPEC.object_sets:
        raise UnknownNameError(f"set of objects of {name}", objects, module.SPEC.object_sets)
    if assets not in module.SPEC.asset_sources:
        raise UnknownNameError(f"source of assets of {name}", assets, module.SPEC.asset_sources)
    task: Task = make(module.SPEC, objects, assets, make_level(level))
    return task


__all__ = [
    "TASK_NAMES",
    "UNSEEN_TASKS",
    "Attempt",
    "Execution",
    "FrameSink",
    "Image",
    "Task",
    "make_task",
]
