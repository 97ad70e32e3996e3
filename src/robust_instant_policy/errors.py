"""Errors a user may meet. Each is one line that says what is wrong and what to do next.

The command turns them into exit codes: 2 for wrong usage, 1 for everything else that broke.
"""

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager


class RipError(Exception):
    """Base of all errors of this package."""

    exit_code = 1


class UsageError(RipError):
    """The call or the command line asks for something that does not exist."""

    exit_code = 2


class UnknownNameError(UsageError):
    """A task, method or other named thing that is not there; names the ones that are."""

    def __init__(self, kind: str, name: str, known: Iterable[str]):
        super().__init__(f"unknown {kind} {name!r}; known: {', '.join(known)}")
        self.kind, self.name = kind, name


class MissingExtraError(RipError):
    """An optional dependency is not installed."""

    def __init__(self, package: str, extra: str):
        super().__init__(f"{package} is not installed; run: {install_command(extra)}")
        self.package, self.extra = package, extra


@contextmanager
def needs_extra(extra: str, library: str | None = None) -> Iterator[None]:
    """Raises `MissingExtraError` for a package that the ``with`` block imports and that is not installed, and
    `UsageError` for one that is, but cannot be loaded, for instance without ``library``, a package of Debian."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("robust_instant_policy"):
            raise
        raise MissingExtraError(error.name, extra) from error
    except ImportError as error:
        if (error.name or "").startswith("robust_instant_policy"):
            raise
        remedy = f"on Debian: apt install {library}" if library else f"try: {install_command(extra)}"
        raise UsageError(f"a package that is installed cannot be loaded: {error}; {remedy}") from error


def install_command(extra: str) -> str:
    """What installs an extra. Simulators that require packages which are too old, or are not there for Python 3.13, are
    installed without them."""
    command = f"pip install 'robust-instant-policy[{extra}]'"
    simulator = {"metaworld": "metaworld"}.get(extra)
    if sys.version_info >= (3, 13):
        simulator = simulator or {"sim": "mani_skill", "aloha": "gym-aloha"}.get(extra)
    return f"{command} && pip install --no-deps {simulator}" if simulator else command


class MissingMethodError(UsageError):
    """A user's task that lacks an optional method."""

    def __init__(self, task: str, method: str, purpose: str):
        super().__init__(f"the task {task} has no {method}(), which is needed {purpose} (docs/own-tasks.md)")
        self.task, self.method = task, method


class InvalidValueError(RipError, ValueError):
    """An array or number that breaks its contract; names the argument and its shape."""


class DatasetError(RipError):
    """A demonstrations folder that is missing, empty, half-written or of another task."""


class NoDemonstrationsError(DatasetError):
    """A demonstrations folder in which nothing was recorded so far; recording may begin or go on there."""


class KeypointError(RipError):
    """The images show too little in common, or too little of it has depth."""


class PlanningError(RipError):
    """The language model gave too few usable answers to make a plan."""


class ModelError(RipError):
    """A language model or network that cannot be loaded or reached."""


class RendererError(RipError):
    """No usable renderer for the simulator's camera."""


class UnreachableError(RipError):
    """A trajectory that the arm must not or cannot follow."""


class CellError(RipError):
    """The file of a cell is missing or wrong; names the file and the key."""


class RobotError(RipError):
    """An arm, a leader or a camera that is missing, faulty or does not answer."""


class StoppedError(RobotError):
    """A motion was stopped: the arms hold their position; says what was wrong and what to do."""


class CalibrationError(RipError):
    """A calibration that the measurements do not determine or contradict; names the likely mistake."""
