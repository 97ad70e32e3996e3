"""Converting a recording to demonstrations, or to a demonstrations folder."""

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from robust_instant_policy.datasets import layout
from robust_instant_policy.datasets.importers.lerobot import read_lerobot
from robust_instant_policy.datasets.importers.source import Rig, SourceEpisode
from robust_instant_policy.datasets.reader import load_demonstrations
from robust_instant_policy.datasets.writer import DatasetWriter
from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.errors import DatasetError

SAME_M = 1e-5  # poses are stored as float32


def import_demonstrations(path: str | Path, task: str, rig: Rig) -> list[Demonstration]:
    """The successful demonstrations of ``task`` in a ManiSkill, robomimic or LeRobot v3 recording.

    Raises `DatasetError` for another kind of file, and for one that lacks data of a demonstration; the error
    lists all of it, and how to supply it.
    """
    return [episode.on(rig).demonstration(task, rig.triangle) for episode in _open(Path(path), rig)]


def convert_demonstrations(path: str | Path, out: str | Path, task: str, description: str, rig: Rig) -> int:
    """Write what `import_demonstrations` reads into a demonstrations folder, with the images of all steps.

    Continues an interrupted call, and adds to episodes of other recordings. Returns the number
    of demonstrations in the folder.
    Raises `DatasetError` as `import_demonstrations` and `DatasetWriter` do.
    """
    writer = None
    with ExitStack() as stack:
        there: list[Demonstration] = []
        for episode in _open(Path(path), rig):
            demonstration = episode.on(rig).demonstration(task, rig.triangle)
            if writer is None:
                writer = stack.enter_context(DatasetWriter(out, task, description, demonstration.rate_hz))
                there = load_demonstrations(out, task=task) if writer.num_episodes else []
            if _is_new(demonstration, there, writer.path):
                writer.add(demonstration, None if episode.images is None else episode.images())
        return 0 if writer is None else writer.num_episodes


def _is_new(demonstration: Demonstration, there: Iterable[Demonstration], out: Path) -> bool:
    """Whether ``there`` has no episode of its name; `DatasetError` if it has a different one of that name."""
    for other in there:
        if all(demonstration.info.get(name) == other.info.get(name) for name in ("source", "episode")):
            actions = demonstration.trajectory.actions, other.trajectory.actions
            if actions[0].shape == actions[1].shape and np.allclose(*actions, rtol=0, atol=SAME_M):
                return False
            raise DatasetError(
                f"{out} holds another {other.info['source']} {other.info['episode']}, converted with another rig or "
                "from another file of that name; choose a new folder, or give the file another name"
            )
    return True


def _open(path: Path, rig: Rig) -> Iterator[SourceEpisode]:
    if not path.exists():
        raise DatasetError(f"there is no {path} to import")
    if path.is_dir():
        if (path / layout.INFO_PATH).exists():
            return read_lerobot(path, rig)
    else:
        from robust_instant_policy.datasets.importers.hdf5 import members, open_hdf5  # these need an extra
        from robust_instant_policy.datasets.importers.maniskill import read_maniskill
        from robust_instant_policy.datasets.importers.robomimic import read_robomimic

        with open_hdf5(path) as file:
            names = set(members(file, "/"))
            robomimic = bool(members(file, "data"))
        if path.with_suffix(".json").exists() and any(name.startswith("traj_") for name in names):
            return read_maniskill(path, rig.camera)
        if robomimic:
            return read_robomimic(path, rig.camera)
    raise DatasetError(
        f"{path} is none of the recordings that can be imported: a ManiSkill trajectory (NAME.h5 beside NAME.json), "
        "a robomimic HDF5 file, a LeRobot v3 folder"
    )
