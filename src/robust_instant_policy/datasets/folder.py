"""The tables of a LeRobotDataset v3.0 folder, ours or anyone's, with everything that can be wrong said in one line."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robust_instant_policy.datasets import layout
from robust_instant_policy.datasets.video import decode_video
from robust_instant_policy.errors import DatasetError, NoDemonstrationsError
from robust_instant_policy.files import finished_files

CONVERTER = "python -m lerobot.datasets.v30.convert_dataset_v21_to_v30"
STATISTICS_PREFIX = "stats/"  # columns of meta/episodes that only those who normalise need
INFO_ENTRIES = ("codebase_version", "fps", "features", "total_episodes", "total_frames", "data_path")


@dataclass(frozen=True)
class Folder:
    """A LeRobotDataset v3.0: ``info`` is its ``meta/info.json``, ``episodes`` the rows of ``meta/episodes`` in order,
    without statistics.

    Its tables are read when asked for; every method raises `DatasetError`, naming the file, for one that is
    missing or damaged.
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
        path = self.root / self.info["data_path"].format(
            chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
        )
        table = _read_data(path, tuple(names), _stamp(path))
        table = table.filter(pc.equal(table["episode_index"], row["episode_index"])).sort_by("frame_index")
        if len(table) != row["length"]:
            raise DatasetError(
                f"{path} is damaged: episode {episode} has {len(table)} of its {row['length']} frames; "
                "restore it, or record the folder again"
            )
        return table

    def frames(self, episode: int, key: str) -> Iterator[NDArray]:
        """Images ``(H, W, 3)`` uint8 of an episode's video feature ``key``, in order."""
        row = self.episodes[episode]
        path = self.root / self.info["video_path"].format(
            video_key=key, chunk_index=row[f"videos/{key}/chunk_index"], file_index=row[f"videos/{key}/file_index"]
        )
        count = 0
        for image in decode_video(path, row[f"videos/{key}/from_timestamp"], row[f"videos/{key}/to_timestamp"]):
            yield image
            count += 1
        if count != row["length"]:
            raise DatasetError(
                f"{path} is damaged: episode {episode} has {count} of its {row['length']} images; "
                "restore it, or record the folder again"
            )


def open_folder(path: Path, task: str | None = None) -> Folder:
    """Open a LeRobotDataset v3.0 folder with at least one episode.

    ``task`` is only named in advice. Raises `DatasetError` for a folder that is missing, empty, half-written,
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
            raise NoDemonstrationsError(f"{path} holds no finished demonstration yet; {advice}")
        raise DatasetError(f"{path} is no demonstrations folder: it has no {layout.INFO_PATH}; {advice}")
    info = read_json(path / layout.INFO_PATH)
    missing = [entry for entry in INFO_ENTRIES if entry not in info]
    if missing:
        raise DatasetError(f"{path / layout.INFO_PATH} lacks {', '.join(missing)}; restore it, or record again")
    version = str(info["codebase_version"])
    if not version.startswith("v3."):
        convert = f"; convert it with: {CONVERTER} --repo-id=NAME --root={path} --push-to-hub=false"
        raise DatasetError(
            f"{path} is a LeRobotDataset {version}, and {layout.CODEBASE_VERSION} is needed"
            + (convert if version == "v2.1" else "")
        )
    if info["total_episodes"] < 1:
        raise NoDemonstrationsError(f"{path} holds no demonstrations; {advice}")
    return Folder(path, info, _read_episodes(path, info["total_episodes"]))


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object. Raises `DatasetError` naming the file."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path} cannot be read as JSON: restore it, or record the folder again") from error
    if not isinstance(content, dict):
        raise DatasetError(f"{path} must hold a JSON object: restore it, or record the folder again")
    return content


def read_table(path: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """A parquet file, or only some of its ``columns``. Raises `DatasetError` naming the file."""
    try:
        table = pq.read_table(path, columns=None if columns is None else list(columns), partitioning=None)
    except (OSError, pa.ArrowException) as error:
        reason = "is missing" if isinstance(error, FileNotFoundError) else "is damaged or cut short"
        raise DatasetError(f"{path} {reason}: restore it, or record the folder again") from error
    lacking = [name for name in columns or () if name not in table.column_names]
    if lacking:
        raise DatasetError(f"{path} has no column {', '.join(lacking)}")
    return table


@lru_cache(maxsize=1)  # files that hold many episodes are read once, not once for each
def _read_data(path: Path, names: tuple[str, ...], stamp: tuple[int, ...]) -> pa.Table:
    return read_table(path, ["episode_index", "frame_index", *names])


def _stamp(path: Path) -> tuple[int, ...]:
    """Changes whenever the file does."""
    try:
        found = path.stat()
    except OSError:
        return ()
    return found.st_ino, found.st_size, found.st_mtime_ns


def _read_episodes(root: Path, count: int) -> list[dict[str, Any]]:
    """The first ``count`` rows: what lies beyond was not finished when its writer was killed."""
    rows: list[dict[str, Any]] = []
    for path in sorted((root / "meta/episodes").glob("*/*.parquet")):
        table = read_table(path)
        rows += table.select(
            [name for name in table.column_names if not name.startswith(STATISTICS_PREFIX)]
        ).to_pylist()
        if len(rows) >= count:
            break
    if [row["episode_index"] for row in rows[:count]] != list(range(count)):
        raise DatasetError(
            f"{root} is damaged: meta/episodes lists {len(rows)} of {count} episodes; restore it, or record again"
        )
    return rows[:count]
