"""Files from anywhere: nothing outside the folder is read, nothing hangs, and what is wrong is said in one line."""

import io
import json
import os
import zipfile
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from robust_instant_policy.datasets import DatasetWriter, load_demonstrations, load_frames
from robust_instant_policy.datasets.importers import Rig, import_demonstrations
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import DatasetError, InvalidValueError
from robust_instant_policy.geometry import GripperTriangle
from robust_instant_policy.policies.policy import Plan
from tests.datasets_samples import DESCRIPTION, RATE_HZ, TASK, demonstration, observation
from tests.fuzz_targets import damaged_folder, foreign_files, recorded_files

FILES = (
    "meta/info.json",
    "meta/rip.json",
    "meta/episodes/chunk-000/file-000.parquet",
    "data/chunk-000/file-001.parquet",
    "start/rgb/chunk-000/file-000.png",
    "start/depth/chunk-000/file-001.png",
)
VIDEO = "videos/observation.images.top/chunk-000/file-000.mp4"


def refusal(action, *arguments, **options):
    with pytest.raises(DatasetError) as caught:
        action(*arguments, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.fixture
def folder():
    with damaged_folder(recorded_files(), b"remove meta/stats.json\n") as path:
        yield path


def change_info(folder: Path, **changes) -> None:
    info = json.loads((folder / "meta/info.json").read_text())
    (folder / "meta/info.json").write_text(json.dumps(info | changes))


@pytest.mark.parametrize(
    "template",
    [
        "../outside/file-{file_index:03d}.parquet",
        "data/../../outside/file-{file_index:03d}.parquet",
        "{chunk_index.__class__}/{file_index}",
        "data/{chunk_index:2000000000d}/{file_index}",
        "data/{chunk_index:{file_index}}",
        "data/{chunk_index!r}",
        "data/{}",
        "data/{episode}",
        "data/{chunk_index",
    ],
)
def test_a_path_template_stays_inside_the_folder_and_holds_the_known_fields_only(folder, template):
    outside = folder.parent / "outside"
    outside.mkdir()
    for file in (folder / "data/chunk-000").iterdir():
        (outside / file.name).write_bytes(file.read_bytes())
    assert len(load_demonstrations(folder)) == 2
    change_info(folder, data_path=template)
    assert "template" in (message := refusal(load_demonstrations, folder)) or "outside of itself" in message
    change_info(folder, data_path=f"{outside}/file-{{file_index:03d}}.parquet")
    assert "outside of itself" in refusal(load_demonstrations, folder)


@pytest.mark.parametrize("file", [*FILES, VIDEO])
@pytest.mark.parametrize("kind", ["pipe", "socket", "folder", "device", "outside", "loop"])
def test_only_regular_files_of_the_folder_are_opened(kind, file):
    with damaged_folder(recorded_files(), f"{kind} {file}\n".encode()) as folder:
        message = refusal(lambda: [list(one.frames()) for one in load_demonstrations(folder)])
        said = {"outside": "cp -rL", "device": "outside of itself", "loop": "cannot "}  # be followed, or read
        if not (kind == "loop" and file.startswith("meta/")):  # such a link is not there at all
            assert said.get(kind, "not a regular file") in message


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("total_episodes", "2", "total_episodes must be a whole number"),
        ("total_episodes", 1e30, "total_episodes must be a whole number"),
        ("total_episodes", 10**12, "total_episodes must be a whole number"),
        ("total_episodes", -1, "total_episodes must be a whole number"),
        ("total_episodes", 3, "lists 2 of 3 episodes"),
        ("fps", 0, "fps must be a positive number"),
        ("fps", -20, "fps must be a positive number"),
        ("fps", float("nan"), "fps must be a positive number"),
        ("fps", "fast", "fps must be a positive number"),
        ("features", [], "features must be an object"),
        ("features", {"action": 3}, "'action' must have a dtype"),
        ("features", {"action": {"dtype": "float32", "shape": [10**9, 10**9]}}, "'action' must have a shape"),
        ("data_path", 7, "data_path must be a path template"),
        ("codebase_version", None, "v3.0 is needed"),
    ],
)
def test_an_entry_of_the_wrong_type_or_range_is_named(folder, name, value, words):
    change_info(folder, **{name: value})
    assert words in refusal(load_demonstrations, folder)


def test_more_episodes_than_are_counted_are_told(tmp_path):
    with DatasetWriter(tmp_path, task=TASK, description=DESCRIPTION, rate_hz=RATE_HZ) as writer:
        for seed in range(4):
            writer.add(demonstration(seed))
    change_info(tmp_path, total_episodes=3)  # the writer was killed before it finished the fourth
    assert len(load_demonstrations(tmp_path)) == 3
    change_info(tmp_path, total_episodes=2)
    assert "counts 2 episodes, meta/episodes lists more" in refusal(load_demonstrations, tmp_path)


def test_deep_json_is_refused(folder):
    (folder / "meta/info.json").write_text("[" * 100_000)
    assert "info.json" in refusal(load_demonstrations, folder)
    (folder / "plan.json").write_text('{"a":' * 100_000)
    assert "plan.json" in refusal(Plan.load, folder / "plan.json")


def test_a_playlist_in_place_of_a_video_opens_nothing(folder):
    real = (folder / VIDEO).read_bytes()
    (folder / "other.mp4").write_bytes(real)
    (folder / VIDEO).write_text(f"ffconcat version 1.0\nfile {folder / 'other.mp4'}\n")
    assert "cannot be read as a video" in refusal(lambda: list(load_frames(folder, 0)))


def test_a_writer_never_follows_a_link_out_of_its_folder(folder):
    outside = folder.parent / "outside"
    (folder / "data").rename(outside)
    (outside / "chunk-000/file-002.parquet").write_bytes(b"mine")  # numbered like the next episode
    (folder / "data").symlink_to(outside)
    assert "outside of itself" in refusal(DatasetWriter, folder, "push-cube", "push", 20.0)
    assert (outside / "chunk-000/file-002.parquet").read_bytes() == b"mine"


def saved(path: Path, **changes) -> Path:
    seen = observation(0)
    arrays = {name: getattr(seen, name) for name in ("rgb", "depth", "intrinsics", "camera_pose")}
    np.savez(path, **(arrays | changes))
    return path


def test_an_observation_that_declares_more_than_it_holds_costs_no_memory(tmp_path):
    path = saved(tmp_path / "observation.npz")
    lie = b"{'descr': '|u1', 'fortran_order': False, 'shape': (1000000000000,), }\n"
    content = io.BytesIO()
    with zipfile.ZipFile(path) as real, zipfile.ZipFile(content, "w") as archive:
        for name in real.namelist():
            array = b"\x93NUMPY\x01\x00" + len(lie).to_bytes(2, "little") + lie
            archive.writestr(name, array if name == "rgb.npy" else real.read(name))
    path.write_bytes(content.getvalue())
    assert "1000000000000" in refusal(Observation.load, path)


def test_an_observation_holds_numbers_only_and_nothing_is_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "sprung"),)

    assert "real numbers" in refusal(Observation.load, saved(tmp_path / "a.npz", rgb=np.array([Trap()], dtype=object)))
    assert not (tmp_path / "sprung").exists()
    assert "real numbers" in refusal(Observation.load, saved(tmp_path / "b.npz", depth=np.zeros((48, 64), complex)))
    os.mkfifo(tmp_path / "c.npz")
    assert "named pipe" in refusal(Observation.load, tmp_path / "c.npz")
    assert "device" in refusal(Observation.load, "/dev/zero")
    assert "device" in refusal(Plan.load, "/dev/zero")


@pytest.mark.parametrize(
    ("intrinsics", "words"),
    [
        ([[0, 0, 32], [0, 80, 24], [0, 0, 1]], "focal"),
        ([[80, 0, 32], [0, -80, 24], [0, 0, 1]], "focal"),
        ([[80, 0, 0], [0, 80, 0], [32, 24, 1]], "transposed"),
        ([[80, 0, 32], [0, 80, 24], [0, 0, 2]], "last row"),
        ([[80, 9, 32], [0, 80, 24], [0, 0, 1]], "skew"),
        ([[800, 0, 640], [0, 800, 360], [0, 0, 1]], "resolution"),
        ([[80, 0, np.nan], [0, 80, 24], [0, 0, 1]], "finite"),
        ([["80", "0", "32"]] * 3, "numbers"),
    ],
)
def test_intrinsics_of_no_pinhole_camera_are_refused(intrinsics, words):
    with pytest.raises(InvalidValueError, match=words):
        replace(observation(0), intrinsics=intrinsics)


def test_infinite_and_negative_depth_is_no_reading():
    seen = observation(0)
    depth = seen.depth.copy()
    depth[5, :3] = [np.inf, -np.inf, -1]
    kept = replace(seen, depth=depth).depth
    assert np.isnan(kept[5, :3]).all()
    np.testing.assert_array_equal(kept[6:], seen.depth[6:])


@pytest.mark.parametrize("rate", [0, -20.0, np.nan, np.inf, "20", None, True])
def test_a_demonstration_has_a_rate(rate):
    with pytest.raises(InvalidValueError, match="rate_hz"):
        replace(demonstration(0), rate_hz=rate)


def test_a_recording_that_leads_into_other_files_is_refused(tmp_path):
    rig = Rig(GripperTriangle(0.1, 0.08))
    path = tmp_path / "lift.hdf5"
    path.write_bytes(foreign_files()["robomimic.hdf5"])
    assert len(import_demonstrations(path, "lift", rig)) == 1
    with h5py.File(tmp_path / "secret.hdf5", "w") as secret:
        secret["actions"] = np.zeros((6, 7))
    name = "data/demo_0/actions"
    with h5py.File(path, "r+") as file:
        del file[name]
        file[name] = h5py.ExternalLink("secret.hdf5", "actions")
    assert "link" in refusal(import_demonstrations, path, "lift", rig)
    with h5py.File(path, "r+") as file:
        del file[name]
        layout = h5py.VirtualLayout((6, 7), "f8")
        layout[:] = h5py.VirtualSource(tmp_path / "secret.hdf5", "actions", (6, 7))
        file.create_virtual_dataset(name, layout)
    assert "another file" in refusal(import_demonstrations, path, "lift", rig)
    with h5py.File(path, "r+") as file:
        del file[name]
        file.create_dataset(name, (10**6, 10**6), "f8", chunks=True)
    assert "GiB" in refusal(import_demonstrations, path, "lift", rig)


def test_a_file_that_cannot_be_opened_is_told_as_such_and_not_as_damaged(tmp_path):
    loop = tmp_path / "loop.npz"
    loop.symlink_to(loop)  # also root, who may read everything, cannot open it
    told = refusal(Observation.load, loop)
    assert "cannot read" in told
    assert "not an .npz" not in told
