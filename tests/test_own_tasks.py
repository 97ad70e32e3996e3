"""Tasks and keypoints of one's own: the template, the checks, and everything else that takes a task."""

import sys
from pathlib import Path

import numpy as np
import pytest

from robust_instant_policy.cli import main
from robust_instant_policy.datasets import DatasetWriter, load_demonstrations
from robust_instant_policy.errors import InvalidValueError, KeypointError, MissingMethodError, UsageError
from robust_instant_policy.evaluation import read_results
from robust_instant_policy.geometry import make_pose
from robust_instant_policy.plugins import load_class
from robust_instant_policy.policies import Neighbours
from robust_instant_policy.sanity import errors
from robust_instant_policy.tasks import Execution, check_task, make_task
from robust_instant_policy.tasks.record import record
from robust_instant_policy.tasks.task import require
from robust_instant_policy.tasks.template import PlaceBlock

KEYPOINTS = '''
import numpy as np
from robust_instant_policy.geometry import lift

class Middles:
    """The middles of the red and the blue thing."""

    def locate(self, observation):
        return np.concatenate([self.corners(observation, channel) for channel in (0, 2)])

    def corners(self, observation, channel):
        seen = observation.rgb[..., channel] > observation.rgb.mean(axis=2) + 30
        camera = observation.intrinsics, observation.camera_pose
        points = lift(np.argwhere(seen)[:, ::-1], observation.depth[seen], *camera)
        return np.stack([points.min(axis=0), points.max(axis=0)])
'''
BARE = '''
from robust_instant_policy.tasks import Execution
from robust_instant_policy.tasks.template import PlaceBlock

class Bare:
    """Reset and execute, nothing else; nothing succeeds."""
    def __init__(self):
        self.scene = PlaceBlock()
    def reset(self, seed):
        return self.scene.reset(seed)
    def execute(self, trajectory, on_frame=None):
        return Execution(False, "it never does")
'''
TELLING = '''
from robust_instant_policy.tasks.template import PlaceBlock

class Telling(PlaceBlock):
    """Execute tells less than it must."""
    def execute(self, trajectory, on_frame=None):
        return True
    def demonstrate(self, seed):
        return PlaceBlock().demonstrate(seed)
'''


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    return tmp_path


def made(kind: type) -> PlaceBlock:
    """The task as `make_task` makes it."""
    setattr(sys.modules[__name__], kind.__name__, kind)
    return make_task(f"{__name__}:{kind.__name__}")


def test_the_template_runs_as_it_is_written(folder, capsys):
    assert main(["new-task", "my_task.py"]) == 0
    assert main(["new-task", "--check", "my_task:PlaceBlock"]) == 0
    assert "0 errors, 0 other findings" in capsys.readouterr().out
    assert main(["new-task", "my_task.py"]) == 2  # nothing is overwritten
    assert main(["record", "--task", "my_task:PlaceBlock", "--episodes", "2", "--out", "shown"]) == 0
    assert [one.task for one in load_demonstrations("shown")] == ["my_task:PlaceBlock"] * 2


def test_a_task_and_keypoints_of_ones_own_are_evaluated(folder, capsys):
    (folder / "my_keypoints.py").write_text(KEYPOINTS)
    assert main(["new-task", "placing.py"]) == 0
    command = "eval --tasks placing:PlaceBlock --methods neighbours --demos 4 --episodes 2 --out runs/own"
    assert main([*command.split(), "--keypoints", "my_keypoints:Middles"]) == 0
    rows = read_results(Path("runs/own")).episodes
    assert [row.success for row in rows] == [True, True]
    assert {(row.scene.task, row.variant.keypoints) for row in rows} == {("placing:PlaceBlock", "my_keypoints:Middles")}
    assert "placing:PlaceBlock" in Path("runs/own/index.html").read_text()


def test_a_defect_in_keypoints_of_ones_own_is_a_failed_plan_and_not_the_end_of_the_run(folder, in_this_process, capsys):
    (folder / "broken.py").write_text(
        "class Broken:\n    def locate(self, observation):\n        raise OSError('no camera')\n"
    )
    command = "eval --tasks robust_instant_policy.tasks.template:PlaceBlock --methods neighbours --demos 3 --episodes 2"
    assert main([*command.split(), "--keypoints", "broken:Broken", "--out", "run"]) == 0
    results = read_results(Path("run"))
    assert [row.failure for row in results.episodes] == [
        "no plan: the keypoints broken:Broken raise OSError: no camera"
    ] * 2
    assert [failure.stage for failure in results.failures] == ["keypoints"] * 2


def test_an_execution_of_another_type_is_told_in_one_line(folder, in_this_process, capsys):
    (folder / "telling.py").write_text(TELLING)
    command = "eval --tasks telling:Telling --methods replay --demos 1 --episodes 1 --out run"
    assert main([*command.split()]) == 2
    assert "execute(…) of telling:Telling must return Execution, got bool" in capsys.readouterr().err


def test_what_a_bare_task_lacks_is_left_out_or_told(folder, in_this_process, capsys):
    (folder / "bare.py").write_text(BARE)
    (folder / "keys.py").write_text(KEYPOINTS)
    command = [
        "eval",
        "--tasks",
        "bare:Bare",
        "--methods",
        "neighbours",
        "--demos",
        "3",
        "--episodes",
        "1",
        "--out",
        "run",
    ]
    command += ["--keypoints", "keys:Middles"]
    assert main(command) == 2
    assert "has no demonstrate(), which is needed to record" in capsys.readouterr().err
    with DatasetWriter(folder / "data" / "bare-Bare", task="bare:Bare", description="", rate_hz=10.0) as writer:
        scenes = PlaceBlock()
        scenes.name, scenes.description = "bare:Bare", ""
        record(scenes, writer, 3)
    assert main(command) == 0
    (failure,) = read_results(Path("run")).failures
    assert (failure.stage, failure.demonstrator) == ("unknown", None)
    with pytest.raises(MissingMethodError, match="in closed loop"):
        require(make_task("bare:Bare"), "follow")


class WrongCamera(PlaceBlock):
    def reset(self, seed):
        seen = super().reset(seed)
        quarter = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0, 0, 0])
        return type(seen)(seen.rgb, seen.depth, seen.intrinsics, quarter @ seen.camera_pose)


class Millimetres(PlaceBlock):
    def reset(self, seed):
        seen = super().reset(seed)
        return type(seen)(seen.rgb, 1000 * seen.depth, seen.intrinsics, seen.camera_pose)


class Sky(PlaceBlock):
    def reset(self, seed):
        seen = super().reset(seed)
        depth = seen.depth.copy()
        depth[0] = 83.1
        return type(seen)(seen.rgb, depth, seen.intrinsics, seen.camera_pose)


class Random(PlaceBlock):
    count = 0

    def reset(self, seed):
        Random.count += 1
        return super().reset(Random.count)


class OneScene(PlaceBlock):
    def reset(self, seed):
        return super().reset(0)


class GoesOn(PlaceBlock):
    """`execute` goes on where the last one ended."""

    def execute(self, trajectory, on_frame=None):
        result = super().execute(trajectory)
        if result.success:
            self.places["block"] = self.places["base"] + 0.3
        return result


class AlwaysDone(PlaceBlock):
    def execute(self, trajectory, on_frame=None):
        return Execution(True)


class WrongRate(PlaceBlock):
    record_hz = 20.0

    def demonstrate(self, seed):
        self.record_hz = 10.0
        try:
            return super().demonstrate(seed)
        finally:
            self.record_hz = 20.0


class Crashes(PlaceBlock):
    def execute(self, trajectory, on_frame=None):
        raise ZeroDivisionError("the arm is in the table")


class ImageOnly(PlaceBlock):
    def reset(self, seed):
        return super().reset(seed).rgb


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        (WrongCamera, "check camera_pose"),
        (Millimetres, "check camera_pose and units"),
        (Sky, "it cannot be recorded: depth has values up to 83.1 m"),
        (Random, "draw everything from the seed"),
        (OneScene, "look the same"),
        (GoesOn, "start from the scene as reset drew it"),
        (AlwaysDone, "success must depend on the trajectory"),
        (WrongRate, "rate_hz of demonstrations is 10, record_hz 20"),
        (Crashes, "ZeroDivisionError: the arm is in the table"),
        (ImageOnly, "reset(0) must return Observation, got ndarray"),
    ],
)
def test_the_checks_name_what_is_wrong(kind, told):
    findings = check_task(made(kind))
    assert any(told in finding.message for finding in findings), findings
    assert not errors(check_task(made(PlaceBlock)))


def test_an_installed_package_registers_tasks_by_entry_points(folder):
    (folder / "lab_tasks.py").write_text("from robust_instant_policy.tasks.template import PlaceBlock as Pour\n")
    metadata = folder / "lab_tasks-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: lab-tasks\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[robust_instant_policy.tasks]\nlab/pour = lab_tasks:Pour\n")
    task = make_task("lab/pour")
    assert (task.name, task.description) == ("lab/pour", "Put the red block onto the blue base.")
    with pytest.raises(UsageError, match="lab/pour"):
        make_task("lab/stir")


@pytest.mark.parametrize(
    ("spec", "told"),
    [
        ("no_such_module:Task", "no module no_such_module"),
        ("robust_instant_policy.tasks.template:PlaceCup", "its classes: PlaceBlock"),
        ("robust_instant_policy.controller:Controller", "has no reset"),
    ],
)
def test_a_task_that_cannot_be_made_is_told_in_one_line(spec, told):
    with pytest.raises(UsageError, match=told):
        make_task(spec)
    with pytest.raises(UsageError, match="level"):
        make_task("robust_instant_policy.tasks.template:PlaceBlock", level="hard")


def test_no_code_is_run_because_a_dataset_names_it(folder):
    (folder / "trap.py").write_text("raise SystemExit('it ran')\n")
    scenes = PlaceBlock()
    scenes.name = "trap:Trap"
    with DatasetWriter(folder / "given", task="trap:Trap", description="", rate_hz=10.0) as writer:
        record(scenes, writer, 2)
    assert main(["keypoints", "--demos", "given"]) == 0
    assert "trap" not in sys.modules


class Given:
    """Keypoints whose results a test decides."""

    def __init__(self, found):
        self.found = found

    def locate(self, observation):
        return self.found(observation)


@pytest.mark.parametrize(
    ("found", "error", "told"),
    [
        (lambda _: np.full((2, 3), np.nan), KeypointError, r"do not find \[0, 1\] in demonstration 0"),
        (lambda _: np.zeros((2, 2)), InvalidValueError, r"must be \(K, 3\)"),
        (lambda _: (np.zeros((2, 3)), [0.5, 7.0]), InvalidValueError, r"in \[0, 1\], got \[0.5, 7.0\]"),
        (lambda _: (np.zeros((2, 3)), [0.5] * 3), InvalidValueError, r"must be \(2,\), got \(3,\)"),
        (lambda _: np.zeros((0, 3)), KeypointError, "give no point in demonstration 0"),
        (lambda _: load_class("camera", "nosuch:Camera"), UsageError, "^camera 'nosuch:Camera'"),  # an own error of rip
    ],
)
def test_keypoints_of_ones_own_that_break_their_contract_are_refused(found, error, told):
    task = made(PlaceBlock)
    shown = [task.demonstrate(seed).demonstration for seed in range(3)]
    with pytest.raises(error, match=told):
        Neighbours(keypoints=Given(found)).fit(shown)
    with pytest.raises(UsageError, match="unknown keypoints 3"):
        Neighbours(keypoints=3).fit(shown)
