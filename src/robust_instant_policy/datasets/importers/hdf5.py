"""HDF5 files, opened with errors in one line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from robust_instant_policy.errors import DatasetError, MissingExtraError


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """The open ``h5py.File``. Raises `DatasetError` for one that is missing or damaged, also while it is read."""
    try:
        import h5py
    except ImportError as error:
        raise MissingExtraError("h5py", "import") from error
    if not path.exists():
        raise DatasetError(f"there is no file {path}")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except OSError as error:
        raise DatasetError(f"{path} is damaged or not an HDF5 file: {error}") from error


def read(group: Any, name: str) -> Any:
    """The array ``name`` of a group, or None where there is none."""
    return group[name][()] if name in group else None


def choose_camera(path: Path, cameras: Sequence[str], wanted: str | None) -> str | None:
    """The camera ``wanted``, or the only one. Raises `DatasetError` naming those that are there."""
    if wanted is None and len(cameras) <= 1:
        return cameras[0] if cameras else None
    if wanted not in cameras:
        problem = "has several cameras" if wanted is None else f"has no camera {wanted!r}"
        raise DatasetError(f"{path} {problem}; give camera= one of: {', '.join(cameras) or 'none'}")
    return wanted
