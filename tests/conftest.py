"""Demonstrations and a scene of the real simulator, recorded once in a test run; Ctrl-C is made to work."""

import shutil
import signal
import tarfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from filelock import FileLock
from hypothesis import settings

from robust_instant_policy.cli import main
from robust_instant_policy.datasets import load_demonstrations

settings.register_profile("busy machine", deadline=None)
settings.load_profile("busy machine")

NUM_DEMONSTRATIONS = 5
# These files take the most time. They come first, so that all workers end at about the same time.
LONGEST = (
    "tasks_aloha", "evaluation_workers", "robots_run", "diffusion", "tasks_five", "studio", "llm_embedded", "demo",
    "docs", "tasks_metaworld", "tasks_assets", "policies", "sanity", "fuzz", "cli", "tasks_push_cube", "own_tasks",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    places = {f"test_{name}": place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(places)))


@pytest.fixture(scope="session", autouse=True)
def ctrl_c() -> Iterator[None]:
    """Shells start background jobs with Ctrl-C ignored; the programs that tests stop with it would inherit that."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def workbench(tmp_path_factory, worker_id) -> Path:
    """A folder with ``data/push-cube`` (a few demonstrations) and ``observation.npz`` (a new scene).

    Each worker has a copy of its own, because tests write into it.
    """
    base = tmp_path_factory.getbasetemp()
    shared = (base if worker_id == "master" else base.parent) / "recorded"
    with FileLock(f"{shared}.lock"):
        if not shared.exists():
            _record(shared.with_suffix(".part"))
            shared.with_suffix(".part").rename(shared)
    return Path(shutil.copytree(shared, base / "workbench"))


@pytest.fixture(scope="session")
def context(workbench):
    """The context of the workbench's demonstrations, made once in a worker for all tests that plan from it."""
    from robust_instant_policy.policies import Settings, build_context

    return build_context(load_demonstrations(workbench / "data" / "push-cube"), Settings(features="efficientnet"))


@pytest.fixture(scope="session")
def reach(tmp_path_factory) -> Path:
    """A folder with ``data/metaworld-reach``, of the task that a new process starts soonest."""
    folder = tmp_path_factory.mktemp("reach")
    out = folder / "data" / "metaworld-reach"
    assert main(["record", "--task", "metaworld/reach", "--episodes", "4", "--out", str(out)]) == 0
    return folder


@pytest.fixture
def in_this_process(monkeypatch) -> None:
    """``rip eval`` works here, not in a process of its own, which takes seconds to start."""
    from robust_instant_policy.evaluation.workbench import Workbench

    def work_here(setup, works):
        with closing(Workbench(setup)) as bench:
            for work in works:
                yield from bench.run(work)

    monkeypatch.setattr("robust_instant_policy.commands.eval.LocalWorkers", lambda count: work_here)


@pytest.fixture(scope="session")
def lerobot_files(tmp_path_factory) -> Path:
    """Datasets that lerobot 0.6.1 wrote or edited (`files/make_lerobot_files.py`)."""
    folder = tmp_path_factory.mktemp("lerobot")
    with tarfile.open(Path(__file__).parent / "files" / "lerobot-0.6.1.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    return folder


def _record(folder: Path) -> None:
    from robust_instant_policy.evaluation import scene_seed
    from robust_instant_policy.tasks import make_task

    folder.mkdir()
    command = ["record", "--task", "push-cube", "--episodes", str(NUM_DEMONSTRATIONS)]
    assert main([*command, "--out", str(folder / "data" / "push-cube")]) == 0
    task = make_task("push-cube")
    try:
        task.reset(scene_seed(0, 0)).save(folder / "observation.npz")
    finally:
        task.close()
