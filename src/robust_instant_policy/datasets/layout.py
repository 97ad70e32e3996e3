"""File layout of a demonstrations folder: a LeRobotDataset v3.0 with additions.

The format is that of `lerobot` 0.4.4 (``src/lerobot/datasets/lerobot_dataset.py`` and ``utils.py``). It allows
one or many episodes per file; here each episode has its own files, numbered like the episode, so that
recording only adds files. See ``docs/datasets.md``.
"""

import re
import string
from collections.abc import Collection
from pathlib import Path

from robust_instant_policy.errors import DatasetError
from robust_instant_policy.trajectory import ACTION_DIM

REPAIR = "restore it, or record the folder again"
CODEBASE_VERSION = "v3.0"
RIP_FORMAT = 1  # version of the additions: rip.json, the start/ folder and the rip/ columns

INFO_PATH = Path("meta/info.json")
STATS_PATH = Path("meta/stats.json")
TASKS_PATH = Path("meta/tasks.parquet")
RIP_PATH = Path("meta/rip.json")
CALIBRATION_PATH = Path("meta/calibration.json")
CARD_PATH = Path("README.md")

FILES_PER_CHUNK = 1000
CHUNK_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATTERN = f"data/{CHUNK_FILE}.parquet"
EPISODES_PATTERN = f"meta/episodes/{CHUNK_FILE}.parquet"
VIDEO_PATTERN = f"videos/{{video_key}}/{CHUNK_FILE}.mp4"
START_RGB_PATTERN = f"start/rgb/{CHUNK_FILE}.png"
START_DEPTH_PATTERN = f"start/depth/{CHUNK_FILE}.png"
EPISODE_FOLDERS = ("data", "meta/episodes", "videos", "start")

VIDEO_KEY = "observation.images.top"
ACTION_KEY = "action"
STATE_KEY = "observation.state"

INTRINSICS_COLUMN = "rip/intrinsics"
CAMERA_POSE_COLUMN = "rip/camera_pose"
DEPTH_UNIT_COLUMN = "rip/depth_unit_m"
SEED_COLUMN = "rip/seed"
INFO_COLUMN = "rip/info"


PLAIN_NUMBER = re.compile(r"0?[1-9]?d?")  # format of an index in a path template; the format's own is 03d
INDICES = ("chunk_index", "file_index")


def damaged(where: object, what: object) -> DatasetError:
    """The error for a file or folder whose content is not as it was written."""
    return DatasetError(f"{where} is damaged: {what}; {REPAIR}")


def check_template(template: str, fields: Collection[str]) -> None:
    """Raises `ValueError` unless a path template consists of text and of the ``fields``, in plain formats.

    Such a template is safe to format: no attributes or items of the values, no large widths.
    """
    try:
        parts = list(string.Formatter().parse(template))
    except ValueError as error:
        raise ValueError(f"the path template {template[:100]!r} is invalid: {error}") from None
    for _, field, spec, conversion in parts:
        if field is None:
            continue
        plain = PLAIN_NUMBER.fullmatch(spec or "") if field in INDICES else not spec
        if field not in fields or conversion or not plain:
            raise ValueError(f"the path template {template[:100]!r} holds more than {', '.join(fields)}")


def chunk_and_file(episode: int) -> tuple[int, int]:
    """Chunk and file index of an episode's files."""
    return divmod(episode, FILES_PER_CHUNK)


def episode_path(pattern: str, episode: int) -> Path:
    """Path, within the folder, of an episode's file."""
    chunk, file = chunk_and_file(episode)
    return Path(pattern.format(chunk_index=chunk, file_index=file, video_key=VIDEO_KEY))


def axis_names(num_arms: int) -> list[str]:
    """Names of the ``10·A`` action dimensions on disk, in order; "palm" is the gripper point.

    The name stays, so that existing folders can be read.
    """
    points = [f"{point}.{axis}" for point in ("palm", "finger_1", "finger_2") for axis in "xyz"]
    names = [*points, "gripper"]
    assert len(names) == ACTION_DIM
    if num_arms == 1:
        return names
    return [f"arm_{arm}.{name}" for arm in range(num_arms) for name in names]
