"""Tasks of one's own: any class with `reset` and `execute`, named ``module:Class`` or registered by an entry point."""

from inspect import getdoc
from typing import Any

from robust_instant_policy.errors import UsageError
from robust_instant_policy.plugins import is_own, load_class, registered
from robust_instant_policy.tasks.task import Task

ENTRY_POINTS = "robust_instant_policy.tasks"
DEFAULTS: dict[str, Any] = {
    "goal": "the task is done",
    "end_effectors": ("gripper",),
    "record_hz": 10.0,
    "execute_hz": 10.0,
    "video_hz": 10.0,
    "workspace": None,
}


def own_tasks() -> dict[str, str]:
    """``module:Class`` of the tasks that installed packages register, by name."""
    return registered(ENTRY_POINTS)


def make_own(name: str, **options: str) -> Task:
    """The task ``name``, ``module:Class`` or one of `own_tasks`.

    It is made with those of ``options`` (``objects``, ``assets``, ``level``) that are not the usual ones.

    The attributes that its class lacks get their `DEFAULTS`; its ``description`` is the first line of its docstring.
    Raises `UsageError` where there is no such class, or it cannot be made or lacks a method that every task needs.
    """
    kind = load_class("task", name if is_own(name) else own_tasks()[name])
    unusual = {
        key: value
        for key, value in options.items()
        if value != {"objects": "seen", "assets": "code", "level": "paper"}[key]
    }
    for method in ("reset", "execute"):
        if not callable(getattr(kind, method, None)):
            raise UsageError(
                f"the task {name} has no {method}(); every task needs reset and execute (docs/own-tasks.md)"
            )
    try:
        task = kind(**unusual)
    except TypeError as error:
        given = ", ".join(f"{key}={value!r}" for key, value in unusual.items())
        raise UsageError(f"the task {name} cannot be made with ({given}): {error}") from error
    description = (getdoc(kind) or name).splitlines()[0]
    for attribute, default in {**DEFAULTS, "description": description, "close": _nothing}.items():
        if not hasattr(task, attribute):
            setattr(task, attribute, default)
    try:
        task.name = name
    except AttributeError:
        raise UsageError(f"the task {name} must let its attribute name be set; it is the name you gave") from None
    return task


def _nothing() -> None:
    """`close` of a task that holds nothing."""
