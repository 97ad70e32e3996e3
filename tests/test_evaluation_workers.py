"""Workers, failures taken apart, and the page: on the real simulator, with the method that needs no language model."""

import multiprocessing
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robust_instant_policy.cli import main
from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.evaluation import (
    Choice,
    Episode,
    Failure,
    Progress,
    Scene,
    Setup,
    Suite,
    Variant,
    make_suites,
    open_episodes,
    open_failures,
    run_suites,
    scene_seed,
)
from robust_instant_policy.evaluation.cluster import Cluster
from robust_instant_policy.evaluation.failures import Inquest, film, true_keypoints, video_file
from robust_instant_policy.evaluation.manifest import invocation
from robust_instant_policy.evaluation.processes import Processes
from robust_instant_policy.files import lock_folder
from robust_instant_policy.policies import KeypointContext, Neighbours
from robust_instant_policy.reporting.publication import publish
from robust_instant_policy.tasks import make_task

SHOWN = 3
NEIGHBOURS = Variant("neighbours", demos=SHOWN)
TIMES = ("seconds", "physics_seconds")


def timeless(rows: list[Episode]) -> set[tuple]:
    return {tuple(value for name, value in vars(row).items() if name not in TIMES) for row in rows}


def is_running(process: int) -> bool:
    stat = Path(f"/proc/{process}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.fixture(scope="module")
def interrupted(workbench, tmp_path_factory) -> tuple[list[Episode], int, str]:
    """Rows, exit status and last words of an evaluation with one worker, stopped with Ctrl-C after three scenes."""
    folder = tmp_path_factory.mktemp("interrupted")
    code = "import sys; from robust_instant_policy.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "eval", "--methods", "neighbours", "--demos", str(SHOWN)]
    command += ["--tasks", "push-cube", "--episodes", "300", "--no-videos", "--out", str(folder)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=workbench)
    assert process.stdout is not None
    seen = 0
    for line in process.stdout:
        seen += "success" in line or "failed" in line
        if seen == 3:
            break
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    return open_episodes(folder).rows, process.returncode, error


def test_ctrl_c_ends_an_evaluation_in_one_line_and_loses_no_row(interrupted):
    rows, status, error = interrupted
    assert 3 <= len(rows) < 300
    assert status == 1
    assert "stopped" in error.strip().splitlines()[-1]
    assert "Traceback" not in error


def test_two_workers_of_which_one_is_killed_write_the_rows_that_one_writes(interrupted, workbench, tmp_path):
    rows, _, _ = interrupted
    killed = []

    def kill_one(done: int, total: int, what) -> None:
        if what is not None and not killed:
            killed.append(multiprocessing.active_children()[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    suites = make_suites(["chosen"], Choice(NEIGHBOURS, ["push-cube"], ["neighbours"], len(rows)))
    setup = Setup("embedded", False, tmp_path / "samples.sqlite", workbench / "data", 60.0, films=False)
    run_suites(suites, setup, tmp_path, Processes(2), Progress(lambda *_: None, kill_one))
    assert killed
    assert timeless(open_episodes(tmp_path).rows) == timeless(rows)
    assert not multiprocessing.active_children()


def test_a_worker_in_the_middle_of_something_ends_with_the_evaluation_that_was_killed(tmp_path):
    script = tmp_path / "evaluation.py"
    script.write_text(
        "import multiprocessing, time\n"
        "from robust_instant_policy.evaluation.processes import end_with_parent\n\n"
        "def work():\n    end_with_parent()\n    print('at work', flush=True)\n    time.sleep(600)\n\n"
        "if __name__ == '__main__':\n"
        "    worker = multiprocessing.get_context('spawn').Process(target=work)\n"
        "    worker.start()\n    print(worker.pid, flush=True)\n    worker.join()\n"
    )
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    said = {parent.stdout.readline().strip(), parent.stdout.readline().strip()}
    (worker,) = said - {"at work"}
    parent.kill()
    parent.communicate(timeout=60)  # the worker holds the pipe as long as it lives
    assert not is_running(int(worker))


def test_a_ray_cluster_writes_the_rows_that_a_process_writes(interrupted, workbench, tmp_path):
    pytest.importorskip("ray")
    rows, _, _ = interrupted
    suites = make_suites(["chosen"], Choice(NEIGHBOURS, ["push-cube"], ["neighbours"], 2))
    setup = Setup("embedded", False, tmp_path / "samples.sqlite", workbench / "data", 60.0, films=False)
    run_suites(suites, setup, tmp_path, Cluster("local", 1), Progress(lambda *_: None, lambda *_: None))
    assert timeless(open_episodes(tmp_path).rows) == timeless(rows[:2])


def test_two_evaluations_do_not_write_into_one_folder(tmp_path):
    suites = make_suites(["chosen"], Choice(NEIGHBOURS, ["push-cube"], ["neighbours"], 1))
    setup = Setup("embedded", False, tmp_path / "samples.sqlite", tmp_path, 60.0, films=False)
    lock = lock_folder(tmp_path)
    try:
        with pytest.raises(DatasetError, match="another process"):
            run_suites(suites, setup, tmp_path, Processes(1), Progress(lambda *_: None, lambda *_: None))
    finally:
        os.close(lock)


def test_an_error_in_a_worker_is_told_in_one_line(workbench, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(workbench)
    command = ["eval", "--methods", "neighbours", "--tasks", "push-cube", "--demos", str(SHOWN), "--episodes", "1"]
    assert main([*command, "--objects", "unseen", "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "unknown set of objects of push-cube" in error


@pytest.fixture(scope="module")
def scene(workbench):
    """A task in a new scene, a policy that knows it, and everything that a failure is taken apart with."""
    task = make_task("push-cube")
    shown = load_demonstrations(workbench / "data/push-cube", limit=SHOWN)
    known = []
    for demonstration in shown:
        task.reset(demonstration.seed)
        known.append(task.scene_truth())
    context = KeypointContext(workspace=task.workspace)
    policy = Neighbours(context).fit(shown)
    seed = scene_seed(0, 0)
    truth = true_keypoints(task, seed, context, shown, known)
    yield task, policy, task.reset(seed), truth, Scene("push-cube", "seen", seed)
    task.close()


def lost(scene: Scene) -> Episode:
    return Episode(scene, NEIGHBOURS, 0, 1, False, 1.0, 1.0, 5.0, 0, None, "the cube is not in the disc")


class Told:
    """A policy that plans as another does, and then follows a trajectory of one's choice."""

    name = "neighbours"

    def __init__(self, policy: Neighbours, change):
        self._policy, self._change = policy, change

    def plan(self, observation):
        return self._change(self._policy.plan(observation))

    def executions(self, plan):
        return (plan.trajectory,)


def beside(trajectory):
    """The trajectory 15 cm to the side: it misses the cube."""
    moved = trajectory.actions.copy()
    moved[:, [1, 4, 7]] += 0.15
    return replace(trajectory, actions=moved)


def test_a_failure_is_laid_at_keypoints_that_were_off(scene):
    task, policy, observation, truth, place = scene
    assert truth.error < 0.02
    seen = replace(observation)
    policy.context.assume(seen, replace(truth.located, keypoints=truth.located.keypoints + np.array([0, 0.12, 0])))
    assert not task.execute(policy.plan(seen).trajectory).success
    found = Inquest(task, place).examine(lost(place), policy, seen, policy.context, lambda: truth)
    assert (found.stage, found.true_keypoints, found.demonstrator) == ("keypoints", True, True)


def test_a_failure_is_laid_at_the_regression_where_a_candidate_would_have_done_it(scene):
    task, policy, observation, truth, place = scene
    told = Told(policy, lambda plan: replace(plan, trajectory=beside(plan.trajectory)))
    found = Inquest(task, place).examine(lost(place), told, observation, policy.context, lambda: truth)
    assert (found.stage, found.true_keypoints, found.good_candidate) == ("regression", False, True)


def test_a_failure_is_laid_at_the_samples_where_no_candidate_would_have_done_it(scene):
    task, policy, observation, truth, place = scene

    def all_beside(plan):
        return replace(
            plan, trajectory=beside(plan.trajectory), candidates=tuple(beside(one) for one in plan.candidates)
        )

    found = Inquest(task, place).examine(
        lost(place), Told(policy, all_beside), observation, policy.context, lambda: truth
    )
    assert (found.stage, found.good_candidate) == ("samples", False)


def test_a_failure_is_laid_at_the_execution_where_even_the_demonstrator_fails(scene, monkeypatch):
    task, policy, observation, truth, place = scene
    execute = task.execute
    monkeypatch.setattr(task, "execute", lambda trajectory, on_frame=None: execute(beside(trajectory), on_frame))
    found = Inquest(task, place).examine(lost(place), policy, observation, policy.context, lambda: truth)
    assert (found.stage, found.demonstrator, found.true_keypoints) == ("execution", False, None)


def test_the_page_tells_every_failure_with_its_film_and_needs_nothing_beside_it(scene, tmp_path, capsys):
    task, policy, observation, _, place = scene
    row = lost(place)
    suite = Suite("table1", ("push-cube",), (NEIGHBOURS,), (place.seed, place.seed + 1))
    episodes, failures = open_episodes(tmp_path), open_failures(tmp_path)
    won = replace(row, scene=replace(place, seed=place.seed + 1), success=True, failure="")
    for one in (row, won):
        episodes.add(one)
    failures.add(Failure(place, NEIGHBOURS, 0, "regression", True, False, 0.004, True))
    episodes.close()
    failures.close()
    (tmp_path / "videos").mkdir()
    (tmp_path / video_file(*row.key)).write_bytes(film(task, policy, observation, 0))
    with invocation(tmp_path, [suite], ["rip", "eval", "--out", "x"], "a model"):
        pass
    assert "**50** (9 to 91)" in publish(tmp_path)
    page = (tmp_path / "index.html").read_text()
    assert page.count("<video") == 1
    assert "the cube is not in the disc" in page
    assert "regression: one of its candidates" in page
    assert "rip eval --out x" in page
    assert not re.search(r'(src|href)="(http|/)', page)
    assert {"table1.svg", "table1.png", "table1.md", "failures.md", "table.md"} <= set(os.listdir(tmp_path))
    before = (tmp_path / "table1.svg").read_bytes()
    assert main(["report", str(tmp_path)]) == 0
    assert (tmp_path / "table1.svg").read_bytes() == before


def test_a_folder_without_executions_has_no_page(tmp_path):
    with pytest.raises(DatasetError, match="no executions"):
        publish(tmp_path)


def test_figures_are_drawn_for_every_analysis(tmp_path):
    base = Variant("rip", model="a model")
    rng = np.random.default_rng(0)
    suites = make_suites(
        ["table1", "demos", "queries", "dof", "downsampling"], Choice(base, ["pick-banana"], ["rip"], 2)
    )
    table = open_episodes(tmp_path)
    for suite in suites:
        for place in suite.scenes:
            for variant in suite.variants:
                won = bool(rng.random() < 0.7)
                table.add(Episode(place, variant, 0, 1, won, 1.0, 1.0, 5.0, 9, 0.9, "" if won else "missed"))
    table.close()
    with invocation(tmp_path, suites, ["rip", "eval"], "a model"):
        pass
    publish(tmp_path)
    for suite in suites:
        drawing = (tmp_path / f"{suite.name}.svg").read_text()
        assert "success [%]" in drawing
        assert (tmp_path / f"{suite.name}.png").stat().st_size > 10_000
