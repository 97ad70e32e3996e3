"""Once a test run: demonstrations and a scene of the real simulator are recorded, and Ctrl-C is made to work."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from robust_instant_policy.cli import main

NUM_DEMONSTRATIONS = 5


@pytest.fixture(scope="session", autouse=True)
def ctrl_c() -> Iterator[None]:
    """Shells start background jobs with Ctrl-C ignored; the programs that tests stop with it would inherit that."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def workbench(tmp_path_factory) -> Path:
    """A folder with ``data/push-cube`` (a few demonstrations) and ``observation.npz`` (a new scene)."""
    from robust_instant_policy.evaluation import scene_seed
    from robust_instant_policy.tasks import make_task

    folder = tmp_path_factory.mktemp("workbench")
    command = ["record", "--task", "push-cube", "--episodes", str(NUM_DEMONSTRATIONS)]
    assert main([*command, "--out", str(folder / "data" / "push-cube")]) == 0
    task = make_task("push-cube")
    try:
        task.reset(scene_seed(0, 0)).save(folder / "observation.npz")
    finally:
        task.close()
    return folder
