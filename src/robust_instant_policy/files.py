"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from robust_instant_policy.errors import DatasetError

PART_SUFFIX = ".part"  # of hidden files under way; what still bears it was left by a killed process
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def write_whole(path: Path, content: bytes) -> None:
    """Write ``path`` so that a crash leaves either its old content or all of the new one.

    The content goes to a hidden neighbour, to the disk itself, and only then takes its name.
    Raises `DatasetError` when it cannot be written; the old content then still stands.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}{PART_SUFFIX}")
    try:
        make_folder(path.parent)
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise write_error(path, error) from error


def make_folder(path: Path) -> None:
    """Create ``path`` and its parents, durably."""
    if path.is_dir():
        return
    make_folder(path.parent)
    path.mkdir(exist_ok=True)
    _sync_folder(path.parent)


def finished_files(path: Path) -> Iterator[Path]:
    """The files below ``path`` but those left under way by a killed process."""
    return (file for file in path.rglob("*") if file.is_file() and not file.name.endswith(PART_SUFFIX))


def write_error(path: Path, error: OSError) -> DatasetError:
    """What to tell the user when ``path`` could not be written."""
    if error.errno in NO_SPACE:
        return DatasetError(
            f"no space left to write {path}; episodes recorded so far are safe: free some space and run the same again"
        )
    return DatasetError(f"cannot write {path}: {error.strerror or error}")


def lock_folder(path: Path) -> int:
    """Take the folder for this process and return the descriptor to close; the lock ends with the process.

    Raises `DatasetError` when another process is writing to it.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        raise DatasetError(f"another process is writing into {path}; wait for it or choose another folder") from error
    return descriptor


def _sync_folder(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
