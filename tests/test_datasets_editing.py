"""Demonstrations can be deleted, split and merged, and survive lerobot's own editor."""

import json

import numpy as np
import pytest

from robust_instant_policy import files
from robust_instant_policy.cli import main
from robust_instant_policy.datasets import DatasetWriter, card, load_demonstrations, load_frames
from robust_instant_policy.datasets.editing import delete, merge, restore, split
from robust_instant_policy.errors import DatasetError
from tests.datasets_samples import DESCRIPTION, RATE_HZ, TASK, demonstration, images


def record(path, seeds, with_images=True, description=DESCRIPTION, robot=None):
    with DatasetWriter(path, TASK, description, RATE_HZ, robot) as writer:
        writer.discard(7)
        for seed in seeds:
            writer.add(demonstration(seed, steps=20), images(seed, 20) if with_images else None)
    return path


def assert_holds(path, seeds, with_images=True):
    """The folder is what a writer would have recorded with these seeds, images bit by bit."""
    demos = load_demonstrations(path)
    assert [demo.seed for demo in demos] == list(seeds)
    for demo in demos:
        original = demonstration(demo.seed, steps=20)
        np.testing.assert_array_equal(demo.trajectory.actions, original.trajectory.actions.astype(np.float32))
        np.testing.assert_array_equal(demo.observation.rgb, original.observation.rgb)
        assert np.nanmax(np.abs(demo.observation.depth - original.observation.depth)) < 1e-4
        np.testing.assert_array_equal(demo.observation.camera_pose, original.observation.camera_pose)
        assert demo.info["manner"] == "slow – calm"
    if with_images:
        for episode, seed in enumerate(seeds):
            for frame, image in zip(load_frames(path, episode), images(seed, 20), strict=True):
                assert np.abs(frame.astype(int) - image).mean() < 3


def test_deleted_split_and_merged_folders_are_as_if_recorded_so(tmp_path):
    whole = record(tmp_path / "whole", (0, 1, 2))
    assert delete(whole, [1], tmp_path / "deleted") == 2
    assert_holds(tmp_path / "deleted", (0, 2))
    split(whole, [1, 2], [tmp_path / "a", tmp_path / "b"])
    assert_holds(tmp_path / "a", (0,))
    assert merge([tmp_path / "b", tmp_path / "a"], tmp_path / "merged") == 3
    assert_holds(tmp_path / "merged", (1, 2, 0))
    recorded = record(tmp_path / "recorded", (1, 2, 0))
    assert not (tmp_path / "merged/meta/calibration.json").exists()  # the camera differs between the episodes
    alone = record(tmp_path / "alone", (0,))
    calibrations = [(folder / "meta/calibration.json").read_bytes() for folder in (tmp_path / "a", alone)]
    assert calibrations[0] == calibrations[1]
    for file in ("meta/info.json", "meta/stats.json", "meta/tasks.parquet", "README.md"):
        theirs, ours = ((folder / file).read_bytes() for folder in (tmp_path / "merged", recorded))
        if file.endswith("json"):
            flat = (
                np.concatenate([np.ravel(v) for e in json.loads(x).values() for v in _numbers(e)])
                for x in (theirs, ours)
            )
            np.testing.assert_allclose(*flat)
        else:
            assert theirs == ours
    with DatasetWriter(tmp_path / "merged", TASK, DESCRIPTION, RATE_HZ) as writer:  # recording goes on
        assert (writer.num_episodes, writer.discarded) == (3, 2)
        writer.add(demonstration(5, steps=20), images(5, 20))
    assert_holds(tmp_path / "merged", (1, 2, 0, 5))


def _numbers(entry):
    if isinstance(entry, dict):
        return [number for value in entry.values() for number in _numbers(value)]
    return [np.asarray(entry, dtype=float)] if isinstance(entry, int | float | list) and _is_numbers(entry) else []


def _is_numbers(entry):
    return np.asarray(entry).dtype.kind in "if"


@pytest.mark.parametrize(
    ("name", "seeds", "with_images"),
    [("deleted", (0, 2), True), ("merged", (0, 1, 2, 0, 2), True), ("removed", (0, 1, 2), False)],
)
def test_what_lerobot_has_edited_is_completed_from_the_original(lerobot_files, tmp_path, name, seeds, with_images):
    with pytest.raises(DatasetError, match="rip demos restore"):
        load_demonstrations(lerobot_files / name)
    assert restore(lerobot_files / name, [lerobot_files / "ours"], tmp_path / "out") == len(seeds)
    assert_holds(tmp_path / "out", seeds, with_images)
    assert (load_demonstrations(tmp_path / "out")[0].frames is not None) == with_images


def test_a_task_renamed_by_lerobot_is_kept(lerobot_files, tmp_path):
    assert_holds(lerobot_files / "tasks", (0, 1, 2))  # edited in place, and still complete
    restore(lerobot_files / "tasks", [lerobot_files / "ours"], tmp_path / "out")
    assert json.loads((tmp_path / "out/meta/rip.json").read_text())["description"] == "push it gently"


def test_what_cannot_be_edited_is_said_and_nothing_is_overwritten(lerobot_files, tmp_path):
    whole = record(tmp_path / "whole", (0, 1), with_images=False)
    for match, action in (
        ("0 to 1, not 5", lambda: delete(whole, [5], tmp_path / "out")),
        ("nothing", lambda: delete(whole, [0, 1], tmp_path / "out")),
        ("sum", lambda: split(whole, [1, 2], [tmp_path / "out", tmp_path / "out2"])),
        ("exists already", lambda: delete(whole, [0], whole)),
        ("exists already", lambda: delete(whole, [0], tmp_path / "absent" / ".." / "whole")),
        ("exists already", lambda: split(whole, [1, 1], [tmp_path / "out", tmp_path / "absent" / ".." / "whole"])),
        ("different", lambda: split(whole, [1, 1], [tmp_path / "out", tmp_path / "out"])),
        ("different", lambda: split(whole, [1, 1], [tmp_path / "out", tmp_path / "out" / "inner"])),
        ("inside", lambda: delete(whole, [0], whole / "inner")),
        ("cannot write", lambda: delete(whole, [0], "/proc/no/folder")),
        ("twice", lambda: merge([whole, tmp_path / "absent" / ".." / "whole"], tmp_path / "out")),
        ("description", lambda: merge([whole, record(tmp_path / "words", [3], False, "push")], tmp_path / "out")),
        ("robot_type", lambda: merge([whole, record(tmp_path / "ur", [3], False, robot="ur5e")], tmp_path / "out")),
        ("features", lambda: merge([whole, lerobot_files / "ours"], tmp_path / "out")),
        ("restore it first", lambda: merge([lerobot_files / "deleted"], tmp_path / "out")),
        ("in none of", lambda: restore(lerobot_files / "merged", [record(tmp_path / "other", [9])], tmp_path / "out")),
    ):
        with pytest.raises(DatasetError, match=match):
            action()
    assert_holds(whole, (0, 1), with_images=False)
    assert not (tmp_path / "out").exists()


def test_an_interrupted_edit_leaves_nothing_behind_and_can_be_repeated(tmp_path, monkeypatch):
    whole = record(tmp_path / "whole", (0, 1, 2), with_images=False)
    (whole / "start" / ".DS_Store").touch()  # as file browsers leave it
    outs, pressed = [tmp_path / "a", tmp_path / "b"], []

    def press(path, content, write=files.write_whole):
        write(path, content)
        if not pressed and path.name == "info.json":  # the first part is complete
            pressed.append(path)
            raise KeyboardInterrupt

    monkeypatch.setattr(card, "write_whole", press)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(KeyboardInterrupt):
        split(whole, [1, 2], outs)
    assert sorted(tmp_path.iterdir()) == before
    split(whole, [1, 2], outs)
    assert_holds(outs[0], (0,), with_images=False)
    assert_holds(outs[1], (1, 2), with_images=False)


def test_a_missing_start_image_is_named(tmp_path):
    whole = record(tmp_path / "whole", (0, 1), with_images=False)
    (whole / "start/depth/chunk-000/file-001.png").unlink()
    with pytest.raises(DatasetError, match=r"depth/chunk-000/file-001\.png is missing"):
        delete(whole, [0], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_command_edits_folders(lerobot_files, tmp_path, capsys):
    ours, out = str(lerobot_files / "ours"), [str(tmp_path / name) for name in "abcde"]
    assert main(["demos", "delete", ours, "--episodes", "0", "--out", out[0]]) == 0
    assert main(["demos", "split", ours, "--sizes", "2", "1", "--out", out[1], out[2]]) == 0
    assert main(["demos", "merge", out[1], out[2], "--out", out[3]]) == 0
    assert main(["demos", "restore", str(lerobot_files / "deleted"), "--from", ours, "--out", out[4]]) == 0
    assert f"{out[3]}: 3 demonstrations" in capsys.readouterr().out
    assert_holds(tmp_path / "d", (0, 1, 2))
