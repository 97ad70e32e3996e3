"""Seeds of test scenes, and the demonstrations of an evaluation."""

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from robust_instant_policy.datasets import DatasetWriter, load_demonstrations
from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.errors import NoDemonstrationsError, UsageError
from robust_instant_policy.files import file_stem
from robust_instant_policy.tasks.record import record
from robust_instant_policy.tasks.task import Task, bounded_seed

# The scenes of demonstrations, of tuning and of tests never meet. Whatever is chosen, a network, a threshold, a prompt,
# is chosen on demonstrations and tuning scenes; what is reported is measured on test scenes.
SPLITS = {"tune": 100_000, "test": 1_000_000}  # seed of the first scene; demonstrations draw theirs from 0 on
SEEDS_A_SET = 1_000  # of demonstrations, apart, so that sets of demonstrations share no scene
SEEDS_A_RUN = 1_000  # apart, so that runs with different --seed share no scene
IMAGES_HZ = 11.0  # about the rate at which demonstrations with images are recorded; rendering them takes long


def scene_seed(seed: int, index: int, split: str = "tune") -> int:
    """Seed of the ``index``-th scene of a run with ``--seed seed`` in one of `SPLITS`."""
    return bounded_seed(SPLITS[split] + seed * SEEDS_A_RUN + index)


def split_of(seed: int) -> str:
    """The one of `SPLITS` that the scene with ``seed`` belongs to."""
    return "tune" if SPLITS["tune"] <= seed < SPLITS["test"] else "test"


def first_demonstration_seed(demo_set: int) -> int:
    """Seed of the first scene that is tried for a set of demonstrations; raises `UsageError` beyond the last set."""
    if demo_set >= (most := SPLITS["tune"] // SEEDS_A_SET):
        raise UsageError(f"there are scenes for {most} sets of demonstrations; set {demo_set} would use those of tests")
    return demo_set * SEEDS_A_SET


def demonstrations_folder(data: Path, task: str, with_images: bool) -> Path:
    """Folder in ``data`` of the demonstrations of ``task``; those with images have a lower rate."""
    return data / (file_stem(task) + ("-images" if with_images else ""))


def stored_demonstrations(folder: Path, task: str, count: int) -> list[Demonstration]:
    """The first ``count`` demonstrations of ``task`` in ``folder``, or all if there are fewer."""
    try:
        return load_demonstrations(folder, task=task, limit=count)
    except NoDemonstrationsError:
        return []


def obtain_demonstrations(
    task: Task,
    folder: Path,
    count: int,
    on_progress: Callable[[int, int, int], None] | None = None,
    with_images: bool = False,
    demo_set: int = 0,
) -> list[Demonstration]:
    """The first ``count`` demonstrations of ``task`` in ``folder``; missing ones are recorded.

    ``demo_set`` decides in which scenes. ``with_images`` records the images of all steps, at about `IMAGES_HZ`.
    ``on_progress`` receives (episodes stored, episodes wanted, attempts discarded).
    """
    shown = stored_demonstrations(folder, task.name, count)
    if len(shown) == count:
        return shown
    every = max(1, round(task.record_hz / IMAGES_HZ)) if with_images else 1
    rate_hz = task.record_hz / every
    robot = getattr(task, "robot_type", None)
    with DatasetWriter(folder, task.name, task.description, rate_hz, robot) as writer:
        seed = first_demonstration_seed(demo_set)
        record(task, writer, count, seed, with_images=with_images, every=every, on_progress=on_progress)
    return load_demonstrations(folder, task=task.name, limit=count)


def demonstration_digests(demonstrations: Iterable[Demonstration]) -> list[str]:
    """Short digests of the first 0, 1, 2, … demonstrations, over all numbers that methods read."""
    digest = hashlib.sha256()
    digests = [""]
    for demonstration in demonstrations:
        seen, trajectory = demonstration.observation, demonstration.trajectory
        arrays = (seen.rgb, seen.depth, seen.intrinsics, seen.camera_pose, trajectory.actions, trajectory.times)
        frames = demonstration.frames() if demonstration.frames is not None else ()
        for array in (*arrays, np.array(demonstration.rate_hz), *frames):
            digest.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
        digests.append(digest.hexdigest()[:12])
    return digests
