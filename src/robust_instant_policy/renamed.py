"""Old spellings of public names, which keep working for one version, with a warning."""

import warnings
from collections.abc import Callable, Mapping
from importlib import import_module


def renamed(package: str, names: Mapping[str, str]) -> Callable[[str], object]:
    """The ``__getattr__`` of ``package`` that finds the old ``names``, each with ``module:name`` of the new place.

    Modules are named as text, as no room imports one above it.
    """

    def find(name: str) -> object:
        if name not in names:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, _, new = names[name].partition(":")
        message = f"{package}.{name} is {module}.{new} now; the old name goes in the next version"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        return getattr(import_module(module), new)

    return find
