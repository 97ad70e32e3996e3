"""Deleting, splitting, merging and restoring demonstrations. Folders are copied, images and videos bit by bit.

`lerobot-edit-dataset` drops this package's additions (start-of-episode images, cameras, facts); `restore` takes them
from the original folder.
"""

from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from robust_instant_policy.datasets import layout
from robust_instant_policy.datasets.card import write_calibration, write_summary
from robust_instant_policy.datasets.folder import (
    STATISTICS_PREFIX,
    Folder,
    inside,
    open_folder,
    read_recording,
    read_table,
)
from robust_instant_policy.datasets.layout import REPAIR, damaged
from robust_instant_policy.datasets.reader import square
from robust_instant_policy.datasets.statistics import Statistics, extended, feature_statistics
from robust_instant_policy.datasets.tables import json_file, listed, parquet, read_statistics
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.files import excerpt, new_folder, read_regular, write_whole


@dataclass(frozen=True)
class Recorded:
    """One episode of a demonstrations folder, with what `read_recording` says of the folder."""

    folder: Folder
    episode: int
    recording: Mapping[str, Any]


def delete(path: str | Path, episodes: Collection[int], out: str | Path) -> int:
    """Write a folder ``out`` with all but some ``episodes`` of ``path``; returns how many. Raises `DatasetError`."""
    there = _episodes(Path(path))
    unknown = sorted(set(episodes) - set(range(len(there))))
    if unknown:
        raise DatasetError(f"{path} holds episodes 0 to {len(there) - 1}, not {', '.join(map(str, unknown))}")
    kept = [one for one in there if one.episode not in set(episodes)]
    if not kept:
        raise DatasetError(f"nothing of {path} would be left")
    return _write([(kept, out)])


def split(path: str | Path, sizes: Sequence[int], outs: Sequence[str | Path]) -> None:
    """Write consecutive parts of ``path``, of ``sizes`` episodes, into the folders ``outs``. Raises `DatasetError`."""
    there = _episodes(Path(path))
    if len(sizes) != len(outs) or sum(sizes) != len(there) or min(sizes, default=0) < 1:
        raise DatasetError(
            f"{len(outs)} folders need {len(outs)} sizes of at least 1 whose sum is the {len(there)} episodes of "
            f"{path}, got {' '.join(map(str, sizes))}"
        )
    ends = np.cumsum(sizes)
    _write([(there[end - size : end], out) for size, end, out in zip(sizes, ends, outs, strict=True)])


def merge(paths: Sequence[str | Path], out: str | Path) -> int:
    """Write the episodes of several folders of one task into ``out``; returns how many. Raises `DatasetError`."""
    if len({Path(path).resolve() for path in paths}) < len(paths):
        raise DatasetError("a folder is named twice; name each once, else its episodes would be in the new one twice")
    return _write([([one for path in paths for one in _episodes(Path(path))], out)])


def restore(edited: str | Path, originals: Sequence[str | Path], out: str | Path) -> int:
    """Write the episodes of ``edited`` into ``out``, completed from the folders that it was made from.

    ``edited`` is what `lerobot-edit-dataset` made of ``originals`` by deleting, splitting, merging, removing features
    or renaming tasks. An episode is recognised by its actions. Returns how many episodes ``out`` has. Raises
    `DatasetError` for an episode that is in no original.
    """
    folder = open_folder(Path(edited))
    known: dict[bytes, Recorded] = {}
    for one in (one for path in originals for one in _episodes(Path(path))):
        known.setdefault(_actions(one.folder, one.episode), one)
    found = [known.get(_actions(folder, episode)) for episode in range(len(folder.episodes))]
    if None in found:
        raise DatasetError(
            f"episode {found.index(None)} of {edited} is in none of {', '.join(map(str, originals))}; name all folders "
            "that it was made from"
        )
    tasks = {" ".join(map(str, row["tasks"])) for row in folder.episodes if isinstance(row.get("tasks"), list)}
    description = tasks.pop() if len(tasks) == 1 else None
    return _write([([one for one in found if one is not None], out)], set(folder.info["features"]), description)


def _episodes(path: Path) -> list[Recorded]:
    folder = open_folder(path)
    if not (path / layout.RIP_PATH).exists():
        raise DatasetError(
            f"{path} holds no {layout.RIP_PATH}; restore it first: rip demos restore {path} --from ORIGINAL"
        )
    recording = read_recording(path)
    return [Recorded(folder, episode, recording) for episode in range(len(folder.episodes))]


def _actions(folder: Folder, episode: int) -> bytes:
    return folder.matrix(episode, layout.ACTION_KEY).astype(np.float32).tobytes()


def _write(
    parts: Sequence[tuple[Sequence[Recorded], str | Path]],
    keep: Collection[str] | None = None,
    description: str | None = None,
) -> int:
    """Write each part into its new folder, with the features ``keep`` or all of them; returns the number of episodes.

    The folders appear when all of them are complete, or not at all.
    """
    outs = [Path(out).resolve() for _, out in parts]  # resolved now: "absent/../there" would be another path later
    if any(one == other or one in other.parents for one, other in permutations(outs, 2)):
        raise DatasetError("the new folders must be different ones, none of them inside another")
    for root in {one.folder.root for episodes, _ in parts for one in episodes}:
        if any(root.resolve() in out.parents for out in outs):
            raise DatasetError(f"a new folder must not lie inside {root}")
    with ExitStack() as stack:
        folders = [stack.enter_context(new_folder(out)) for out in outs]
        return sum(
            _fill(folder, episodes, keep, description) for folder, (episodes, _) in zip(folders, parts, strict=True)
        )


def _fill(out: Path, episodes: Sequence[Recorded], keep: Collection[str] | None, description: str | None) -> int:
    """Write ``episodes`` into the empty folder ``out``; returns how many."""
    first = episodes[0]
    features = {key: value for key, value in first.folder.info["features"].items() if keep is None or key in keep}
    for one in episodes:
        _require_alike(first, one, description)
    text = description or _description(first)
    whole: dict[str, Statistics] = {}
    frames = 0
    for place, one in enumerate(episodes):
        statistics = _copy(one, out, place, frames, features, text)
        whole = extended(whole, statistics)
        frames += one.folder.episodes[one.episode]["length"]
    recordings = {one.folder.root: one.recording for one in episodes}.values()
    seeds = [seed for recording in recordings for seed in recording.get("discarded_seeds", [])]
    own = {**first.recording, "description": text, "discarded_seeds": seeds}
    info = {
        **first.folder.info,
        "total_episodes": len(episodes),
        "total_frames": frames,
        "splits": {"train": f"0:{len(episodes)}"},
        "video_path": layout.VIDEO_PATTERN if any(f["dtype"] == "video" for f in features.values()) else None,
        "features": features,
    }
    write_whole(out / layout.RIP_PATH, json_file(own))
    write_summary(out, info, first.recording["task"], text, whole)
    return len(episodes)


def _description(one: Recorded) -> str:
    return one.recording.get("description") or one.recording["task"]


def _require_alike(first: Recorded, other: Recorded, description: str | None) -> None:
    """Raises `DatasetError` unless both may be in one folder, with the ``description`` or else with their own."""
    ours, theirs = first.folder, other.folder
    for what, a, b in (
        ("task", first.recording["task"], other.recording["task"]),
        ("description", description or _description(first), description or _description(other)),
        ("robot_type", ours.info.get("robot_type"), theirs.info.get("robot_type")),
        ("recording rate", ours.rate_hz, theirs.rate_hz),
        ("features", _shapes(ours), _shapes(theirs)),
    ):
        if a != b:
            raise DatasetError(
                f"{ours.root} and {theirs.root} differ in their {what}: {excerpt(str(a))}, {excerpt(str(b))}"
            )


def _shapes(folder: Folder) -> str:
    return str({key: (feature["dtype"], feature["shape"]) for key, feature in sorted(folder.info["features"].items())})


def _copy(
    one: Recorded, out: Path, place: int, first_frame: int, features: Mapping[str, Any], description: str
) -> dict[str, Statistics]:
    """Write an episode as number ``place`` of ``out``; returns its statistics."""
    length = one.folder.episodes[one.episode]["length"]
    counters = {
        "episode_index": np.full(length, place),
        "index": first_frame + np.arange(length),
        "task_index": np.zeros(length, dtype=np.int64),
    }
    statistics = {key: value for key, value in read_statistics(one.folder.root, one.episode).items() if key in features}
    statistics |= {name: feature_statistics(values.reshape(-1, 1)) for name, values in counters.items()}
    _copy_files(one, out, place, features)
    _copy_calibration(one, out, place)
    frames = _frames(one, counters, features)
    write_whole(out / layout.episode_path(layout.DATA_PATTERN, place), parquet(frames))
    row = _row(one, place, first_frame, features, {name: statistics[name] for name in counters}, description)
    write_whole(out / layout.episode_path(layout.EPISODES_PATTERN, place), parquet(row))
    return statistics


def _frames(one: Recorded, counters: Mapping[str, NDArray], features: Mapping[str, Any]) -> pa.Table:
    """The frames of an episode with other ``counters``."""
    columns = [key for key, feature in features.items() if feature["dtype"] not in ("video", "image")]
    there = one.folder.columns(one.episode, [key for key in columns if key not in ("episode_index", "frame_index")])
    table = there.select(columns)
    for name, values in counters.items():
        table = table.set_column(table.column_names.index(name), name, pa.array(values, pa.int64()))
    return table


def _row(
    one: Recorded,
    place: int,
    first_frame: int,
    features: Mapping[str, Any],
    counted: Mapping[str, Statistics],
    description: str,
) -> pa.Table:
    """The row of meta/episodes as that of number ``place``, with the statistics ``counted`` of what counts."""
    table = read_table(one.folder.own_file(layout.EPISODES_PATTERN, one.episode))
    table = table.filter(pc.equal(table["episode_index"], one.episode))
    table = table.drop_columns([name for name in table.column_names if _feature_of(name) not in (None, *features)])
    chunk, file = layout.chunk_and_file(place)
    changed: dict[str, Any] = {
        "episode_index": place,
        "tasks": [description],
        "dataset_from_index": first_frame,
        "dataset_to_index": first_frame + one.folder.episodes[one.episode]["length"],
        **{name: chunk for name in table.column_names if name.endswith("/chunk_index")},
        **{name: file for name in table.column_names if name.endswith("/file_index")},
    }
    for name, statistics in counted.items():
        changed |= {f"{STATISTICS_PREFIX}{name}/{entry}": values for entry, values in listed(statistics).items()}
    for name in table.column_names:
        if name in changed:
            column = pa.array([changed[name]], table[name].type)
            table = table.set_column(table.column_names.index(name), name, column)
    return table


def _copy_files(one: Recorded, out: Path, place: int, features: Mapping[str, Any]) -> None:
    """Copy videos and start-of-episode images."""
    root, row = one.folder.root, one.folder.episodes[one.episode]
    chunk, file = layout.chunk_and_file(place)
    for key in (key for key, feature in features.items() if feature["dtype"] == "video"):
        if row.get(f"videos/{key}/from_timestamp") != 0:
            raise DatasetError(f"{root} keeps several episodes in one video, unlike rip; restore it from the original")
        here = {name: row[f"videos/{key}/{name}"] for name in layout.INDICES}
        content = _read(inside(root, layout.VIDEO_PATTERN.format(video_key=key, **here)))
        write_whole(out / layout.VIDEO_PATTERN.format(video_key=key, chunk_index=chunk, file_index=file), content)
    for pattern in (layout.START_RGB_PATTERN, layout.START_DEPTH_PATTERN):
        content = _read(one.folder.own_file(pattern, one.episode))
        write_whole(out / layout.episode_path(pattern, place), content)


def _copy_calibration(one: Recorded, out: Path, place: int) -> None:
    row = one.folder.episodes[one.episode]
    try:
        camera = square(row.get(layout.INTRINSICS_COLUMN), 3), square(row.get(layout.CAMERA_POSE_COLUMN), 4)
    except ValueError as error:
        raise damaged(one.folder.root, f"the camera of episode {one.episode}: {excerpt(error)}") from None
    write_calibration(out, place, *camera)


def _read(path: Path) -> bytes:
    try:
        return read_regular(path)
    except FileNotFoundError:
        raise DatasetError(f"{path} is missing; {REPAIR}") from None


def _feature_of(column: str) -> str | None:
    """The feature that a column of meta/episodes belongs to: ``stats/KEY/…`` or ``videos/KEY/…``."""
    top, _, rest = column.partition("/")
    return rest.rpartition("/")[0] if top in ("stats", "videos") else None
