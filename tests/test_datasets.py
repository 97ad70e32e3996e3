"""Demonstrations come back from the disk as they were, and a folder that is wrong is told in one line."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from robust_instant_policy.datasets import DatasetWriter, VideoWriter, load_demonstrations, load_frames
from robust_instant_policy.datasets.images import encode_depth, millimetres, read_depth
from robust_instant_policy.datasets.video import encode_video
from robust_instant_policy.errors import DatasetError, InvalidValueError, NoDemonstrationsError
from robust_instant_policy.trajectory import Trajectory
from tests.datasets_samples import DESCRIPTION, RATE_HZ, TASK, demonstration, images, with_task


def writer_of(path, task=TASK, rate_hz=RATE_HZ):
    return DatasetWriter(path, task=task, description=DESCRIPTION, rate_hz=rate_hz)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Three recorded episodes with images."""
    path = tmp_path_factory.mktemp("recorded") / "push-cube"
    with writer_of(path) as writer:
        for seed in (4, 5, 7):
            writer.add(demonstration(seed, steps=30 + seed), images(seed, steps=30 + seed))
        writer.discard(6)
    return path


@pytest.fixture
def folder(recorded, tmp_path):
    """A copy to read, continue or damage."""
    return Path(shutil.copytree(recorded, tmp_path / "push-cube"))


def refusal(action, *arguments, **options):
    with pytest.raises(DatasetError) as caught:
        action(*arguments, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_a_demonstration_comes_back_as_it_was(folder):
    for seed, back in zip((4, 5, 7), load_demonstrations(folder, task=TASK), strict=True):
        original = demonstration(seed, steps=30 + seed)
        np.testing.assert_array_equal(back.trajectory.actions, original.trajectory.actions.astype(np.float32))
        np.testing.assert_array_equal(back.observation.rgb, original.observation.rgb)
        np.testing.assert_array_equal(back.observation.intrinsics, original.observation.intrinsics)
        np.testing.assert_array_equal(back.observation.camera_pose, original.observation.camera_pose)
        assert (back.rate_hz, back.task, back.seed, back.info) == (RATE_HZ, TASK, seed, original.info)
        seen = original.observation.depth > 0
        np.testing.assert_array_equal(np.isnan(back.observation.depth), ~seen)
        assert np.abs(back.observation.depth - original.observation.depth)[seen].max() < 0.6e-4


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    depth=hnp.arrays(
        np.float32,
        (4, 5),
        elements=st.one_of(st.floats(2**-10, 60, width=32), st.sampled_from([np.nan, np.inf, -np.inf, 0.0, -1.0])),
    )
)
def test_depth_comes_back_to_the_millimetre_and_no_reading_as_none(tmp_path, depth):
    png, unit = encode_depth(depth)
    (tmp_path / "depth.png").write_bytes(png)
    back = read_depth(tmp_path / "depth.png", unit)
    seen = np.isfinite(depth) & (depth > 0)
    np.testing.assert_array_equal(np.isfinite(back), seen)
    assert (np.abs(back - depth)[seen] <= (0.6e-3 if depth[seen].max(initial=0) > 6.5 else 0.06e-3)).all()


def test_whole_millimetres_are_none_where_there_is_no_reading_or_none_that_fits():
    depth = np.array([[0.0004, 0.4996, 65.535], [65.536, -1.0, np.nan], [np.inf, -np.inf, 1e30]], dtype=np.float32)
    np.testing.assert_array_equal(millimetres(depth), [[0, 500, 65535], [0, 0, 0], [0, 0, 0]])


def test_depth_too_far_for_the_millimetre_is_refused_before_anything_is_written(tmp_path):
    demo = demonstration(0)
    far = replace(demo.observation, depth=np.full_like(demo.observation.depth, 70.0))
    with writer_of(tmp_path / "d") as writer:
        assert "65.5 m" in refusal(writer.add, replace(demo, observation=far))
        assert writer.num_episodes == 0
        writer.add(demo)
    assert len(load_demonstrations(tmp_path / "d")) == 1


def test_images_along_the_way_come_back_in_step_with_the_trajectory(folder):
    frames = np.stack(list(load_frames(folder, 1)))
    expected = images(5, steps=35)
    assert frames.shape == expected.shape
    assert np.abs(frames.astype(int) - expected).mean() < 3
    nearest = [np.abs(frame.astype(int) - expected).mean(axis=(1, 2, 3)).argmin() for frame in frames]
    assert nearest == list(range(35))


def test_limit_takes_the_first_ones(folder):
    assert [demo.seed for demo in load_demonstrations(folder, limit=2)] == [4, 5]
    assert [demo.seed for demo in load_demonstrations(folder, limit=9)] == [4, 5, 7]


def test_a_second_writer_goes_on_where_the_first_one_stopped(folder):
    before = (folder / "data/chunk-000/file-000.parquet").read_bytes()
    with writer_of(folder) as writer:
        assert (writer.num_episodes, writer.last_seed, writer.discarded) == (3, 7, 1)
        writer.discard(8)
        assert writer.last_seed == 8
        writer.add(demonstration(9), images(9))
    assert [demo.seed for demo in load_demonstrations(folder)] == [4, 5, 7, 9]
    assert (folder / "data/chunk-000/file-000.parquet").read_bytes() == before
    with writer_of(folder) as writer:
        assert (writer.num_episodes, writer.last_seed, writer.discarded) == (4, 9, 2)


def test_recording_in_one_go_or_in_two_leaves_identical_folders(tmp_path):
    with writer_of(tmp_path / "one") as writer:
        for seed in range(3):
            writer.add(demonstration(seed), images(seed))
    for seed in range(3):
        with writer_of(tmp_path / "two") as writer:
            writer.add(demonstration(seed), images(seed))
    files = sorted(file.relative_to(tmp_path / "one") for file in (tmp_path / "one").rglob("*") if file.is_file())
    assert len(files) > 12
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes(), file


def test_other_programs_find_robot_calibration_card_and_measured_gripper(tmp_path):
    shown = demonstration(4, steps=30)
    measured = shown.trajectory.gripper_state * 0.6
    with DatasetWriter(tmp_path / "d", TASK, DESCRIPTION, RATE_HZ, robot_type="ur5e_hande") as writer:
        writer.add(shown, grippers=measured)
        assert "must be (30, 1)" in refusal(writer.add, shown, grippers=measured[:5])
    with writer_of(tmp_path / "d") as writer:  # goes on with the same robot
        writer.add(shown)
    info = json.loads((tmp_path / "d/meta/info.json").read_text())
    assert info["robot_type"] == "ur5e_hande"
    card = (tmp_path / "d/README.md").read_text()
    assert card.startswith("---\n")
    assert "2 demonstrations, 60 steps" in card
    (camera,) = json.loads((tmp_path / "d/meta/calibration.json").read_text()).values()
    assert camera["intrinsics"]["fx"] == shown.observation.intrinsics[0, 0]
    assert camera["extrinsics"] == shown.observation.camera_pose.ravel().tolist()
    table = pq.read_table(tmp_path / "d/data/chunk-000/file-000.parquet")
    state, action = (np.array(table[key].to_pylist()) for key in ("observation.state", "action"))
    np.testing.assert_allclose(state[:, 9], measured[:, 0], atol=1e-6)
    np.testing.assert_array_equal(state[:, :9], action[:, :9])
    moved = shown.observation.camera_pose.copy()
    moved[0, 3] += 0.01
    with writer_of(tmp_path / "d") as writer:
        writer.add(replace(shown, observation=replace(shown.observation, camera_pose=moved)))
    assert not (tmp_path / "d/meta/calibration.json").exists()  # no one calibration is right for all


def test_a_folder_that_was_recorded_anew_is_read_anew(tmp_path):
    for seed in (1, 2):
        shutil.rmtree(tmp_path / "d", ignore_errors=True)
        with writer_of(tmp_path / "d") as writer:
            writer.add(demonstration(seed))
        (back,) = load_demonstrations(tmp_path / "d")
        np.testing.assert_allclose(back.trajectory.actions, demonstration(seed).trajectory.actions, atol=1e-6)


def test_the_same_images_always_make_the_same_video():
    film = images(0)
    assert len({encode_video(film, RATE_HZ) for _ in range(80)}) == 1


def test_episodes_need_no_seed_and_no_images_and_may_have_two_arms(tmp_path):
    with writer_of(tmp_path / "d") as writer:
        writer.add(demonstration(None, arms=2))
        writer.add(demonstration(3, arms=2))
        assert writer.last_seed == 3
    demos = load_demonstrations(tmp_path / "d")
    assert [demo.seed for demo in demos] == [None, 3]
    assert demos[0].trajectory.num_arms == 2
    assert "without images" in refusal(load_frames, tmp_path / "d", 0)


def test_two_processes_cannot_record_into_one_folder(folder):
    with writer_of(folder):
        assert "another process" in refusal(writer_of, folder)
    writer_of(folder).close()


def test_what_a_folder_cannot_hold_is_refused_and_leaves_it_whole(folder):
    demo = demonstration(8)
    with writer_of(folder) as writer:
        assert "'turn-faucet'" in refusal(writer.add, with_task(demo, "turn-faucet"), images(8))
        assert "20.0" in refusal(writer.add, replace(demo, rate_hz=20.0), images(8))
        assert "absent" in refusal(writer.add, demo)
        assert "(39, 48, 64, 3)" in refusal(writer.add, demo, images(8)[1:])
        assert "[10]" in refusal(writer.add, demonstration(8, arms=2), images(8))
        assert "[48, 64, 3]" in refusal(writer.add, demo, images(8)[:, 4:])
        uneven = Trajectory(demo.trajectory.actions, np.linspace(0, 1, 40) ** 2)
        assert "evenly" in refusal(writer.add, replace(demo, trajectory=uneven), images(8))
    assert "closed" in refusal(writer.add, demo, images(8))
    assert len(load_demonstrations(folder)) == 3


def test_a_missing_or_empty_folder_says_how_to_record(tmp_path):
    for path in (tmp_path / "nowhere", tmp_path):
        message = refusal(load_demonstrations, path, task=TASK)
        assert str(path) in message
        assert f"rip record --task {TASK} --episodes 10 --out {path}" in message


def test_a_folder_of_another_task_names_both(folder):
    message = refusal(load_demonstrations, folder, task="turn-faucet")
    assert "'push-cube'" in message
    assert "'turn-faucet'" in message
    message = refusal(writer_of, folder, task="turn-faucet")
    assert "'push-cube'" in message
    assert "'turn-faucet'" in message
    assert "55.0" in refusal(writer_of, folder, rate_hz=20)


def test_zero_demonstrations_are_refused(folder, tmp_path):
    assert "at least one" in refusal(load_demonstrations, folder, limit=0)
    writer_of(tmp_path / "begun").close()
    assert "no finished demonstration" in refusal(load_demonstrations, tmp_path / "begun")


def test_only_a_folder_in_which_nothing_was_recorded_invites_recording(folder, tmp_path):
    writer_of(tmp_path / "begun").close()
    (tmp_path / "empty").mkdir()
    for name in ("begun", "empty", "missing"):
        with pytest.raises(NoDemonstrationsError):
            load_demonstrations(tmp_path / name)
    (folder / "data/chunk-000/file-000.parquet").unlink()
    with pytest.raises(DatasetError) as caught:
        load_demonstrations(folder)
    assert not isinstance(caught.value, NoDemonstrationsError)


def test_a_folder_that_lost_its_info_is_not_called_unfinished(folder):
    (folder / "meta/info.json").unlink()
    assert "has lost meta/info.json, which describes its 3 episodes; restore it" in refusal(load_demonstrations, folder)


@pytest.mark.parametrize(
    "file",
    [
        "meta/info.json",
        "meta/rip.json",
        "meta/episodes/chunk-000/file-001.parquet",
        "data/chunk-000/file-002.parquet",
        "start/rgb/chunk-000/file-000.png",
        "start/depth/chunk-000/file-001.png",
    ],
)
@pytest.mark.parametrize("damage", ["cut short", "empty", "missing"])
def test_a_damaged_file_is_named(folder, file, damage):
    if damage == "missing":
        (folder / file).unlink()
    else:
        content = (folder / file).read_bytes()
        (folder / file).write_bytes(content[: len(content) // 2] if damage == "cut short" else b"")
    message = refusal(load_demonstrations, folder)
    if not (damage == "missing" and file.startswith("meta/")):  # these say what the folder then is
        assert str(folder / file) in message


def test_a_damaged_video_is_named(folder):
    file = folder / "videos/observation.images.top/chunk-000/file-000.mp4"
    file.write_bytes(file.read_bytes()[:500])
    assert str(file) in refusal(lambda: list(load_frames(folder, 0)))
    file.unlink()
    assert str(file) in refusal(lambda: list(load_frames(folder, 0)))
    assert "no episode 3" in refusal(load_frames, folder, 3)


def test_values_that_are_not_finite_are_told_with_their_episode(folder):
    file = folder / "data/chunk-000/file-001.parquet"
    table = pq.read_table(file)
    broken = pa.array([[np.nan] * 10] * len(table), pa.list_(pa.float32(), 10))
    pq.write_table(table.set_column(table.column_names.index("action"), "action", broken), file)
    assert "episode 1" in refusal(load_demonstrations, folder)


def test_an_older_format_says_how_to_convert_it(folder):
    info = json.loads((folder / "meta/info.json").read_text())
    (folder / "meta/info.json").write_text(json.dumps(info | {"codebase_version": "v2.1"}))
    message = refusal(load_demonstrations, folder)
    assert "v2.1" in message
    assert "convert_dataset_v21_to_v30" in message


def test_a_dataset_without_start_depth_says_what_is_missing(folder):
    (folder / "meta/rip.json").unlink()
    assert "start-of-episode depth" in refusal(load_demonstrations, folder)


def test_a_folder_with_other_files_is_never_written_to(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    assert "thesis.tex" in refusal(writer_of, tmp_path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["thesis.tex"]


def test_a_video_without_images_leaves_no_file_and_odd_images_are_refused(tmp_path):
    (tmp_path / "none.mp4").write_bytes(b"of the run before")
    with VideoWriter(tmp_path / "none.mp4", fps=20):
        pass
    assert not (tmp_path / "none.mp4").exists()
    with VideoWriter(tmp_path / "run.mp4", fps=20) as video:
        with pytest.raises(InvalidValueError, match="even"):
            video.add(np.zeros((31, 40, 3), np.uint8))
        video.add(np.zeros((32, 40, 3), np.uint8))
        with pytest.raises(InvalidValueError, match="of one size"):
            video.add(np.zeros((32, 42, 3), np.uint8))
    assert (tmp_path / "run.mp4").stat().st_size > 100
