"""Files on disk: written whole or not at all, and read only where they are regular files."""

import contextlib
import errno
import fcntl
import grp
import hashlib
import io
import json
import os
import pwd
import secrets
import shutil
import stat
import sys
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from tokenize import TokenError
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.errors import DatasetError

MAX_JSON_BYTES = 64 * 2**20
MAX_EXCERPT = 240  # characters of a file that an error quotes
KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFLNK: "a symbolic link",
}
PART_SUFFIX = ".part"  # of hidden files under way; a file with it was left by a killed process
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def open_regular(path: str | Path) -> BinaryIO:
    """Open a regular file for reading; every reader of a file from outside goes through here.

    Opening a pipe or a device can block or have side effects, and their content has no end. Raises
    `FileNotFoundError` for a file that is missing, `DatasetError` for one of these, a folder, and a file that may not
    be read: its content may be sound.
    """
    try:
        _require_regular(path, os.stat(_checked_name(path)).st_mode)
        file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))  # noqa: SIM115
    except FileNotFoundError:
        raise
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror or error}") from None
    try:
        _require_regular(path, os.fstat(file.fileno()).st_mode)  # the one opened: the name may have been replaced
    except DatasetError:
        file.close()
        raise
    return file


def read_regular(path: str | Path) -> bytes:
    """The content of a regular file; raises as `open_regular` does."""
    with open_regular(path) as file:
        return file.read()


def read_json(path: str | Path, kind: str = "a JSON object") -> dict[str, Any]:
    """The JSON object in a regular file. Raises `DatasetError` that names the file and the ``kind`` it should be."""
    try:
        with open_regular(path) as file:
            text = file.read(MAX_JSON_BYTES + 1)
        if len(text) > MAX_JSON_BYTES:
            raise DatasetError(f"{path} is larger than {MAX_JSON_BYTES >> 20} MiB, too large for such a file")
        content = parse_json(text)
    except FileNotFoundError:
        raise DatasetError(f"{path} is missing; restore it, or write it again") from None
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path} is not {kind}: it cannot be read as JSON; restore it, or write it again") from error
    if not isinstance(content, dict):
        raise DatasetError(f"{path} is not {kind}: it must hold a JSON object; restore it, or write it again")
    return content


def parse_json(text: str | bytes) -> Any:
    """Parse JSON from outside. Raises `ValueError`, also for deep nesting and for integers beyond a float."""
    try:
        return json.loads(text, parse_int=_whole)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _whole(digits: str) -> int:
    if len(digits.lstrip("-")) > sys.float_info.max_10_exp:
        raise ValueError(f"an integer of {len(digits)} digits")
    return int(digits)


# What zipfile, zlib and NumPy's header reader raise for content that is not theirs.
UNREADABLE_NPZ = (
    OSError, ValueError, EOFError, RuntimeError, MemoryError, SyntaxError, LookupError, TypeError, OverflowError,
    zipfile.BadZipFile, zlib.error, TokenError,
)  # fmt: skip


def npz(arrays: Mapping[str, object]) -> bytes:
    """The content of a compressed ``.npz`` file."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def load_arrays(path: Path, names: Collection[str], advice: str) -> dict[str, NDArray]:
    """The arrays of an ``.npz`` file, ``names`` among them. Raises `DatasetError` that ends with the ``advice``."""
    try:
        with open_regular(path) as file, np.load(file, allow_pickle=False) as archive:
            arrays = dict(archive)
        if lacking := [name for name in names if name not in arrays]:
            raise ValueError(f"it lacks {', '.join(lacking)}")
        return arrays
    except FileNotFoundError:
        raise DatasetError(f"{path} is missing; {advice}") from None
    except (*UNREADABLE_NPZ, AttributeError) as error:
        raise DatasetError(f"{path} is damaged ({error}); {advice}") from None


def sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def others_can_write(path: Path, in_own_group: bool = True) -> bool:
    """Whether another user could exchange a file, or one in a folder, between its check and its use.

    Many systems make files writable for a group of which their owner is the only member; without ``in_own_group`` such
    a group is ignored.
    """
    status = path.stat()
    if status.st_uid not in (0, os.geteuid()) or status.st_mode & stat.S_IWOTH:
        return True
    return bool(status.st_mode & stat.S_IWGRP) and (in_own_group or not _is_own_group(status.st_gid))


def _is_own_group(number: int) -> bool:
    """Whether a group is that of this user alone."""
    try:
        group, user = grp.getgrgid(number), pwd.getpwuid(os.geteuid())
    except KeyError:
        return False
    return group.gr_name == user.pw_name and not set(group.gr_mem) - {user.pw_name}


def _checked_name(path: str | Path) -> str | Path:
    if "\0" in str(path):
        raise DatasetError(f"{str(path)!r} is no file name: it holds a null character")
    return path


def _require_regular(path: str | Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        raise DatasetError(f"{path} is {KINDS.get(stat.S_IFMT(mode), 'something else')}, not a regular file")


def excerpt(said: str | Path | Exception) -> str:
    """Text of a file or an error on one line of at most `MAX_EXCERPT` characters."""
    text = " ".join(str(said).split())
    return text if len(text) <= MAX_EXCERPT else text[:MAX_EXCERPT] + "…"


def write_whole(path: Path, content: bytes) -> None:
    """Write ``path`` so that a crash leaves either its old content or all of the new one.

    The content goes to a hidden neighbour, to the disk itself, and only then takes its name. That would put a file in
    the place of a device, a pipe or a link, so only a regular file is replaced.
    Raises `DatasetError` when it cannot be written; the old content then still stands.
    """
    require_replaceable(path)
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


def require_replaceable(path: Path) -> None:
    """Raises `DatasetError` where ``path`` is there and is not a regular file."""
    try:
        mode = os.lstat(_checked_name(path)).st_mode
    except OSError:  # nothing there, or the attempt to write will tell
        return
    _require_regular(path, mode)


def require_writable(path: Path) -> None:
    """Raises `DatasetError` where the file ``path`` could not be written: to call before long work. Creates nothing."""
    require_replaceable(path)
    folder = next(one for one in path.absolute().parents if one.exists())
    if not folder.is_dir():
        raise DatasetError(f"{folder} is a file, not a folder; choose another folder")
    if not os.access(folder, os.W_OK):
        raise DatasetError(f"{folder} is not writable; choose another folder")


def make_folder(path: Path) -> None:
    """Create ``path`` and its parents, durably. Raises `DatasetError`."""
    if path.is_dir():
        return
    make_folder(path.parent)
    try:
        path.mkdir(exist_ok=True)
        _sync_folder(path.parent)
    except OSError as error:
        raise write_error(path, error) from error


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A hidden folder beside ``path`` to write into; it takes that name when the block ends, and is removed when it
    raises.

    Raises `DatasetError` where ``path`` is there and not an empty folder, or cannot be written.
    """
    try:
        is_free = not path.exists() or (path.is_dir() and next(path.iterdir(), None) is None)
    except OSError as error:
        raise write_error(path, error) from error
    if not is_free:
        raise DatasetError(f"{path} exists already; where this command wrote it, it is complete; else choose another")
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}{PART_SUFFIX}")
    try:
        make_folder(part)
        yield part
        try:
            part.replace(path)
            _sync_folder(path.parent)
        except OSError as error:
            raise write_error(path, error) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def finished_files(path: Path) -> Iterator[Path]:
    """The files below ``path`` but those left under way by a killed process."""
    return (file for file in path.rglob("*") if file.is_file() and not file.name.endswith(PART_SUFFIX))


def write_error(path: Path, error: OSError) -> DatasetError:
    """The error for a file ``path`` that could not be written."""
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


def file_stem(task: str) -> str:
    """The name of a task in names of files and folders: without ``/`` and ``:``.

    >>> file_stem("metaworld/reach"), file_stem("my_tasks:Pour")
    ('metaworld-reach', 'my_tasks-Pour')
    """
    return task.replace("/", "-").replace(":", "-")
