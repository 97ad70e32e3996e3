"""The tables of a folder for writing: frames, episodes, tasks, and the features of a frame."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robust_instant_policy.datasets import layout
from robust_instant_policy.datasets.folder import STATISTICS_PREFIX, inside, read_table
from robust_instant_policy.datasets.statistics import Statistics
from robust_instant_policy.datasets.video import PIXEL_FORMAT
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.trajectory import ACTION_DIM


def features_of(num_arms: int, images: NDArray[np.uint8] | None, rate_hz: float) -> dict[str, dict[str, Any]]:
    """The features of a frame, in the form of ``meta/info.json``."""
    gripper = {"dtype": "float32", "shape": [ACTION_DIM * num_arms], "names": layout.axis_names(num_arms)}
    features: dict[str, dict[str, Any]] = {layout.ACTION_KEY: gripper, layout.STATE_KEY: gripper}
    if images is not None:
        height, width = images.shape[1:3]
        features[layout.VIDEO_KEY] = {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": height,
                "video.width": width,
                "video.codec": "h264",
                "video.pix_fmt": PIXEL_FORMAT,
                "video.is_depth_map": False,
                "video.fps": rate_hz,
                "video.channels": 3,
                "has_audio": False,
            },
        }
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for key in ("frame_index", "episode_index", "index", "task_index"):
        features[key] = {"dtype": "int64", "shape": [1], "names": None}
    return features


def frame_table(columns: Mapping[str, NDArray]) -> pa.Table:
    """One row per step; vectors ``(T, D)`` as lists of fixed length."""
    return pa.table(
        {
            key: pa.FixedSizeListArray.from_arrays(value.ravel(), value.shape[1]) if value.ndim == 2 else value
            for key, value in columns.items()
        }
    )


def episode_table(row: Mapping[str, Any], statistics: Mapping[str, Statistics]) -> pa.Table:
    """One row, with explicit types: a missing seed has none, and all files must have equal types."""
    table = {key: pa.array([value]) for key, value in row.items() if key != layout.SEED_COLUMN}
    table[layout.SEED_COLUMN] = pa.array([row[layout.SEED_COLUMN]], type=pa.int64())
    for key, entries in statistics.items():
        for name, value in listed(entries).items():
            table[f"{STATISTICS_PREFIX}{key}/{name}"] = pa.array([value])
    return pa.table(table)


def read_statistics(root: Path, episode: int) -> dict[str, Statistics]:
    """The statistics written by `episode_table`."""
    table = read_table(inside(root, layout.episode_path(layout.EPISODES_PATTERN, episode)))
    result: dict[str, dict[str, FloatArray]] = {}
    for column in table.column_names:
        if column.startswith(STATISTICS_PREFIX):
            key, name = column.removeprefix(STATISTICS_PREFIX).rsplit("/", 1)
            result.setdefault(key, {})[name] = np.array(table[column][0].as_py(), dtype=np.float64)
    return dict(result)


def listed(statistics: Statistics) -> dict[str, list]:
    """Statistics as lists for JSON and Parquet; counts are whole numbers."""
    return {
        name: value.astype(np.int64).tolist() if name == "count" else value.tolist()
        for name, value in statistics.items()
    }


def task_table(description: str) -> pa.Table:
    """``meta/tasks.parquet``: a pandas table whose index is the task in words, as `lerobot` expects it."""
    columns = [
        {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"},
        {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object"},
    ]
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [{**column, "metadata": None} for column in columns],
    }
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": pa.array([description])})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def json_file(content: Mapping[str, Any]) -> bytes:
    """The content of a JSON file."""
    return json.dumps(content, indent=2, ensure_ascii=False).encode()


def parquet(table: pa.Table) -> bytes:
    """The content of a Parquet file."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return sink.getvalue().to_pybytes()
