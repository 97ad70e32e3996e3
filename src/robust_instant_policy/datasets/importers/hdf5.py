"""Reading HDF5 files from other people: errors in one line, and no access to other files."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.errors import DatasetError, needs_extra
from robust_instant_policy.files import excerpt, open_regular, parse_json

with needs_extra("import"):
    import h5py

MAX_ARRAY_BYTES = 2**32  # of one array; the images of an episode are the largest


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """The open ``h5py.File``. Raises `DatasetError` for a missing or damaged file, also while it is read, and for
    one with links, because an external link refers to another file.
    """
    try:
        open_regular(path).close()
        with h5py.File(path, "r") as file:
            link = file.visititems_links(lambda name, link: None if isinstance(link, h5py.HardLink) else name)
            if link is not None:
                raise DatasetError(f"{path}: {excerpt(link)!r} is a link; copy the file with its links resolved")
            yield file
    except FileNotFoundError:
        raise DatasetError(f"there is no file {path}") from None
    except (OSError, RuntimeError, KeyError, UnicodeDecodeError, SystemError) as error:  # of h5py for damaged files
        raise DatasetError(f"{path} is damaged or not an HDF5 file: {excerpt(error)}") from error


def has(group: Any, name: str) -> bool:
    """Whether a group holds ``name``, a path within the file."""
    return isinstance(group, h5py.Group) and name in group


def read(group: Any, name: str, *ndim: int) -> NDArray | None:
    """The array ``name`` of numbers of a group, with ``ndim`` dimensions, or None if it is missing.

    Raises `DatasetError` for an array of other dimensions or type, an empty or too large one, and one that is stored
    in another file.
    """
    if not has(group, name):
        return None
    data = group[name]
    where = f"{group.file.filename}: {excerpt(f'{group.name}/{name}')}"
    if not isinstance(data, h5py.Dataset) or data.dtype.kind not in "biuf":
        raise DatasetError(f"{where} is not an array of numbers")
    if data.is_virtual or data.external:
        raise DatasetError(f"{where} is stored in another file; copy its content into this one")
    if data.ndim not in ndim or not data.size:
        wanted = " or ".join(map(str, ndim))
        raise DatasetError(f"{where} must have {wanted} dimensions and not be empty, got {data.shape}")
    if data.nbytes > MAX_ARRAY_BYTES:
        raise DatasetError(f"{where} is larger than {MAX_ARRAY_BYTES >> 30} GiB, its header says {data.shape}")
    return data[()]


def members(group: Any, name: str) -> list[str]:
    """Names in the group ``name`` of a group; empty if it is missing."""
    inner = group[name] if has(group, name) else None
    return list(inner) if isinstance(inner, h5py.Group) else []


def read_json_attribute(group: Any, name: str) -> dict[str, Any]:
    """The JSON object in an attribute, empty where there is none. Raises `DatasetError` for anything else."""
    where = f"{group.file.filename}: the attribute {name} of {excerpt(group.name)}"
    try:
        text = group.attrs.get(name, "{}")
        content = parse_json(text) if isinstance(text, str | bytes) else None
    except (ValueError, TypeError, OSError) as error:
        raise DatasetError(f"{where} is not JSON") from error
    if not isinstance(content, dict):
        raise DatasetError(f"{where} is not a JSON object")
    return content


def nested(content: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """The nested JSON object at the path ``names``; empty if it is missing."""
    inner: Any = content
    for name in names:
        inner = inner.get(name) if isinstance(inner, Mapping) else None
    return inner if isinstance(inner, dict) else {}


def first_matrix(array: NDArray | None) -> NDArray[np.float64] | None:
    """The first of the matrices ``(T, …)``, as float64."""
    return None if array is None else array[0].astype(np.float64)
