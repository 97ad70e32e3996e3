"""Bad input gets one clear line, exit 1 or 2, and loses nothing."""

import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from robust_instant_policy import Observation, Plan
from robust_instant_policy.cli import main
from robust_instant_policy.commands.console import StageConsole
from robust_instant_policy.datasets import DatasetWriter, load_demonstrations
from robust_instant_policy.interrupts import noted_interrupts
from robust_instant_policy.robots.signals import stop_on_signals
from robust_instant_policy.tasks.record import record
from tests.stand_in_server import StandInServer, error


def refused(arguments: list[str], capsys) -> tuple[int, str]:
    """Exit status and the one line of a command that must not work."""
    try:
        status = main(arguments)
    except SystemExit as stop:  # argparse: usage and one line
        status = stop.code
        return status, capsys.readouterr().err.strip().splitlines()[-1]
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return status, lines[0]


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["demo", "--task", "fly"], 2, "push-cube"),
        (["record", "--task", "fly", "--out", "x"], 2, "push-cube"),
        (["record", "--task", "push-cube", "--assets", "maniskill", "--out", "x"], 2, "known: code"),
        (["eval", "--assets", "maniskill", "--out", "x"], 2, "known: code"),
        (["eval", "--tasks", "fly", "--out", "x"], 2, "push-cube"),
        (["eval", "--methods", "magic", "--out", "x"], 2, "rip-gauss"),
        (["eval", "--sets", "200", "--out", "x"], 2, "100 sets"),
        (["demo", "--demos", "0"], 2, "at least once"),
        (["demo", "--demos", "-1"], 2, "--demos -1: the task must be shown at least once"),
        (["demo", "--demos", "absent"], 1, "there is no folder absent"),
        (["demo", "--features", "nosuch"], 1, "no image descriptors 'nosuch'"),
        (["demo", "--llm", "gguf:absent.gguf"], 1, "no model file at absent.gguf"),
        (["demo", "--keypoints", "os:nosuch"], 2, "os has no class nosuch"),
        (["eval", "--features", "nosuch", "--out", "x"], 1, "no image descriptors 'nosuch'"),
        (["eval", "--demos", "0", "--out", "x"], 2, "at least 1"),
        (["demo", "--seed", "-1"], 2, "whole number"),
        (["plan", "--demos", "absent", "--observation", "absent.npz"], 1, "absent.npz"),
        (["view", "--demos", "/"], 1, "not a demonstrations folder"),
        (["juggle"], 2, "juggle"),
    ],
)
def test_wrong_usage_is_told_in_one_line(arguments, status, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, line = refused(arguments, capsys)
    assert code == status
    assert words in line


def test_what_belongs_to_something_else_is_refused_and_left_alone(tmp_path, capsys):
    (tmp_path / "demos" / "meta").mkdir(parents=True)
    (tmp_path / "demos" / "meta" / "rip.json").write_text("{}")
    code, line = refused(["demo", "--out", str(tmp_path / "demos")], capsys)
    assert (code, "holds demonstrations; choose another folder" in line) == (2, True)
    np.save(tmp_path / "one-array.npy", np.zeros(3))
    code, line = refused(["plan", "--demos", "absent", "--observation", str(tmp_path / "one-array.npy")], capsys)
    assert (code, "not an .npz" in line) == (1, True)
    with sqlite3.connect(tmp_path / "bookmarks.sqlite") as bookmarks:
        bookmarks.execute("CREATE TABLE bookmarks (address TEXT)")
    before = (tmp_path / "bookmarks.sqlite").read_bytes()
    code, line = refused(["samples", str(tmp_path / "bookmarks.sqlite")], capsys)
    assert (code, "another program" in line) == (2, True)
    assert (tmp_path / "bookmarks.sqlite").read_bytes() == before
    (tmp_path / "samples.sqlite").touch()
    code, line = refused(["samples", str(tmp_path / "samples.sqlite")], capsys)
    assert (code, "is empty" in line) == (2, True)
    assert (tmp_path / "samples.sqlite").read_bytes() == b""
    (tmp_path / "episodes.parquet").touch()
    code, line = refused(["demo", "--out", str(tmp_path)], capsys)
    assert (code, "holds an evaluation" in line) == (2, True)


def test_a_missing_or_empty_demonstrations_folder_is_told(workbench, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(workbench)
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "absent", tmp_path / "empty"):
        code, line = refused(["plan", "--demos", str(folder), "--observation", "observation.npz"], capsys)
        assert code == 1
        assert str(folder) in line


def test_demonstrations_of_another_task_are_refused(workbench, tmp_path, capsys):
    with DatasetWriter(tmp_path / "other", task="peel-banana", description="", rate_hz=55.0) as writer:
        writer.add(replace(load_demonstrations(workbench / "data/push-cube")[0], task="peel-banana"))
    code, line = refused(["demo", "--task", "push-cube", "--demos", str(tmp_path / "other")], capsys)
    assert code == 1
    assert "push-cube" in line
    assert "peel-banana" in line


def test_keypoints_are_not_compared_with_the_truth_of_another_level(workbench, tmp_path, capsys):
    demos = str(workbench / "data" / "push-cube")
    code, line = refused(["keypoints", "--demos", demos, "--level", "hard", "--out", str(tmp_path / "page")], capsys)
    assert (code, "--level" in line) == (2, True)


def test_a_depth_image_of_zeros_is_told(workbench, tmp_path, capsys):
    seen = Observation.load(workbench / "observation.npz")
    blind = Observation(seen.rgb, np.zeros_like(seen.depth), seen.intrinsics, seen.camera_pose)
    blind.save(tmp_path / "blind.npz")
    code, line = refused(
        ["plan", "--demos", str(workbench / "data/push-cube"), "--observation", str(tmp_path / "blind.npz")], capsys
    )
    assert code == 1
    assert "depth" in line


@pytest.mark.parametrize("content", [None, b"not a model"])
def test_a_model_file_that_is_missing_or_corrupt_is_told(workbench, tmp_path, capsys, content):
    path = tmp_path / "model.gguf"
    if content is not None:
        path.write_bytes(content)
    code, line = refused(
        [
            "plan", "--demos", str(workbench / "data/push-cube"),
            "--observation", str(workbench / "observation.npz"), "--llm", f"gguf:{path}",
        ],
        capsys,
    )  # fmt: skip
    assert code == 1
    assert str(path) in line


@pytest.mark.parametrize("server", ["absent", "refuses the key"])
@pytest.mark.parametrize("command", ["plan", "serve", "demo", "eval"])
def test_a_server_that_cannot_be_used_is_told_before_anything_else_is_done(
    workbench, command, server, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    demos = ["--demos", str(workbench / "data" / "push-cube")]
    arguments = {
        "plan": [*demos, "--observation", str(workbench / "observation.npz")],
        "serve": [*demos, "--port", "0"],
        "eval": ["--methods", "rip", "neighbours", "--out", "run"],
    }
    busy = StandInServer(lambda _: error("no such key", 401))
    address, words = ("http://127.0.0.1:9/v1", "is the server running") if server == "absent" else (busy.url, "key")
    try:
        status, line = refused([command, *arguments.get(command, []), "--llm", f"{address}#m"], capsys)
    finally:
        busy.close()
    assert status == 1
    assert words in line
    assert not list(tmp_path.iterdir())  # nothing recorded, planned or evaluated


def test_no_space_left_is_told_and_what_was_there_stays(workbench, tmp_path, capsys, monkeypatch):
    import robust_instant_policy.files as files

    folder = tmp_path / "data"
    shutil.copytree(workbench / "data/push-cube", folder)
    before = len(load_demonstrations(folder))

    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    code, line = refused(["record", "--task", "push-cube", "--episodes", str(before + 1), "--out", str(folder)], capsys)
    monkeypatch.undo()
    assert code == 1
    assert "space" in line
    assert len(load_demonstrations(folder)) == before


def test_ctrl_c_ends_a_recording_in_one_line_and_keeps_finished_episodes(tmp_path):
    folder = tmp_path / "data"
    code = "import sys; from robust_instant_policy.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "record", "--task", "metaworld/reach", "--episodes", "500"]
    process = subprocess.Popen([*command, "--out", str(folder)], stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not (folder / "meta" / "info.json").exists():
        assert time.monotonic() < deadline, "no episode was recorded in time"
        assert process.poll() is None
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "stopped" in error.strip().splitlines()[-1]
    assert "Traceback" not in error
    assert len(load_demonstrations(folder)) >= 1


class Library:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)  # Python prints what a destructor raises, and goes on


class Scenes:
    """A task, and a writer of its demonstrations."""

    name, num_episodes, last_seed, tried = "scenes", 0, None, 0

    def demonstrate(self, seed):
        self.tried += 1
        Library()
        return SimpleNamespace(success=False, failure="nothing was shown")

    def discard(self, seed):
        """Nothing is kept."""


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_ctrl_c_that_python_drops_ends_the_command_before_its_next_stage_motion_or_scene():
    with noted_interrupts():
        Library()
        with pytest.raises(KeyboardInterrupt), StageConsole().stage("execution"):
            pytest.fail("the stage began")
        with pytest.raises(KeyboardInterrupt), stop_on_signals():
            pytest.fail("the arm moved")
    with noted_interrupts():
        scenes = Scenes()
        with pytest.raises(KeyboardInterrupt):
            record(scenes, scenes, 10)
        assert scenes.tried == 1
    with noted_interrupts(), stop_on_signals() as stop, StageConsole().stage("execution"):
        Library()  # while an arm moves it is a request, and the outcome is stored
    assert stop.reason == "Ctrl-C"


@pytest.mark.parametrize("out", ["folder", "file/plan.json"])
@pytest.mark.parametrize("command", ["plan --observation none.npz", "check", "keypoints"])
def test_an_output_that_cannot_be_written_is_told_before_any_work(command, out, tmp_path, capsys):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    assert main([*command.split(), "--demos", "nowhere", "--out", str(tmp_path / out)]) == 1
    assert "is a f" in capsys.readouterr().err


def test_a_plan_is_made_from_files_alone(workbench, tmp_path, capsys):
    out = tmp_path / "plan.json"
    command = ["plan", "--demos", str(workbench / "data/push-cube"), "--queries", "3"]
    assert main([*command, "--observation", str(workbench / "observation.npz"), "--out", str(out)]) == 0
    plan = Plan.load(out)
    assert len(plan.candidates) == 3
    assert 20 <= len(plan.trajectory) <= 40
    assert plan.usage.tokens > 0
    assert [stage.name for stage in plan.usage.stages] == ["keypoints", "language model", "regression"]
