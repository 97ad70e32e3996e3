"""Classes of the user's own, named ``module:Class`` or registered by an entry point."""

import os
import re
import sys
from importlib import import_module
from importlib.metadata import entry_points
from types import ModuleType

from robust_instant_policy.errors import UsageError

OWN = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def is_own(name: str) -> bool:
    """Whether ``name`` is written as ``module:Class``."""
    return OWN.fullmatch(name) is not None


def registered(group: str) -> dict[str, str]:
    """``module:Class`` of every entry point of ``group`` by its name."""
    return {point.name: point.value for point in entry_points(group=group)}


def own_module(name: str) -> ModuleType:
    """A module that is installed or lies in the working directory. It runs the module's code, see `load_class`."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    return import_module(name)


def load_class(kind: str, spec: str) -> type:
    """The class ``module:Class``, where the module is installed or lies in the working directory.

    It runs the module's code, so ``spec`` must come from the user, never from a file. Raises `UsageError`.
    """
    module_name, _, class_name = spec.partition(":")
    try:
        module = own_module(module_name)
    except ModuleNotFoundError as error:
        if error.name and (module_name == error.name or module_name.startswith(f"{error.name}.")):
            problem = f"there is no module {error.name} in {os.getcwd()} or among the installed packages"
        else:
            problem = f"its module needs {error.name}, which is not installed"
        raise UsageError(f"{kind} {spec!r}: {problem}") from None
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        own = [
            name for name, value in vars(module).items() if isinstance(value, type) and value.__module__ == module_name
        ]
        raise UsageError(
            f"{kind} {spec!r}: {module_name} has no class {class_name}; its classes: {', '.join(own) or 'none'}"
        )
    return found
