"""Workers, failures taken apart, and the page: on real simulators, with the method that needs no language model."""

import contextlib
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from robust_instant_policy.cli import main
from robust_instant_policy.datasets import DatasetWriter, load_demonstrations
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.evaluation import (
    Choice,
    Episode,
    Failure,
    Progress,
    ResultsStore,
    Scene,
    Setup,
    Suite,
    Variant,
    make_suites,
    read_results,
    run_suites,
    scene_seed,
)
from robust_instant_policy.evaluation.failures import FailureAnalysis, film, true_keypoints, video_file
from robust_instant_policy.evaluation.processes import LocalWorkers
from robust_instant_policy.evaluation.work import Planned, SceneWork
from robust_instant_policy.files import lock_folder
from robust_instant_policy.policies import LocatedScene, Neighbours, Stage
from robust_instant_policy.reporting.publication import publish
from robust_instant_policy.tasks import make_task

TASK = "metaworld/reach"  # of those that run in processes of their own; it starts soonest
DATA = Path("data") / "metaworld-reach"
SHOWN = 3
NEIGHBOURS = Variant("neighbours", demos=SHOWN)
DEADLINE_S = 300.0  # what rip eval takes where nothing is said
TIMES = ("seconds", "physics_seconds")


def timeless(rows: Sequence[Episode]) -> set[tuple]:
    return {tuple(value for name, value in vars(row).items() if name not in TIMES) for row in rows}


def is_running(process: int) -> bool:
    stat = Path(f"/proc/{process}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


def suites_of(num_scenes: int, **settings) -> list[Suite]:
    return make_suites(["chosen"], Choice(replace(NEIGHBOURS, **settings), [TASK], ["neighbours"], num_scenes))


def setup_in(folder: Path, data: Path) -> Setup:
    return Setup("embedded", False, folder / "samples.sqlite", data, DEADLINE_S, films=False)


@pytest.fixture(scope="module")
def interrupted(reach, tmp_path_factory) -> tuple[Path, int, str]:
    """Folder, exit status and last words of an evaluation with one worker, stopped with Ctrl-C after three scenes."""
    folder = tmp_path_factory.mktemp("interrupted")
    code = "import sys; from robust_instant_policy.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "eval", "--methods", "neighbours", "--demos", str(SHOWN)]
    command += ["--tasks", TASK, "--episodes", "300", "--no-videos", "--out", str(folder)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=reach)
    assert process.stdout is not None
    seen = 0
    for line in process.stdout:
        seen += "success" in line or "failed" in line
        if seen == 3:
            break
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    return folder, process.returncode, error


@pytest.fixture(scope="module")
def recorded(interrupted) -> tuple[Episode, ...]:
    return read_results(interrupted[0]).episodes


def test_ctrl_c_ends_an_evaluation_in_one_line_and_loses_no_row(interrupted, recorded):
    folder, status, error = interrupted
    assert 3 <= len(recorded) < 300
    assert status == 1
    assert "stopped" in error.strip().splitlines()[-1]
    assert "Traceback" not in error
    assert pq.read_table(folder / "episodes.parquet").num_rows == len(recorded)


def test_a_row_says_which_network_code_and_demonstrations_made_it(recorded):
    (variant,) = {row.variant for row in recorded}
    assert variant.features not in ("auto", "")
    assert re.fullmatch(r"[0-9a-f]{12}", variant.code)
    assert re.fullmatch(r"[0-9a-f]{12}", variant.demonstrations)


def test_an_evaluation_whose_executions_are_there_does_nothing(recorded, interrupted, reach, tmp_path):
    folder = tmp_path / "again"
    shutil.copytree(interrupted[0], folder)
    for data in (reach / "data", tmp_path / "no demonstrations here"):
        run_suites(suites_of(3), setup_in(folder, data), folder, no_workers)
    assert read_results(folder).episodes == recorded
    # sys.argv is another program's here
    assert read_results(folder).manifest.invocations[-1].command == "'(called from Python)'"


def no_workers(setup, works):
    raise AssertionError(f"{len(works)} scenes were handed out")


def handed_out(folder: Path, data: Path, suites: list[Suite], keep: bool = False) -> tuple[int, list[str]]:
    """How many plans would be made, and what the user is told."""
    counts, notes = [], []

    def count(setup, works):
        counts.append(sum(len(work.variants) for work in works))
        return iter(())

    progress = Progress(note=notes.append)
    run_suites(suites, setup_in(folder, data), folder, count, progress, keep=keep)
    return sum(counts), notes


def test_rows_of_other_code_are_run_again_and_told_or_kept_on_demand(interrupted, reach, tmp_path):
    old = tmp_path / "old"
    with closing(ResultsStore(old)) as store:
        rows = read_results(interrupted[0]).episodes
        store.add(*(replace(row, variant=replace(row.variant, code="0123456789ab")) for row in rows))
    again, notes = handed_out(old, reach / "data", suites_of(3))
    assert again == 3
    assert "3 plans were executed with other code" in notes[0]
    assert handed_out(old, reach / "data", suites_of(3), keep=True) == (0, [])


def test_plans_that_a_figure_needs_are_made_until_they_are_stored(interrupted, reach, tmp_path):
    folder = tmp_path / "again"
    shutil.copytree(interrupted[0], folder)
    suites = make_suites(["trajectories"], Choice(NEIGHBOURS, [TASK], ["neighbours"], 2))
    works: list[SceneWork] = []
    shown = load_demonstrations(reach / DATA)
    plan = Neighbours().fit(shown[:SHOWN]).plan(shown[SHOWN].observation)

    def plan_one(setup, missing):
        works.extend(missing)
        yield Planned(missing[0].scene, missing[0].plans[0], plan)

    for left in (2, 1):
        works.clear()
        run_suites(suites, setup_in(folder, reach / "data"), folder, plan_one)
        assert len(works) == left
        assert not any(work.variants for work in works)


def test_rows_with_other_demonstrations_are_not_taken_for_ones_own(interrupted, reach, tmp_path):
    again = tmp_path / "again"
    shutil.copytree(interrupted[0], again)
    shown = load_demonstrations(reach / DATA)
    with DatasetWriter(tmp_path / DATA, TASK, "reach", rate_hz=shown[0].rate_hz) as writer:
        for demonstration in shown[1:]:
            writer.add(demonstration)
    for keep in (False, True):
        assert handed_out(again, tmp_path / "data", suites_of(3), keep)[0] == 3


def test_two_workers_of_which_one_is_killed_write_the_rows_that_one_writes(recorded, reach, tmp_path):
    killed = []

    def kill_one(done: int, total: int, what) -> None:
        if what is not None and not killed:
            killed.append(multiprocessing.active_children()[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    setup = setup_in(tmp_path, reach / "data")
    run_suites(suites_of(3), setup, tmp_path, LocalWorkers(2), Progress(outcome=kill_one))
    assert killed
    assert timeless(read_results(tmp_path).episodes) == timeless(recorded[:3])
    assert not multiprocessing.active_children()


def test_workers_end_at_once_with_the_evaluation_that_was_killed(tmp_path):
    script = tmp_path / "evaluation.py"
    script.write_text(
        "import ctypes, multiprocessing\n"
        "from robust_instant_policy.evaluation.processes import end_with_parent\n\n"
        "def work():\n    end_with_parent()\n    print('at work', flush=True)\n"
        "    ctypes.PyDLL(None).sleep(600)  # as a library that holds the interpreter's lock\n\n"
        "if __name__ == '__main__':\n"
        "    workers = [multiprocessing.get_context('spawn').Process(target=work) for _ in range(2)]\n"
        "    for worker in workers:\n        worker.start()\n        print(worker.pid, flush=True)\n"
        "    workers[0].join()\n"
    )
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    said = [parent.stdout.readline().strip() for _ in range(4)]
    parent.kill()
    parent.communicate(timeout=60)  # the workers hold the pipe as long as they live
    assert not any(is_running(int(worker)) for worker in said if worker != "at work")


def test_a_ray_cluster_on_which_a_worker_is_killed_writes_the_rows_that_a_process_writes(recorded, reach, tmp_path):
    pytest.importorskip("ray")
    from robust_instant_policy.evaluation.cluster import RayWorkers

    killed = []

    def kill_one(done: int, total: int, what) -> None:
        if what is not None and not killed:
            killed.extend(ray_workers_of(os.getpid()))
            os.kill(killed[0], signal.SIGKILL)

    setup = setup_in(tmp_path, reach / "data")
    run_suites(suites_of(2), setup, tmp_path, RayWorkers("local", 1), Progress(outcome=kill_one))
    assert len(killed) == 1
    assert timeless(read_results(tmp_path).episodes) == timeless(recorded[:2])


def ray_workers_of(driver: int) -> list[int]:
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
    found = []
    for process in parents:
        ancestor = process
        while ancestor in parents and ancestor != driver:
            ancestor = parents[ancestor]
        if ancestor == driver and Path(f"/proc/{process}/cmdline").read_bytes().startswith(b"ray::_Actor"):
            found.append(process)
    return found


def test_two_evaluations_do_not_write_into_one_folder(tmp_path):
    lock = lock_folder(tmp_path)
    try:
        with pytest.raises(DatasetError, match="another process"):
            run_suites(suites_of(1), setup_in(tmp_path, tmp_path), tmp_path, no_workers)
    finally:
        os.close(lock)


def test_an_error_in_a_worker_is_told_in_one_line(reach, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(reach)
    command = ["eval", "--methods", "neighbours", "--tasks", TASK, "--demos", str(SHOWN), "--episodes", "1"]
    assert main([*command, "--objects", "unseen", "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "unknown set of objects of metaworld/reach" in error


@pytest.fixture(scope="module")
def scene(workbench):
    """A task in a new scene, a policy that knows it, and everything that a failure is taken apart with."""
    task = make_task("push-cube")
    shown = load_demonstrations(workbench / "data/push-cube", limit=SHOWN)
    known = []
    for demonstration in shown:
        task.reset(demonstration.seed)
        known.append(task.scene_truth())
    policy = Neighbours(workspace=task.workspace).fit(shown)
    seed = scene_seed(0, 0)
    truth = true_keypoints(task, seed, policy.context_, known)
    yield task, policy, task.reset(seed), truth, Scene("push-cube", "seen", seed)
    task.close()


def test_a_seed_that_the_simulator_cannot_take_draws_a_scene_too(scene):
    task = scene[0]
    seeds = [scene_seed(seed, 0) for seed in (4_294_868, 10**30)]
    first, second, again = (task.reset(seed).rgb for seed in (*seeds, seeds[0]))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, second)


def lost(scene: Scene) -> Episode:
    return Episode(scene, NEIGHBOURS, 0, 1, False, 1.0, 1.0, 5.0, 0, None, "the cube is not in the disc")


class Told:
    """A policy that plans as another does, and then follows a trajectory of one's choice."""

    name = "neighbours"

    def __init__(self, policy: Neighbours, change):
        self._policy, self._change = policy, change

    def plan(self, observation):
        return self._change(self._policy.plan(observation))

    def plan_scene(self, scene):
        return self._change(self._policy.plan_scene(scene))

    def executions(self, plan):
        return (plan.trajectory,)


def beside(trajectory):
    """The trajectory 15 cm to the side: it misses the cube."""
    moved = trajectory.actions.copy()
    moved[:, [1, 4, 7]] += 0.15
    return replace(trajectory, actions=moved)


def test_a_failure_is_laid_at_keypoints_that_were_off(scene):
    task, policy, observation, truth, place = scene
    assert truth.error < 0.03  # the worst keypoint; they are moved by 12 cm below
    off = replace(truth.located, keypoints=truth.located.keypoints + np.array([0, 0.12, 0]))
    plan = policy.plan_scene(LocatedScene(off, Stage("keypoints", 0.0)))
    assert not task.execute(plan.trajectory).success
    found = FailureAnalysis(task, place).examine(lost(place), policy, observation, lambda: truth)
    assert (found.stage, found.true_keypoints, found.demonstrator) == ("keypoints", True, True)


def test_a_failure_is_laid_at_the_regression_where_a_candidate_would_have_done_it(scene):
    task, policy, observation, truth, place = scene
    told = Told(policy, lambda plan: replace(plan, trajectory=beside(plan.trajectory)))
    found = FailureAnalysis(task, place).examine(lost(place), told, observation, lambda: truth)
    assert (found.stage, found.true_keypoints, found.good_candidate) == ("regression", False, True)


def test_a_failure_is_laid_at_the_samples_where_no_candidate_would_have_done_it(scene):
    task, policy, observation, truth, place = scene

    def all_beside(plan):
        return replace(
            plan, trajectory=beside(plan.trajectory), candidates=tuple(beside(one) for one in plan.candidates)
        )

    found = FailureAnalysis(task, place).examine(lost(place), Told(policy, all_beside), observation, lambda: truth)
    assert (found.stage, found.good_candidate) == ("samples", False)


def test_a_failure_is_laid_at_the_execution_where_even_the_demonstrator_fails(scene, monkeypatch):
    task, policy, observation, truth, place = scene
    execute = task.execute
    monkeypatch.setattr(task, "execute", lambda trajectory, on_frame=None: execute(beside(trajectory), on_frame))
    found = FailureAnalysis(task, place).examine(lost(place), policy, observation, lambda: truth)
    assert (found.stage, found.demonstrator, found.true_keypoints) == ("execution", False, None)


def test_the_page_tells_every_failure_with_its_film_and_needs_nothing_beside_it(scene, tmp_path, capsys):
    task, policy, observation, _, place = scene
    row = lost(place)
    suite = Suite("table1", ("push-cube",), (NEIGHBOURS,), (place.seed, place.seed + 1))
    won = replace(row, scene=replace(place, seed=place.seed + 1), success=True, failure="")
    (tmp_path / "videos").mkdir()
    (tmp_path / video_file(*row.key)).write_bytes(film(task, policy, observation, 0))
    with closing(ResultsStore(tmp_path)) as store, store.invocation([suite], ["rip", "eval", "--out", "x"], "a model"):
        store.add(row, won, Failure(place, NEIGHBOURS, 0, "regression", True, False, 0.004, True))
    assert "**50** (9 to 91)" in publish(tmp_path)
    page = (tmp_path / "index.html").read_text()
    assert page.count("<video") == 1
    assert "the cube is not in the disc" in page
    assert "regression: one of its candidates" in page
    assert "rip eval --out x" in page
    assert not re.search(r'(src|href)="(http|/)', page)
    assert {"table1-adaptive.svg", "table1-adaptive.png", "table1-adaptive.md", "failures.md", "table.md"} <= set(
        os.listdir(tmp_path)
    )
    before = (tmp_path / "table1-adaptive.svg").read_bytes()
    assert main(["report", str(tmp_path)]) == 0
    assert (tmp_path / "table1-adaptive.svg").read_bytes() == before


def test_a_folder_without_executions_has_no_page(tmp_path):
    with pytest.raises(DatasetError, match="no executions"):
        publish(tmp_path)


def test_figures_are_drawn_for_every_analysis(tmp_path):
    base = Variant("rip", model="a model")
    rng = np.random.default_rng(0)
    suites = make_suites(
        ["table1", "demos", "queries", "dof", "downsampling"], Choice(base, ["pick-banana"], ["rip"], 2)
    )
    rows = []
    for suite in suites:
        for place in suite.scenes:
            for variant in suite.variants:
                won = bool(rng.random() < 0.7)
                rows.append(Episode(place, variant, 0, 1, won, 1.0, 1.0, 5.0, 9, 0.9, "" if won else "missed"))
    with closing(ResultsStore(tmp_path)) as store, store.invocation(suites, ["rip", "eval"], "a model"):
        store.add(*rows)
    publish(tmp_path)
    for suite in suites:
        drawing = (tmp_path / f"{suite.name}-adaptive.svg").read_text()
        assert "success [%]" in drawing
        assert (tmp_path / f"{suite.name}-adaptive.png").stat().st_size > 10_000
