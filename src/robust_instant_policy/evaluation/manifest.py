"""``run.json``: which suites a folder holds, by which commands, where and for how long they were run. No secrets."""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from robust_instant_policy.errors import DatasetError
from robust_instant_policy.evaluation.suites import Suite
from robust_instant_policy.evaluation.variant import Variant
from robust_instant_policy.files import write_whole

MANIFEST_FILE = "run.json"
GIB = 2**30


@dataclass(frozen=True)
class Invocation:
    """One command that added to a folder: when it began (UTC), how long it worked, on what and with which code."""

    command: str
    began: str
    hours: float
    machine: str
    code: str
    model: str


@dataclass(frozen=True)
class Manifest:
    """All that ``run.json`` says: suites of one name and the same objects are one, invocations are oldest first."""

    suites: tuple[Suite, ...] = ()
    invocations: tuple[Invocation, ...] = ()

    @classmethod
    def read(cls, folder: Path) -> Manifest:
        """Of ``folder``; empty where nothing was run. Raises `DatasetError` for a damaged file."""
        path = folder / MANIFEST_FILE
        if not path.exists():
            return cls()
        try:
            content = json.loads(path.read_text())
            return cls(
                tuple(_suite(one) for one in content["suites"]),
                tuple(Invocation(**one) for one in content["invocations"]),
            )
        except (KeyError, ValueError, TypeError) as error:
            raise DatasetError(f"{path} is damaged ({error}); move it away and run the same command again") from None

    def write(self, folder: Path) -> None:
        text = json.dumps(asdict(self), indent=1) + "\n"  # an infinite ν is written as Infinity, as Python reads it
        write_whole(folder / MANIFEST_FILE, text.encode())

    def with_suites(self, suites: Iterable[Suite]) -> Manifest:
        known = {(suite.name, suite.objects, suite.assets): suite for suite in self.suites}
        for suite in suites:
            key = suite.name, suite.objects, suite.assets
            known[key] = known[key].merged(suite) if key in known else suite
        return replace(self, suites=tuple(known.values()))

    def joined(self, other: Manifest) -> Manifest:
        """What both of them say, each command once."""
        commands = dict.fromkeys((*self.invocations, *other.invocations))
        return replace(
            self.with_suites(other.suites), invocations=tuple(sorted(commands, key=lambda command: command.began))
        )


def _suite(content: dict) -> Suite:
    variants = tuple(Variant(**one) for one in content["variants"])
    return Suite(
        content["name"],
        tuple(content["tasks"]),
        variants,
        tuple(content["seeds"]),
        content["objects"],
        content.get("assets", "code"),
    )


@contextmanager
def invocation(folder: Path, suites: Sequence[Suite], arguments: Sequence[str], model: str) -> Iterator[None]:
    """Note in ``folder/run.json`` what is done meanwhile, whether it ends well or is stopped."""
    manifest = Manifest.read(folder).with_suites(suites)
    manifest.write(folder)
    began, start = datetime.now(UTC), time.monotonic()
    try:
        yield
    finally:
        now = Invocation(
            command=shlex.join(arguments),
            began=began.isoformat(timespec="seconds"),
            hours=round((time.monotonic() - start) / 3600, 4),
            machine=machine(),
            code=code(),
            model=model,
        )
        replace(manifest, invocations=(*manifest.invocations, now)).write(folder)


def machine() -> str:
    """Processor, cores, memory and system in one line."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / GIB
    return f"{os.cpu_count()} cores ({_processor()}), {memory:.0f} GiB, {platform.system()} {platform.release()}"


def code() -> str:
    """Version of the package, with the commit where it runs from a checkout."""
    try:
        name = version("robust-instant-policy")
    except PackageNotFoundError:
        name = "unknown version"
    here = Path(__file__).parent
    found = subprocess.run(
        ["git", "-C", str(here), "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=False
    )
    return f"{name} ({found.stdout.strip()})" if found.returncode == 0 else name


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
