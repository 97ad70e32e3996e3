"""The tables of any LeRobotDataset v3.0 folder; every problem is an error in one line.

A folder may come from an unknown source, so its content is checked when it is read: types and ranges in
``meta/info.json`` and ``meta/episodes``, and that all paths stay inside the folder.
"""

import math
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robust_instant_policy.datasets import layout
from robust_instant_policy.datasets.layout import REPAIR, damaged
from robust_instant_policy.datasets.video import decode_video
from robust_instant_policy.demonstration import MAX_PIXELS
from robust_instant_policy.errors import DatasetError, NoDemonstrationsError
from robust_instant_policy.files import excerpt, finished_files, open_regular, read_json
from robust_instant_policy.geometry import FloatArray

# In lerobot 0.6 --root is the folder itself, in 0.4 its parent.
CONVERT = (
    "convert it with: python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id={name} --root={path} "
    "--push-to-hub=false (lerobot 0.6; with 0.4: python -m lerobot.datasets.v30.convert_dataset_v21_to_v30 "
    "--repo-id={name} --root={parent} --push-to-hub=false)"
)
STATISTICS_PREFIX = "stats/"  # columns of meta/episodes that are used for normalisation only
INFO_ENTRIES = ("codebase_version", "fps", "features", "total_episodes", "total_frames", "data_path")
MAX_INDEX = 2**31  # of an episode, file, chunk or frame
MAX_VALUES = 2**28  # numbers in the columns read from one file; v3.0 aims at files of 100 MB


@dataclass(frozen=True)
class Folder:
    """A LeRobotDataset v3.0: ``info`` is its ``meta/info.json``, ``episodes`` the rows of ``meta/episodes`` in order,
    without statistics, both checked.

    Tables are read on access; every method raises `DatasetError`, with the file name, for a missing or damaged one.
    """

    root: Path
    info: Mapping[str, Any]
    episodes: Sequence[Mapping[str, Any]]

    @property
    def rate_hz(self) -> float:
        return float(self.info["fps"])

    @property
    def video_keys(self) -> list[str]:
        """Features that are videos."""
        return [key for key, feature in self.info["features"].items() if feature["dtype"] == "video"]

    def columns(self, episode: int, names: Sequence[str]) -> pa.Table:
        """The frames of an episode, in order."""
        row = self.episodes[episode]
        path = self._path("data_path", **{name: row[f"data/{name}"] for name in layout.INDICES})
        table = _read_data(path, tuple(names), _stamp(path))
        table = table.filter(pc.equal(table["episode_index"], row["episode_index"])).sort_by("frame_index")
        if len(table) != row["length"]:
            raise damaged(path, f"episode {episode} has {len(table)} of its {row['length']} frames")
        if not np.array_equal(table["frame_index"], np.arange(row["length"])):
            raise damaged(path, f"frame_index of episode {episode} is not 0, 1, 2, …")
        return table

    def matrix(self, episode: int, name: str) -> FloatArray:
        """A feature of numbers over the frames of an episode ``(T, D)``, in order."""
        column = self.columns(episode, [name])[name].combine_chunks()
        try:
            return _matrix(column)
        except (ValueError, pa.ArrowException) as error:
            raise damaged(self.root, f"episode {episode}: {name} {excerpt(error)}") from None

    def frames(self, episode: int, key: str, pixel_format: str = "rgb24") -> Iterator[NDArray]:
        """Images of an episode's video ``key``, in order: ``(H, W, 3)`` uint8, or of another ``pixel_format``."""
        row = self.episodes[episode]
        video = f"videos/{key}"
        _check_whole_numbers(self.root, episode, row, {f"{video}/{name}": 0 for name in layout.INDICES})
        start, stop = (row.get(f"{video}/{name}") for name in ("from_timestamp", "to_timestamp"))
        if not (isinstance(start, float | int) and isinstance(stop, float | int) and 0 <= start < stop < math.inf):
            span = f"from {reprlib.repr(start)} to {reprlib.repr(stop)} s"
            raise damaged(self.root, f"episode {episode} of {excerpt(video)} lasts {span}")
        indices = {name: row[f"{video}/{name}"] for name in layout.INDICES}
        path = self._path("video_path", video_key=key, **indices)
        count = 0
        for image in decode_video(path, start, stop, pixel_format):
            count += 1
            if count > row["length"]:
                break
            yield image
        if count != row["length"]:
            found = f"{count} of its" if count < row["length"] else "more images than its"
            raise damaged(path, f"episode {episode} has {found} {row['length']} images")

    def own_file(self, pattern: str, episode: int) -> Path:
        """Path of an episode's own file, see `layout`. Raises `DatasetError` if it is outside of the folder."""
        return inside(self.root, layout.episode_path(pattern, episode))

    def _path(self, template: str, **fields: object) -> Path:
        if self.info.get(template) is None:
            raise DatasetError(f"{self.root / layout.INFO_PATH} lacks {template}; {REPAIR}")
        return inside(self.root, self.info[template].format(**fields))


def holds_demonstrations(path: Path) -> bool:
    """Whether ``path`` is a demonstrations folder, or one that is being recorded."""
    return (path / layout.RIP_PATH).exists() or (path / layout.INFO_PATH).exists()


def open_folder(path: Path, task: str | None = None) -> Folder:
    """Open a LeRobotDataset v3.0 folder with at least one episode.

    ``task`` is used in the error message only. Raises `DatasetError` for a folder that is missing, empty, half-written,
    of another format or without episodes.
    """
    advice = f"record demonstrations with: rip record --task {task or 'TASK'} --episodes 10 --out {path}"
    if not path.exists():
        raise NoDemonstrationsError(f"there is no folder {path}; {advice}")
    if not path.is_dir():
        raise DatasetError(f"{path} is a file, not a demonstrations folder; {advice}")
    if not any(finished_files(path)):
        raise NoDemonstrationsError(f"{path} is empty; {advice}")
    if not (path / layout.INFO_PATH).exists():
        if (path / layout.RIP_PATH).exists():
            lost = sum(file.suffix == ".parquet" for file in finished_files(path / "meta/episodes"))
            if lost > 1:  # the file of the first one is there before the info, see `DatasetWriter`
                raise DatasetError(f"{path} has lost {layout.INFO_PATH}, which describes its {lost} episodes; {REPAIR}")
            raise NoDemonstrationsError(
                f"{path} holds no finished demonstration: it has no {layout.INFO_PATH}; {advice}"
            )
        raise DatasetError(f"{path} is not a demonstrations folder: it has no {layout.INFO_PATH}; {advice}")
    file = inside(path, layout.INFO_PATH)
    info = read_json(file)
    missing = [entry for entry in INFO_ENTRIES if entry not in info]
    if missing:
        raise DatasetError(f"{file} lacks {', '.join(missing)}; {REPAIR}")
    version = info["codebase_version"]
    if not (isinstance(version, str) and version.startswith("v3.")):
        own = path.resolve()
        convert = "; " + CONVERT.format(name=own.name, path=own, parent=own.parent)
        raise DatasetError(
            f"{path} is a LeRobotDataset {reprlib.repr(version)}, and {layout.CODEBASE_VERSION} is needed"
            + (convert if version == "v2.1" else "")
        )
    try:
        _check_info(info)
    except ValueError as error:
        raise damaged(file, error) from None
    if info["total_episodes"] < 1:
        raise NoDemonstrationsError(f"{path} holds no demonstrations; {advice}")
    return Folder(path, info, _read_episodes(path, info["total_episodes"]))


def read_recording(root: Path) -> dict[str, Any]:
    """The checked content of ``meta/rip.json``. Raises `DatasetError` with the file name."""
    file = inside(root, layout.RIP_PATH)
    own = read_json(file)
    seeds = own.get("discarded_seeds", [])
    if not isinstance(own.get("task"), str) or not isinstance(own.get("description", ""), str):
        raise damaged(file, "its task and description must be text")
    if not isinstance(seeds, list) or not all(seed is None or _is_whole(seed) for seed in seeds):
        raise damaged(file, "its discarded_seeds must be a list of whole numbers")
    return own


def read_seed(row: Mapping[str, Any]) -> int | None:
    """The seed in a row of ``meta/episodes``. Raises `DatasetError` for another type."""
    seed = row.get(layout.SEED_COLUMN)
    if seed is not None and not isinstance(seed, int):
        raise DatasetError(
            f"{layout.SEED_COLUMN} of an episode must be a whole number, got {reprlib.repr(seed)}; {REPAIR}"
        )
    return seed


def inside(root: Path, relative: str | Path) -> Path:
    """The path of a file of the folder. Raises `DatasetError` if it is outside, also through symbolic links."""
    path = root / relative
    try:
        within = path.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links, a name too long, a null character
        raise DatasetError(f"{root} names a file that cannot be: {excerpt(relative)!r} ({excerpt(error)})") from None
    if not within:
        raise DatasetError(
            f"{root} names a file outside of itself: {excerpt(relative)!r}; "
            "if these are your own symbolic links, copy the folder with: cp -rL"
        )
    return path


def read_table(path: Path, columns: Sequence[str] | None = None, skip: str | None = None) -> pa.Table:
    """A parquet file, or only its ``columns``, or those that do not begin with ``skip``.

    Raises `DatasetError` with the file name.
    """
    try:
        with open_regular(path) as file, pq.ParquetFile(file) as parquet:
            there = parquet.schema_arrow.names
            lacking = [name for name in columns or () if there.count(name) != 1]
            if lacking:
                raise DatasetError(f"{path} has no column {', '.join(lacking)}, or more than one")
            wanted = list(columns or [name for name in there if skip is None or not name.startswith(skip)])
            count = _count_values(parquet.metadata, set(wanted))
            if count > MAX_VALUES:
                raise DatasetError(
                    f"{path} declares {count} numbers, more than the {MAX_VALUES} of a file of a dataset"
                )
            return parquet.read(columns=wanted)
    except (OSError, ValueError, KeyError, OverflowError, MemoryError, pa.ArrowException) as error:
        reason = "is missing" if isinstance(error, FileNotFoundError) else "is damaged or cut short"
        raise DatasetError(f"{path} {reason}: {REPAIR}") from error


def _count_values(metadata: pq.FileMetaData, names: set[str]) -> int:
    """Numbers in the columns called ``names``, as the file declares them."""
    count = metadata.num_rows
    for group in range(metadata.num_row_groups):
        columns = metadata.row_group(group)
        for index in range(columns.num_columns):
            column = columns.column(index)
            if any(column.path_in_schema == name or column.path_in_schema.startswith(f"{name}.") for name in names):
                count += column.num_values
    return count


@lru_cache(maxsize=1)  # files with many episodes are read once, not once per episode
def _read_data(path: Path, names: tuple[str, ...], stamp: tuple[int, ...]) -> pa.Table:
    table = read_table(path, ["episode_index", "frame_index", *names])
    for name in ("episode_index", "frame_index"):
        if not pa.types.is_integer(table[name].type):
            raise damaged(path, f"{name} is {table[name].type}, not whole numbers")
    return table


def _stamp(path: Path) -> tuple[int, ...]:
    """Changes whenever the file does."""
    try:
        found = path.stat()
    except OSError:
        return ()
    return found.st_ino, found.st_size, found.st_mtime_ns


def _matrix(column: pa.Array) -> FloatArray:
    """``(T, D)`` of a column of numbers or of lists of numbers of one length; `ValueError` for any other."""
    count = len(column)
    if column.null_count:
        raise ValueError("has gaps")
    if pa.types.is_list(column.type) or pa.types.is_large_list(column.type) or pa.types.is_fixed_size_list(column.type):
        if len(pc.unique(pc.list_value_length(column))) > 1:
            raise ValueError("has rows of different lengths")
        column = column.flatten()
    if not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)) or column.null_count:
        raise ValueError(f"holds {column.type}, or gaps, in place of numbers")
    return column.to_numpy(zero_copy_only=False).astype(np.float64).reshape(count, -1)


def _check_info(info: Mapping[str, Any]) -> None:
    """Raises `ValueError` unless the entries of ``meta/info.json`` that are used have their types and ranges."""
    fps = info["fps"]
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 0 < fps < MAX_INDEX:
        raise ValueError(f"fps must be a positive number, got {reprlib.repr(fps)}")
    for name in ("total_episodes", "total_frames"):
        if not _is_whole(info[name]):
            raise ValueError(f"{name} must be a whole number, got {reprlib.repr(info[name])}")
    for name, fields in (("data_path", layout.INDICES), ("video_path", (*layout.INDICES, "video_key"))):
        template = info.get(name)
        if template is None and name == "video_path":
            continue
        if not isinstance(template, str):
            raise ValueError(f"{name} must be a path template, got {reprlib.repr(template)}")
        layout.check_template(template, fields)
    if not isinstance(info["features"], dict):
        raise ValueError(f"features must be an object, got {reprlib.repr(info['features'])}")
    for key, feature in info["features"].items():
        if not (isinstance(feature, dict) and isinstance(feature.get("dtype"), str)):
            raise ValueError(f"the feature {excerpt(key)!r} must have a dtype, got {reprlib.repr(feature)}")
        shape = feature.get("shape")
        if not (
            isinstance(shape, list) and all(_is_whole(side) for side in shape) and math.prod(shape) < 4 * MAX_PIXELS
        ):
            raise ValueError(f"the feature {excerpt(key)!r} must have a shape, got {reprlib.repr(shape)}")


def _is_whole(value: object, least: int = 0) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value < MAX_INDEX


def _read_episodes(root: Path, count: int) -> list[dict[str, Any]]:
    """The first ``count`` rows; one more was not finished when its writer was killed."""
    rows: list[dict[str, Any]] = []
    for path in sorted((root / "meta/episodes").glob("*/*.parquet")):
        table = read_table(inside(root, path.relative_to(root)), skip=STATISTICS_PREFIX)
        try:
            rows += table.to_pylist()
        except (ValueError, OverflowError, pa.ArrowException) as error:
            raise damaged(path, excerpt(error)) from None
        if len(rows) > count + 1:
            raise damaged(root, f"{layout.INFO_PATH} counts {count} episodes, meta/episodes lists more")
    if len(rows) < count or [row.get("episode_index") for row in rows[:count]] != list(range(count)):
        raise damaged(root, f"meta/episodes lists {len(rows)} of {count} episodes, or out of order")
    for episode, row in enumerate(rows[:count]):
        _check_whole_numbers(root, episode, row, {"length": 1, "data/chunk_index": 0, "data/file_index": 0})
    return rows[:count]


def _check_whole_numbers(root: Path, episode: int, row: Mapping[str, Any], least: Mapping[str, int]) -> None:
    """Raises `DatasetError` unless the entries of a row are whole numbers, each at least as large as given."""
    for name, low in least.items():
        if not _is_whole(row.get(name), low):
            found = reprlib.repr(row.get(name))
            raise damaged(root, f"{name} of episode {episode} is {found}, not a whole number")
