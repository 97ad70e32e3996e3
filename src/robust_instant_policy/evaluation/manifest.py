"""The suites of a run's folder, and the commands, code and machines that produced it."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from robust_instant_policy.errors import DatasetError
from robust_instant_policy.evaluation.suites import Suite
from robust_instant_policy.files import parse_json, read_regular, write_whole

MANIFEST_FILE = "run.json"
GIB = 2**30
PACKAGE = Path(__file__).parents[1]
# These rooms and files do not decide results; everything else in the package does.
NOT_DECIDING = ("commands", "reporting", "serving", "robots", "evaluation", "cli.py", "errors.py", "files.py")
DECIDING = ("evaluation/rollout.py", "evaluation/workbench.py")


@dataclass(frozen=True)
class Invocation:
    """One command that added rows to a folder: its start (UTC), duration, machine, code and model."""

    command: str
    began: str
    hours: float
    machine: str
    code: str
    model: str


@dataclass(frozen=True)
class Manifest:
    """Suites, one for each name and set of objects, and commands, oldest first."""

    suites: tuple[Suite, ...] = ()
    invocations: tuple[Invocation, ...] = ()

    @classmethod
    def read(cls, path: Path) -> Manifest:
        """Read a ``run.json``; empty if it does not exist. Raises `DatasetError` for a damaged file."""
        if not path.exists():
            return cls()
        try:
            content = parse_json(read_regular(path))
            return cls(
                tuple(Suite.from_json(one) for one in content["suites"]),
                tuple(Invocation(**one) for one in content["invocations"]),
            )
        except (KeyError, ValueError, TypeError) as error:
            raise DatasetError(f"{path} is damaged ({error}); move it away and run the same command again") from None

    def write(self, path: Path) -> None:
        text = json.dumps(asdict(self), indent=1) + "\n"  # an infinite ν is written as Infinity, as Python reads it
        write_whole(path, text.encode())


@cache
def code_digest(package: Path = PACKAGE) -> str:
    """Short digest of the files of ``package`` that decide results: equal code gives equal rows.

    A commit that changes documents, pages or commands only does not change it.
    """
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*")):
        name = path.relative_to(package).as_posix()
        if path.suffix not in (".py", ".urdf"):
            continue
        if name.split("/")[0] not in NOT_DECIDING or name in DECIDING:
            digest.update(name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]


def machine() -> str:
    """Processor, cores, memory and system in one line."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GIB
    return f"{os.cpu_count()} cores ({_processor()}), {memory:.0f} GiB, {platform.system()} {platform.release()}"


def code_version() -> str:
    """Version of the package, with the commit where it runs from a checkout."""
    try:
        name = version("robust-instant-policy")
    except PackageNotFoundError:
        name = "unknown version"
    found = subprocess.run(
        ["git", "-C", str(PACKAGE), "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=False
    )
    return f"{name} ({found.stdout.strip()})" if found.returncode == 0 else name


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
