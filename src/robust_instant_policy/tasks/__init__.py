"""Tasks: a scene, a robot and a demonstrator.

`make_task` makes one by name and imports its simulator. Names are those of this package (`TASK_NAMES`), those that an
entry point registers, and ``module:Class`` for a class of one's own (`own`, docs/own-tasks.md).
"""

from robust_instant_policy.errors import UnknownNameError
from robust_instant_policy.plugins import is_own, load_class
from robust_instant_policy.tasks.families import BENCHMARKS, FAMILIES
from robust_instant_policy.tasks.own import make_own, own_tasks
from robust_instant_policy.tasks.scene_truth import SceneTruth
from robust_instant_policy.tasks.task import Attempt, Execution, FrameSink, Image, Task
from robust_instant_policy.tasks.task_checks import check_task

# Those with a second set of objects, which no demonstration shows.
UNSEEN_TASKS = (
    "close-cabinet", "turn-faucet", "push-cube-anywhere", "stack", "wipe", "sort", "aloha-pick-place", "aloha-sweep",
)  # fmt: skip
TASK_NAMES = tuple(name for family in FAMILIES for name in family.names)
BENCHMARK_NAMES = tuple(name for family in BENCHMARKS for name in family.names)


def make_task(name: str, objects: str = "seen", assets: str = "code", level: str = "paper") -> Task:
    """The task called ``name``: one of `TASK_NAMES` or `BENCHMARK_NAMES`, one that an entry point of the group
    ``robust_instant_policy.tasks`` registers, or ``module:Class``.

    ``objects="unseen"`` uses objects that no demonstration shows, for tasks with two sets;
    ``level`` "paper", "noise" or "hard", see `level.Level`;
    ``assets="maniskill"`` uses YCB and PartNet-Mobility models, if they have been downloaded for ManiSkill.

    Raises `UnknownNameError` for other names, `MissingExtraError` if its simulator is not installed,
    `RendererError` if its camera cannot be rendered, and `UsageError` if a class of one's own cannot be used.
    """
    require_task(name)
    family = next((family for family in (*FAMILIES, *BENCHMARKS) if name in family.names), None)
    if family is None:
        return make_own(name, objects=objects, assets=assets, level=level)
    task: Task = family.make(name, objects, assets, level)
    return task


def is_installed(name: str) -> bool:
    """Whether ``name`` is a task of this package, of a benchmark, or one that an installed package registers."""
    return name in TASK_NAMES or name in BENCHMARK_NAMES or name in own_tasks()


def require_task(name: str) -> None:
    """Raises `UnknownNameError` unless there is a task called ``name``, and `UsageError` where its class is not found.

    Imports no simulator.
    """
    if is_own(name):
        load_class("task", name)
    elif not is_installed(name):
        benchmark = f"{name.partition('/')[0]}/"
        close = [known for known in BENCHMARK_NAMES if known.startswith(benchmark)]
        others = dict.fromkeys(f"{known.partition('/')[0]}/…" for known in BENCHMARK_NAMES)
        raise UnknownNameError("task", name, close or (*TASK_NAMES, *others, *own_tasks(), "your own as module:Class"))


__all__ = [
    "BENCHMARK_NAMES",
    "TASK_NAMES",
    "UNSEEN_TASKS",
    "Attempt",
    "Execution",
    "FrameSink",
    "Image",
    "SceneTruth",
    "Task",
    "check_task",
    "is_installed",
    "make_task",
    "require_task",
]
