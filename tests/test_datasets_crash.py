"""Recording survives being killed at any moment, and a full disk."""

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from robust_instant_policy.datasets import DatasetWriter, load_demonstrations, load_frames
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.files import PART_SUFFIX
from tests.datasets_samples import DESCRIPTION, RATE_HZ, TASK, demonstration

HERE = Path(__file__).parent

OPEN = f"""
import os, resource, signal, sys
sys.path.insert(0, {str(HERE)!r})
from tests.datasets_samples import demonstration, images
from robust_instant_policy.datasets import DatasetWriter
from robust_instant_policy.errors import DatasetError
folder = sys.argv[1]

def writer():
    return DatasetWriter(folder, task={TASK!r}, description={DESCRIPTION!r}, rate_hz={RATE_HZ})

def record_next(writer):
    seed = (-1 if writer.last_seed is None else writer.last_seed) + 1
    if seed % 3 == 2:
        writer.discard(seed)
    else:
        writer.add(demonstration(seed), images(seed))
"""

RECORD_FOR_EVER = (
    OPEN
    + """
with writer() as recording:
    while True:
        record_next(recording)
        print(recording.num_episodes, recording.discarded, flush=True)
"""
)

# Forks a recorder for each k and has it killed just before, or just after, its k-th file takes its name.
RECORD_AND_DIE_AT_EVERY_FILE = (
    OPEN
    + """
def die_at(k, after):
    replace, calls = os.replace, 0
    def counted(*arguments, **options):
        nonlocal calls
        calls += 1
        if calls == k and not after:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(*arguments, **options)
        if calls == k:
            os.kill(os.getpid(), signal.SIGKILL)
    os.replace = counted

for k in range(1, 12):
    for after in (False, True):
        child = os.fork()
        if not child:
            die_at(k, after)
            with writer() as recording:
                for _ in range(3):
                    record_next(recording)
            os._exit(0)
        _, status = os.waitpid(child, 0)
        assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL, status
        with writer() as recording:
            print(recording.num_episodes, recording.discarded, flush=True)
"""
)

RECORD_WITH_LITTLE_SPACE = (
    OPEN
    + """
with writer() as recording:
    recording.add(demonstration(0), images(0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), resource.RLIM_INFINITY))
    try:
        recording.add(demonstration(1), images(1))
    except DatasetError as error:
        print(error)
    assert recording.num_episodes == 1
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    recording.add(demonstration(2), images(2))
"""
)


def check(folder, num_episodes):
    """The folder holds exactly ``num_episodes`` whole episodes and nothing else."""
    demos = load_demonstrations(folder) if num_episodes else []
    assert len(demos) == num_episodes
    for episode, demo in enumerate(demos):
        original = demonstration(demo.seed)
        np.testing.assert_array_equal(demo.trajectory.actions, original.trajectory.actions.astype(np.float32))
        np.testing.assert_array_equal(demo.observation.rgb, original.observation.rgb)
        assert sum(1 for _ in load_frames(folder, episode)) == len(original.trajectory)
    seeds = [demo.seed for demo in demos]
    assert seeds == sorted(set(seeds))
    files = [file for file in folder.rglob("*") if file.is_file()]
    assert not [file for file in files if file.name.endswith(PART_SUFFIX)]
    one_camera = len({demo.observation.camera_pose.tobytes() for demo in demos}) == 1
    assert len(files) == (1 if num_episodes == 0 else 5 + one_camera + 5 * num_episodes)


def test_a_recorder_killed_at_random_moments_loses_at_most_the_episode_under_way(tmp_path):
    folder = tmp_path / "demos"
    dice = random.Random(0)
    told = 0
    for _ in range(4):
        process = subprocess.Popen(
            [sys.executable, "-c", RECORD_FOR_EVER, str(folder)], stdout=subprocess.PIPE, text=True
        )
        first = process.stdout.readline()
        time.sleep(dice.uniform(0, 0.4))
        process.kill()
        rest = process.stdout.read()
        assert process.wait() == -signal.SIGKILL
        told = int((first + rest).splitlines()[-1].split()[0])
        with DatasetWriter(folder, TASK, DESCRIPTION, RATE_HZ) as writer:
            assert told <= writer.num_episodes <= told + 1
            # Every seed up to the last one was either kept or thrown away, none of them twice.
            assert writer.num_episodes + writer.discarded == writer.last_seed + 1
            told = writer.num_episodes
        check(folder, told)
    assert told >= 4


def test_a_recorder_killed_at_any_file_it_writes_leaves_a_folder_to_go_on_with(tmp_path):
    folder = tmp_path / "demos"
    done = subprocess.run(
        [sys.executable, "-c", RECORD_AND_DIE_AT_EVERY_FILE, str(folder)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    counts = [int(line.split()[0]) for line in done.stdout.splitlines()]
    assert len(counts) == 22
    assert counts == sorted(counts)
    check(folder, counts[-1])


@pytest.mark.parametrize("space", [200, 4_000, 8_000])
def test_a_full_disk_is_told_and_leaves_what_was_recorded(tmp_path, space):
    done = subprocess.run(
        [sys.executable, "-c", RECORD_WITH_LITTLE_SPACE, str(tmp_path / "demos"), str(space)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("no space left to write")
    assert done.stdout.count("\n") == 1
    check(tmp_path / "demos", 2)
    assert [demo.seed for demo in load_demonstrations(tmp_path / "demos")] == [0, 2]


def test_a_folder_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DatasetError, match="cannot write"):
        DatasetWriter(tmp_path / "file" / "demos", TASK, DESCRIPTION, RATE_HZ)


def test_an_interrupted_episode_leaves_the_writer_usable(tmp_path, monkeypatch):
    from robust_instant_policy.datasets import writer as module

    def interrupt(*_):
        raise KeyboardInterrupt

    with DatasetWriter(tmp_path / "demos", TASK, DESCRIPTION, RATE_HZ) as writer:
        writer.add(demonstration(0))
        with monkeypatch.context() as patch:
            patch.setattr(module, "episode_table", interrupt)
            with pytest.raises(KeyboardInterrupt):
                writer.add(demonstration(1))
        assert writer.num_episodes == 1
        writer.add(demonstration(2))
    assert [demo.seed for demo in load_demonstrations(tmp_path / "demos")] == [0, 2]


def test_a_lost_info_file_never_costs_the_episodes(tmp_path):
    folder = tmp_path / "demos"
    with DatasetWriter(folder, TASK, DESCRIPTION, RATE_HZ) as writer:
        for seed in range(3):
            writer.add(demonstration(seed))
    (folder / "meta/info.json").rename(tmp_path / "info.json")
    with pytest.raises(DatasetError, match="restore"):
        DatasetWriter(folder, TASK, DESCRIPTION, RATE_HZ)
    (tmp_path / "info.json").rename(folder / "meta/info.json")
    assert len(load_demonstrations(folder)) == 3
