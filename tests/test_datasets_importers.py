"""Recordings of others become demonstrations, and what they lack is said."""

import json
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from robust_instant_policy.cli import main
from robust_instant_policy.datasets import DatasetWriter, coded_depth, load_demonstrations, load_frames
from robust_instant_policy.datasets.importers import (
    GripperCommand,
    JointModel,
    Rig,
    convert_demonstrations,
    import_demonstrations,
)
from robust_instant_policy.datasets.importers.rig_file import read_rig
from robust_instant_policy.datasets.video import encode_video
from robust_instant_policy.errors import DatasetError, InvalidValueError
from robust_instant_policy.geometry import GripperTriangle, lift, make_pose, project
from tests.datasets_samples import DESCRIPTION, RATE_HZ, TASK, demonstration, images, observation

TRIANGLE = GripperTriangle(length=0.1, opening=0.08)
TOOL = np.eye(4)


def refusal(action, *arguments):
    with pytest.raises(DatasetError) as caught:
        action(*arguments)
    message = str(caught.value)
    assert "\n" not in message
    return message


# ---- ManiSkill: a real environment, recorded by ManiSkill's own wrapper


@pytest.fixture(scope="module")
def maniskill(tmp_path_factory):
    """A trajectory file of ManiSkill's PushCube with a Panda, and what the simulator itself knew."""
    gym = pytest.importorskip("gymnasium")
    pytest.importorskip("mani_skill.envs")
    from mani_skill.utils.wrappers.record import RecordEpisode

    folder = tmp_path_factory.mktemp("maniskill")
    environment = RecordEpisode(
        gym.make(
            "PushCube-v1",
            obs_mode="rgbd",
            control_mode="pd_ee_delta_pose",
            sim_backend="physx_cpu",
            render_backend="cpu",
            sensor_configs={"width": 64, "height": 48},
        ),
        str(folder),
        save_video=False,
        trajectory_name="trajectory",
    )
    inner = environment.unwrapped
    truth = []
    for seed in (3, 4, 5):
        environment.reset(seed=seed)
        fingers = inner.agent.finger1_link.pose.p[0] - inner.agent.finger2_link.pose.p[0]
        truth.append({"tips": fingers.numpy(), "cube": inner.obj.pose.p[0].numpy(), "tcp": []})
        for step in range(6):
            truth[-1]["tcp"].append(inner.agent.tcp.pose.to_transformation_matrix()[0].numpy())
            environment.step(np.array([0.3, 0.1, -0.2, 0.1, 0.2, 0.3, 1.0 if step < 4 else -1.0]))
        truth[-1]["tcp"].append(inner.agent.tcp.pose.to_transformation_matrix()[0].numpy())
    environment.close()
    # Such short motions solve nothing; let the first and the last one count as successes.
    file = folder / "trajectory.json"
    described = json.loads(file.read_text())
    for episode in described["episodes"]:
        episode["success"] = episode["episode_id"] != 1
    file.write_text(json.dumps(described))
    return folder / "trajectory.h5", [truth[0], truth[2]]


def test_maniskill_trajectories_become_demonstrations(maniskill):
    path, truth = maniskill
    demos = import_demonstrations(path, TASK, Rig(TRIANGLE, rate_hz=20.0))
    assert len(demos) == 2  # the failed one is not a demonstration
    for demo, known in zip(demos, truth, strict=True):
        poses = TRIANGLE.poses(demo.trajectory.triplets[:, 0])
        np.testing.assert_allclose(poses, known["tcp"], atol=1e-4)
        np.testing.assert_array_equal(demo.trajectory.gripper_state[:, 0], [0, 0, 0, 0, 1, 1, 1])
        # The fingers open along the tool frame's y, as the triangle takes it.
        tips = known["tips"] / np.linalg.norm(known["tips"])
        assert abs(tips @ poses[0, :3, 1]) > 0.999
        assert (demo.rate_hz, demo.task) == (20.0, TASK)


def test_maniskill_depth_and_camera_show_the_cube_where_it_is(maniskill):
    path, truth = maniskill
    for demo, known in zip(import_demonstrations(path, TASK, Rig(TRIANGLE, rate_hz=20.0)), truth, strict=True):
        seen = demo.observation
        pixel = project(known["cube"], seen.intrinsics, seen.camera_pose)
        column, row = np.round(pixel).astype(int)
        point = lift(pixel, seen.depth[row, column], seen.intrinsics, seen.camera_pose)
        assert np.linalg.norm(point - known["cube"]) < 0.04  # the cube is 4 cm wide, and its surface is seen


def test_maniskill_files_convert_to_a_folder_with_images_along_the_way(maniskill, tmp_path):
    path, _ = maniskill
    for _ in range(2):  # the second call finds everything there
        assert convert_demonstrations(path, tmp_path / "out", TASK, DESCRIPTION, Rig(TRIANGLE, rate_hz=20.0)) == 2
    demos = load_demonstrations(tmp_path / "out", task=TASK)
    assert [demo.info["source_seed"] for demo in demos] == ["3", "5"]
    assert len(list(load_frames(tmp_path / "out", 1))) == len(demos[1].trajectory)


def test_what_a_maniskill_file_lacks_is_said(maniskill, tmp_path):
    path, _ = maniskill
    message = refusal(import_demonstrations, path, TASK, Rig(TRIANGLE))
    assert "recording rate" in message
    assert "depth" not in message
    bare = tmp_path / "bare.h5"
    with h5py.File(path) as whole, h5py.File(bare, "w") as file:
        file.create_dataset("traj_0/actions", data=whole["traj_0/actions"])
        file.create_group("traj_2")
    bare.with_suffix(".json").write_text(path.with_suffix(".json").read_text())
    message = refusal(import_demonstrations, bare, TASK, Rig(TRIANGLE))
    for lacking in ("poses", "depth", "colour", "intrinsics", "tool frame", "between -1 and 1", "replay_trajectory"):
        assert lacking in message
    assert "no camera 'top'" in refusal(import_demonstrations, path, TASK, Rig(TRIANGLE, camera="top"))


def test_a_maniskill_file_without_a_success_is_refused(maniskill, tmp_path):
    path, _ = maniskill
    copy = tmp_path / "failed.h5"
    copy.write_bytes(path.read_bytes())
    described = json.loads(path.with_suffix(".json").read_text())
    for episode in described["episodes"]:
        episode["success"] = False
    copy.with_suffix(".json").write_text(json.dumps(described))
    assert "none of them successful" in refusal(import_demonstrations, copy, TASK, Rig(TRIANGLE, rate_hz=20.0))


# ---- robomimic: its documented structure


def robomimic_file(path, depth=True, robot="Panda", calibrated=True):
    environment = {  # as EnvRobosuite.serialize of robomimic writes it
        "env_name": "Lift",
        "env_version": "1.5.2",
        "type": 1,
        "env_kwargs": {"robots": [robot], "control_freq": 20, "camera_depths": depth},
    }
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps(environment)
        for seed in (0, 1, 10, 2):
            demo, seen = demonstration(seed, steps=20), observation(seed)
            poses = demonstration_poses(demo)
            group = data.create_group(f"demo_{seed}")
            group.attrs["num_samples"] = 20
            group["actions"] = np.column_stack([np.zeros((20, 6)), 2 * demo.trajectory.gripper_state[:, 0] - 1])
            group["obs/robot0_eef_pos"] = poses[:, :3, 3]
            group["obs/robot0_eef_quat"] = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
            group["obs/agentview_image"] = np.tile(seen.rgb, (20, 1, 1, 1))
            group["obs/robot0_eye_in_hand_image"] = np.zeros((20, 8, 8, 3), np.uint8)
            if depth:
                group["obs/agentview_depth"] = np.tile(seen.depth[..., None], (20, 1, 1, 1))
            if calibrated:
                camera = {"intrinsics": seen.intrinsics.tolist(), "extrinsics": seen.camera_pose.tolist()}
                group.attrs["camera_info"] = json.dumps({"agentview": camera})
    return path


def demonstration_poses(demo):
    return TRIANGLE.poses(demo.trajectory.triplets[:, 0])


def test_robomimic_files_become_demonstrations(tmp_path):
    demos = import_demonstrations(robomimic_file(tmp_path / "lift.hdf5"), TASK, Rig(TRIANGLE))
    assert [demo.info["episode"] for demo in demos] == ["demo_0", "demo_1", "demo_2", "demo_10"]
    for seed, demo in zip((0, 1, 2, 10), demos, strict=True):
        original = demonstration(seed, steps=20)
        np.testing.assert_allclose(demo.trajectory.actions, original.trajectory.actions, atol=1e-9)
        np.testing.assert_array_equal(demo.observation.rgb, original.observation.rgb)
        np.testing.assert_array_equal(demo.observation.depth, original.observation.depth)
        np.testing.assert_array_equal(demo.observation.camera_pose, original.observation.camera_pose)
        assert demo.rate_hz == 20.0


def test_robomimic_files_of_two_arms_have_the_gripper_of_each(tmp_path):
    path = robomimic_file(tmp_path / "lift.hdf5")
    with h5py.File(path, "r+") as file:
        for group in file["data"].values():
            actions = group["actions"][()]
            del group["actions"]
            group["actions"] = np.hstack([actions, -actions])
            group["obs/robot1_eef_pos"] = group["obs/robot0_eef_pos"][()] + [0, 0.3, 0]
            group["obs/robot1_eef_quat"] = group["obs/robot0_eef_quat"][()]
    for seed, demo in zip((0, 1, 2, 10), import_demonstrations(path, TASK, Rig(TRIANGLE)), strict=True):
        original = demonstration(seed, steps=20).trajectory
        first, second = (TRIANGLE.poses(demo.trajectory.triplets[:, arm]) for arm in (0, 1))
        np.testing.assert_allclose(first, TRIANGLE.poses(original.triplets[:, 0]), atol=1e-9)
        np.testing.assert_allclose(second[:, :3, 3] - first[:, :3, 3], np.tile([0, 0.3, 0], (20, 1)), atol=1e-9)
        np.testing.assert_array_equal(demo.trajectory.gripper_state[:, :1], original.gripper_state)
        np.testing.assert_array_equal(demo.trajectory.gripper_state[:, 1:], 1 - original.gripper_state)


@pytest.mark.parametrize("shape", [(20, 48, 64), (20, 48 * 64)], ids=["without a channel", "flat"])
def test_robomimic_depth_may_have_other_dimensions(tmp_path, shape):
    path = robomimic_file(tmp_path / "lift.hdf5")
    with h5py.File(path, "r+") as file:
        for group in file["data"].values():
            depth = group["obs/agentview_depth"][()]
            del group["obs/agentview_depth"]
            group["obs/agentview_depth"] = depth.reshape(shape)
    (first, *_) = import_demonstrations(path, TASK, Rig(TRIANGLE))
    np.testing.assert_array_equal(first.observation.depth, observation(0).depth)


def test_two_robomimic_files_make_one_folder_and_none_of_their_episodes_is_lost_or_doubled(tmp_path):
    first, second = (robomimic_file(tmp_path / name) for name in ("lift.hdf5", "more.hdf5"))
    out = tmp_path / "lift"
    for path, count in ((first, 4), (second, 8), (first, 8), (second, 8)):
        assert convert_demonstrations(path, out, TASK, "lift it", Rig(TRIANGLE)) == count
    message = refusal(convert_demonstrations, first, out, TASK, "lift it", Rig(GripperTriangle(0.2, 0.08)))
    assert "converted with another rig" in message
    assert len(load_demonstrations(out)) == 8


def test_what_a_robomimic_file_lacks_is_said_and_what_is_known_can_be_given(tmp_path):
    message = refusal(import_demonstrations, robomimic_file(tmp_path / "flat.hdf5", depth=False), TASK, Rig(TRIANGLE))
    assert "depth" in message
    assert "dataset_states_to_obs" in message
    assert "intrinsics" not in message
    path = robomimic_file(tmp_path / "sawyer.hdf5", robot="Sawyer", calibrated=False)
    message = refusal(import_demonstrations, path, TASK, Rig(TRIANGLE))
    assert "tool frame" in message
    assert "intrinsics" in message
    turned = make_pose(Rotation.from_euler("z", 90, degrees=True).as_matrix(), [0, 0, 0.02])
    seen = observation(0)
    rig = Rig(TRIANGLE, intrinsics=seen.intrinsics, camera_pose=seen.camera_pose, tool=turned)
    (first, *_) = import_demonstrations(path, TASK, rig)
    expected = demonstration_poses(demonstration(0, steps=20)) @ turned
    np.testing.assert_allclose(demonstration_poses(first), expected, atol=1e-9)


# ---- LeRobot: several episodes in one file, as lerobot itself writes them


def lerobot_folder(path, names, state_of, depth=True, key="observation.state"):
    """Two episodes in one data file and one video; the poses of `demonstration` in the feature ``key``."""
    lengths = {0: 20, 1: 30}
    states = [state_of(demonstration(seed, steps=length)) for seed, length in lengths.items()]
    columns = {
        key: pa.array(np.concatenate(states).astype(np.float32).tolist()),
        "timestamp": np.concatenate([np.arange(length) / RATE_HZ for length in lengths.values()]),
        "frame_index": np.concatenate([np.arange(length) for length in lengths.values()]),
        "episode_index": np.repeat([0, 1], list(lengths.values())),
    }
    features = {
        key: {"dtype": "float32", "shape": [states[0].shape[1]], "names": names},
        "observation.images.front": {"dtype": "video", "shape": [48, 64, 3], "names": ["height", "width", "channels"]},
    }
    if depth:
        features["observation.depth"] = {"dtype": "uint16", "shape": [48, 64], "names": None}
        steps = [np.nan_to_num(observation(seed).depth * 1000).round().astype(np.uint16) for seed in (0, 1)]
        columns["observation.depth"] = pa.array([steps[episode].tolist() for episode in columns["episode_index"]])
    for folder in ("data/chunk-000", "meta/episodes/chunk-000", "videos/observation.images.front/chunk-000"):
        (path / folder).mkdir(parents=True)
    pq.write_table(pa.table(columns), path / "data/chunk-000/file-000.parquet")
    video = encode_video(np.concatenate([images(seed, length) for seed, length in lengths.items()]), RATE_HZ)
    (path / "videos/observation.images.front/chunk-000/file-000.mp4").write_bytes(video)
    video_key = "videos/observation.images.front"
    rows = {
        "episode_index": [0, 1],
        "tasks": [["push it"], ["push it"]],
        "length": [20, 30],
        "data/chunk_index": [0, 0],
        "data/file_index": [0, 0],
        f"{video_key}/chunk_index": [0, 0],
        f"{video_key}/file_index": [0, 0],
        f"{video_key}/from_timestamp": [0.0, 20 / RATE_HZ],
        f"{video_key}/to_timestamp": [20 / RATE_HZ, 50 / RATE_HZ],
    }
    pq.write_table(pa.table(rows), path / "meta/episodes/chunk-000/file-000.parquet")
    info = {
        "codebase_version": "v3.0",
        "total_episodes": 2,
        "total_frames": 50,
        "fps": int(RATE_HZ),
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": features,
    }
    (path / "meta/info.json").write_text(json.dumps(info))
    return path


def add_features(path, values_of, dtype="float32"):
    """Add features, or replace them, with the values ``(T,)`` or ``(T, D)`` that functions make of a demonstration."""
    file = path / "data/chunk-000/file-000.parquet"
    table, info = pq.read_table(file), json.loads((path / "meta/info.json").read_text())
    for key, values in values_of.items():
        rows = np.concatenate([values(demonstration(seed, steps=length)) for seed, length in ((0, 20), (1, 30))])
        width = int(rows.size / len(rows))
        rows = np.ravel(rows).tolist() if width == 1 else rows.tolist()
        if key in table.column_names:
            table = table.drop_columns([key])
        kind = pa.float64() if dtype == "float64" else pa.float32()
        table = table.append_column(key, pa.array(rows, kind if width == 1 else pa.list_(kind)))
        info["features"][key] = {"dtype": dtype, "shape": [width], "names": None}
    pq.write_table(table, file)
    (path / "meta/info.json").write_text(json.dumps(info))


def end_effector(demo):
    """Position, rotation vector and gripper opening in percent, as lerobot's own kinematics write them."""
    poses = demonstration_poses(demo)
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    return np.column_stack([poses[:, :3, 3], turns, 100 * (1 - demo.trajectory.gripper_state[:, 0])])


NAMES = ["ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz", "ee.gripper_pos"]


def known_rig(**changes):
    seen = observation(0)
    facts = {
        "intrinsics": seen.intrinsics,
        "camera_pose": seen.camera_pose,
        "tool": TOOL,
        "gripper": GripperCommand(open=100, closed=0),
        "depth_key": "observation.depth",
        "depth_unit_m": 1e-3,
    }
    return Rig(TRIANGLE, **(facts | changes))


def test_lerobot_datasets_with_end_effector_poses_become_demonstrations(tmp_path):
    path = lerobot_folder(tmp_path / "theirs", NAMES, end_effector)
    demos = import_demonstrations(path, TASK, known_rig())
    for seed, length, demo in zip((0, 1), (20, 30), demos, strict=True):
        original = demonstration(seed, steps=length)
        np.testing.assert_allclose(demo.trajectory.actions, original.trajectory.actions, atol=1e-6)
        assert np.nanmax(np.abs(demo.observation.depth - original.observation.depth)) < 1e-3
        # The second episode begins in the middle of the video.
        assert np.abs(demo.observation.rgb.astype(int) - images(seed, 1)[0]).mean() < 3
        assert demo.rate_hz == RATE_HZ
    assert convert_demonstrations(path, tmp_path / "ours", TASK, DESCRIPTION, known_rig()) == 2
    assert len(list(load_frames(tmp_path / "ours", 1))) == 30


def test_quaternions_are_read_too(tmp_path):
    def state(demo):
        poses = demonstration_poses(demo)
        return np.column_stack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])

    path = lerobot_folder(tmp_path / "theirs", {"axes": ["x", "y", "z", "qx", "qy", "qz", "qw"]}, state)
    message = refusal(import_demonstrations, path, TASK, known_rig())
    assert message.endswith("lacks the gripper's commands or positions")


def test_what_a_lerobot_dataset_lacks_is_said(tmp_path):
    joints = [f"joint_{number}.pos" for number in range(6)] + ["gripper.pos"]
    path = lerobot_folder(tmp_path / "joints", joints, end_effector, depth=False)
    message = refusal(import_demonstrations, path, TASK, Rig(TRIANGLE))
    for lacking in ("end-effector poses", "depth", "intrinsics", "camera's pose", "tool frame", "between 0 and 100"):
        assert lacking in message
    assert "'observation.depth'" in refusal(import_demonstrations, path, TASK, known_rig())
    path = lerobot_folder(tmp_path / "unit", NAMES, end_effector)
    assert "unit" in refusal(import_demonstrations, path, TASK, known_rig(depth_unit_m=None))
    assert "load_frames" not in refusal(load_demonstrations, path)


@pytest.mark.parametrize(("name", "accuracy_m"), [("depth-video", 2e-3), ("depth-mm", 1e-6), ("depth-m", 1e-6)])
def test_depth_streams_of_lerobot_0_6_are_depth_and_no_camera(lerobot_files, name, accuracy_m):
    demos = import_demonstrations(lerobot_files / name, TASK, known_rig(depth_key=None, depth_unit_m=None))
    expected = (600 + np.add.outer(2 * np.arange(48), np.arange(64))) / 1000
    for demo in demos:
        depth = demo.observation.depth
        assert not (depth[:4] > 0).any()  # no reading
        np.testing.assert_allclose(depth[4:], expected[4:], atol=accuracy_m)
        np.testing.assert_array_equal(demo.trajectory.gripper_state[:, 0], [0, 0, 0, 1, 1, 1])
    assert [int(demo.observation.rgb.mean()) for demo in demos] == pytest.approx([40, 60], abs=2)


def test_depth_coded_in_a_colour_video_comes_back(tmp_path):
    path = lerobot_folder(tmp_path / "theirs", NAMES, end_effector, depth=False)
    key = "observation.images.front_depth"
    scenes = [np.add.outer(np.linspace(1.0 + start, 0.95 + start, 48), np.linspace(0, 0.05, 64)) for start in (0, 0.2)]
    for depth in scenes:
        depth[20:32, 20:40] -= 0.06  # a box
        depth[8:16, 4:16] = 0  # no reading
    coded = [np.tile(coded_depth.encode(depth), (n, 1, 1, 1)) for depth, n in zip(scenes, (20, 30), strict=True)]
    (path / f"videos/{key}/chunk-000").mkdir(parents=True)
    (path / f"videos/{key}/chunk-000/file-000.mp4").write_bytes(encode_video(np.concatenate(coded), RATE_HZ))
    file = path / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(file)
    for name in [name for name in table.column_names if name.startswith("videos/")]:
        table = table.append_column(name.replace("images.front", "images.front_depth"), table[name])
    pq.write_table(table, file)
    info = json.loads((path / "meta/info.json").read_text())
    info["features"][key] = {"dtype": "video", "shape": [96, 64, 3], "names": ["height", "width", "channels"]}
    (path / "meta/info.json").write_text(json.dumps(info))
    demos = import_demonstrations(path, TASK, known_rig(depth_key=key, depth_unit_m=None))
    for depth, demo in zip(scenes, demos, strict=True):
        there = depth > 0
        error = np.abs(demo.observation.depth - depth)[there]
        assert np.nanmedian(error) < 1e-3
        assert np.nanquantile(error, 0.9) < 4e-3  # the video blurs edges
        assert np.isfinite(error).mean() > 0.9
        assert np.isnan(demo.observation.depth[~there]).mean() > 0.8


def test_a_colour_video_is_no_depth(tmp_path):
    path = lerobot_folder(tmp_path / "theirs", NAMES, end_effector, depth=False)
    message = refusal(import_demonstrations, path, TASK, known_rig(depth_key="observation.images.front", camera=None))
    assert "colour image" in message


def test_depth_in_one_row_of_numbers_takes_the_shape_of_the_image(tmp_path):
    path = lerobot_folder(tmp_path / "theirs", NAMES, end_effector)
    table = pq.read_table(path / "data/chunk-000/file-000.parquet")
    flat = [np.ravel(depth).tolist() for depth in table["observation.depth"].to_pylist()]
    place = table.column_names.index("observation.depth")
    pq.write_table(
        table.set_column(place, "observation.depth", pa.array(flat)), path / "data/chunk-000/file-000.parquet"
    )
    for seed, demo in enumerate(import_demonstrations(path, TASK, known_rig())):
        assert np.nanmax(np.abs(demo.observation.depth - observation(seed).depth)) < 1e-3


# ---- how people write poses


def tilted(demo):
    """The poses of a demonstration, with the gripper pointing down and turned: no rotation is like another one."""
    poses = demonstration_poses(demo)
    poses[:, :3, :3] = Rotation.from_euler("xyz", [2.8, 0.3, 0.7]).as_matrix()
    return poses


def layout(rotation, gripper=True):
    def state(demo):
        poses = tilted(demo)
        turns = rotation(Rotation.from_matrix(poses[:, :3, :3]))
        opening = 100 * (1 - demo.trajectory.gripper_state)
        return np.column_stack([poses[:, :3, 3], turns, *([opening] if gripper else [])])

    return state


def rotvec(rotation):
    return rotation.as_rotvec()


def rpy(rotation):
    return rotation.as_euler("xyz")


def xyzw(rotation):
    return rotation.as_quat()


def wxyz(rotation):
    return rotation.as_quat(scalar_first=True)


def axis_angle(rotation):
    angles = rotation.magnitude()[:, None]
    return np.hstack([rotation.as_rotvec() / angles, angles])


def degrees(rotation):
    return rotation.as_euler("xyz", degrees=True)


@pytest.mark.parametrize(
    ("names", "rotation", "facts"),
    [
        (["x", "y", "z", "rx", "ry", "rz", "gripper"], rotvec, {}),
        (["tcp.x", "tcp.y", "tcp.z", "tcp.rx", "tcp.ry", "tcp.rz", "gripper.pos"], rpy, {"rotation": "rpy"}),
        (["ee_x", "ee_y", "ee_z", "ee_ax", "ee_ay", "ee_az", "gripper"], rotvec, {}),
        ({"motors": ["x", "y", "z", "axis_angle1", "axis_angle2", "axis_angle3", "gripper"]}, rotvec, {}),
        ({"motors": ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]}, rpy, {}),
        ({"motors": ["x", "y", "z", "rx", "ry", "rz", "rw", "gripper"]}, xyzw, {}),
        ({"x": 0, "y": 1, "z": 2, "qw": 3, "qx": 4, "qy": 5, "qz": 6, "gripper": 7}, wxyz, {}),
        (["pos_x", "pos_y", "pos_z", "quat_w", "quat_x", "quat_y", "quat_z", "gripper"], wxyz, {}),
        ([*(f"position.{axis}" for axis in "xyz"), *(f"orientation.{axis}" for axis in "xyzw"), "gripper"], xyzw, {}),
        (["tcpX", "tcpY", "tcpZ", "tcpQuatX", "tcpQuatY", "tcpQuatZ", "tcpQuatW", "gripperWidth"], xyzw, {}),
        (["x", "y", "z", *(f"quat_{place}" for place in range(4)), "gripper"], wxyz, {"rotation": "quat_wxyz"}),
        (["x", "y", "z", "ax", "ay", "az", "angle", "gripper"], axis_angle, {}),
        (["x", "y", "z", "axis_x", "axis_y", "axis_z", "axis_angle", "gripper_angle"], axis_angle, {}),
        (["x", "y", "z", "roll", "pitch", "yaw", "gripper"], degrees, {"rotation_unit_rad": np.pi / 180}),
        ([f"gripper_{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz", "opening")], rotvec, {}),
        ({"motors": {"x": 0, "y": 1, "z": 2, "rx": 3, "ry": 4, "rz": 5, "gripper": 6}}, rotvec, {}),
        (None, rotvec, {"rotation": "rotvec", "pose_key": "observation.state"}),
        ([f"motor_{place}" for place in range(8)], wxyz, {"rotation": "quat_wxyz", "pose_key": "observation.state"}),
    ],
)
def test_names_of_the_axes_say_what_a_pose_is(tmp_path, names, rotation, facts):
    path = lerobot_folder(tmp_path / "theirs", names, layout(rotation))
    for seed, demo in enumerate(import_demonstrations(path, TASK, known_rig(**facts))):
        expected = tilted(demonstration(seed, steps=len(demo.trajectory)))
        np.testing.assert_allclose(demonstration_poses(demo), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("key", "rotation"),
    [
        ("observation.state.cartesian_position", rpy),
        ("observation.ee_pose", xyzw),
        ("observation.left_ee_pose", xyzw),
        ("observation.ee_pose_right", xyzw),
    ],
)
def test_poses_without_names_are_read_as_is_usual_for_their_feature(tmp_path, key, rotation):
    path = lerobot_folder(tmp_path / "theirs", None, layout(rotation, gripper=False), key=key)
    gripper = {"observation.gripper_position": lambda demo: 100 * (1 - demo.trajectory.gripper_state)}
    add_features(path, gripper)
    for seed, demo in enumerate(import_demonstrations(path, TASK, known_rig())):
        expected = tilted(demonstration(seed, steps=len(demo.trajectory)))
        np.testing.assert_allclose(demonstration_poses(demo), expected, atol=1e-5)


def in_two_features(path, rotation, **features):
    """A dataset of joints, a gripper, and ``features``: slices of the pose, or slices with an offset."""
    lerobot_folder(path, ["joint_1", "joint_2"], lambda demo: np.zeros((len(demo.trajectory), 2)))
    pose = layout(rotation, gripper=False)
    parts = {key: value if isinstance(value, tuple) else (value, 0.0) for key, value in features.items()}
    values = {
        f"observation.{key}": lambda demo, own=own, offset=offset: pose(demo)[:, own] + offset
        for key, (own, offset) in parts.items()
    }
    add_features(path, values | {"observation.gripper": lambda demo: 100 * (1 - demo.trajectory.gripper_state)})
    return path


PLACE, TURN = slice(0, 3), slice(3, None)


@pytest.mark.parametrize(
    ("rotation", "features"),
    [
        (xyzw, {"cube_pos": (PLACE, 1.0), "cube_quat": TURN, "ee_pos": PLACE, "ee_quat": TURN}),
        (rpy, {"ee_position": PLACE, "ee_euler": TURN, "joint_pos": (PLACE, 1.0)}),
        (rotvec, {"eef.left_xyz": PLACE, "eef.left_axis_angle": TURN}),
    ],
)
def test_position_and_rotation_of_a_gripper_may_be_features_of_their_own(tmp_path, rotation, features):
    path = in_two_features(tmp_path / "theirs", rotation, **features)
    add_features(path, {"action.ee_pose": lambda demo: layout(xyzw, gripper=False)(demo) + 1})  # commanded: comes last
    for seed, demo in enumerate(import_demonstrations(path, TASK, known_rig())):
        expected = tilted(demonstration(seed, steps=len(demo.trajectory)))
        np.testing.assert_allclose(demonstration_poses(demo), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("rotation", "features", "facts", "said"),
    [
        (xyzw, {"camera_pos": PLACE, "camera_quat": TURN}, {}, "poses"),
        (xyzw, {"delta_ee_pos": PLACE, "delta_ee_quat": TURN}, {}, "poses"),
        (xyzw, {"ee_pos": PLACE, "ee_vel_quat": TURN}, {}, "poses"),
        (xyzw, {"ee_pos": PLACE, "ee_quat": TURN}, {"rotation": "rpy"}, "poses"),
        (xyzw, {"ee_pos": PLACE, "ee_euler": TURN}, {}, "poses"),
        (xyzw, {"left_ee_pos": PLACE, "left_ee_quat": TURN, "right_ee_pos": PLACE}, {}, "right_ee_pos has no rotation"),
    ],
)
def test_what_is_no_pair_of_a_grippers_position_and_rotation_is_refused(tmp_path, rotation, features, facts, said):
    path = in_two_features(tmp_path / "theirs", rotation, **features)
    assert said in refusal(import_demonstrations, path, TASK, known_rig(**facts))


def test_a_pose_without_names_may_end_with_the_gripper(tmp_path):
    path = lerobot_folder(tmp_path / "theirs", None, layout(xyzw), key="observation.ee_pose")
    for seed, demo in enumerate(import_demonstrations(path, TASK, known_rig())):
        original = demonstration(seed, steps=len(demo.trajectory))
        np.testing.assert_allclose(demonstration_poses(demo), tilted(original), atol=1e-5)
        np.testing.assert_array_equal(demo.trajectory.gripper_state, original.trajectory.gripper_state)


def test_quaternions_of_an_order_that_cannot_be_told_are_not_guessed(tmp_path):
    path = lerobot_folder(tmp_path / "theirs", None, layout(wxyz, gripper=False), key="observation.ee_pose")
    message = refusal(import_demonstrations, path, TASK, known_rig())
    assert "both orders" in message  # as x, y, z, w, the gripper points down, too
    assert "rotation in the rig" in message
    message = refusal(import_demonstrations, path, TASK, known_rig(rotation="quat_wxyz"))
    assert "gripper" in message  # there is none; the poses are known now
    with pytest.raises(InvalidValueError, match="quat_xyzw"):
        known_rig(rotation="quaternion")


def test_velocities_forces_and_differences_are_no_pose(tmp_path):
    def state(demo):
        return np.column_stack([np.full((len(demo.trajectory), 7), 7.0), layout(rotvec)(demo)])

    others = ["vel_x", "vel_y", "vel_z", "wrench.rx", "delta_x", "gripper_force", "gripper_delta"]
    names = [*others, "x", "y", "z", "rx", "ry", "rz", "gripper"]
    path = lerobot_folder(tmp_path / "theirs", names, state)
    for seed, demo in enumerate(import_demonstrations(path, TASK, known_rig())):
        original = demonstration(seed, steps=len(demo.trajectory))
        np.testing.assert_allclose(demonstration_poses(demo), tilted(original), atol=1e-5)
        np.testing.assert_array_equal(demo.trajectory.gripper_state, original.trajectory.gripper_state)


def test_angles_in_degrees_are_noticed(tmp_path):
    path = lerobot_folder(tmp_path / "theirs", ["x", "y", "z", "roll", "pitch", "yaw", "gripper"], layout(degrees))
    assert "rotation_unit_rad" in refusal(import_demonstrations, path, TASK, known_rig())


def test_two_arms_are_told_apart_by_left_and_right(tmp_path):
    def both(demo):
        one = layout(rotvec)(demo)
        other = one.copy()
        other[:, 1] += 0.5
        other[:, 6] = 100 - other[:, 6]
        return np.column_stack([other, one])

    names = [f"{arm}_{axis}" for arm in ("right", "left") for axis in ("x", "y", "z", "rx", "ry", "rz", "gripper")]
    path = lerobot_folder(tmp_path / "theirs", names, both)
    for seed, demo in enumerate(import_demonstrations(path, TASK, known_rig())):
        assert demo.trajectory.num_arms == 2
        left, right = (TRIANGLE.poses(demo.trajectory.triplets[:, arm]) for arm in (0, 1))
        original = demonstration(seed, steps=len(demo.trajectory))
        np.testing.assert_allclose(left, tilted(original), atol=1e-5)
        np.testing.assert_allclose(right[:, 1, 3], left[:, 1, 3] + 0.5, atol=1e-5)
        np.testing.assert_array_equal(demo.trajectory.gripper_state.sum(axis=1), 1)


def test_positions_in_millimetres_are_noticed_and_converted(tmp_path):
    def millimetres(demo):
        return end_effector(demo) * [1000, 1000, 1000, 1, 1, 1, 1]

    path = lerobot_folder(tmp_path / "theirs", NAMES, millimetres)
    assert "position_unit_m" in refusal(import_demonstrations, path, TASK, known_rig())
    for seed, demo in enumerate(import_demonstrations(path, TASK, known_rig(position_unit_m=1e-3))):
        original = demonstration(seed, steps=len(demo.trajectory))
        np.testing.assert_allclose(demo.trajectory.actions, original.trajectory.actions, atol=1e-6)


@pytest.fixture
def urdf(tmp_path):
    """Two links of 0.3 and 0.2 m that turn about z, and a lift along it."""
    pytest.importorskip("mink")
    urdf = tmp_path / "arm.urdf"
    links = "".join(f'<link name="{name}"/>' for name in ("base", "upper", "lower", "slide", "hand"))
    joints = "".join(
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="0 0 1"/>'
        f'<origin xyz="{x} 0 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        for name, kind, parent, child, x in (
            ("shoulder", "revolute", "base", "upper", 0),
            ("elbow", "revolute", "upper", "lower", 0.3),
            ("lift", "prismatic", "lower", "slide", 0.2),
            ("wrist", "fixed", "slide", "hand", 0),
        )
    )
    urdf.write_text(f'<robot name="arm">{links}{joints}</robot>')
    return urdf


def test_joint_positions_of_two_arms_become_poses_in_one_world(tmp_path, urdf):
    def recorded(demo):
        steps = len(demo.trajectory)
        left, right = np.full((steps, 3), 0.1), np.full((steps, 3), -0.1)
        return np.hstack([right, demo.trajectory.gripper_state, left, 1 - demo.trajectory.gripper_state])

    names = [f"{arm}_{joint}.pos" for arm in ("right", "left") for joint in ("shoulder", "elbow", "lift", "gripper")]
    path = lerobot_folder(tmp_path / "theirs", names, recorded)
    models = tuple(JointModel(urdf, "hand", base=make_pose(np.eye(3), [0, y, 0])) for y in (0.4, -0.4))
    rig = known_rig(joints=models, gripper=GripperCommand(open=1, closed=0))
    for demo in import_demonstrations(path, TASK, rig):
        for arm, sign in ((0, 1), (1, -1)):
            poses = TRIANGLE.poses(demo.trajectory.triplets[:, arm])
            x, y = (0.3 * f(0.1) + 0.2 * f(0.2) for f in (np.cos, np.sin))
            np.testing.assert_allclose(poses[:, :3, 3], [[x, sign * (y + 0.4), sign * 0.1]] * len(poses), atol=1e-6)
        np.testing.assert_array_equal(demo.trajectory.gripper_state.sum(axis=1), 1)
    with pytest.raises(InvalidValueError, match="two"):
        known_rig(joints=(*models, models[0]))


def test_joint_positions_and_a_urdf_become_poses(tmp_path, urdf):
    turns = np.linspace(0, 1, 30)

    def recorded(demo):
        t = turns[: len(demo.trajectory)]
        return np.column_stack([t, 2 * t, -t / 10, 100 * (1 - demo.trajectory.gripper_state)])

    path = lerobot_folder(tmp_path / "theirs", ["elbow.pos", "shoulder.pos", "lift.pos", "gripper.pos"], recorded)
    for demo in import_demonstrations(path, TASK, known_rig(joints=JointModel(urdf, "hand"))):
        t = turns[: len(demo.trajectory)]
        x, y = (0.3 * f(2 * t) + 0.2 * f(3 * t) for f in (np.cos, np.sin))
        poses = demonstration_poses(demo)
        np.testing.assert_allclose(poses[:, :3, 3], np.column_stack([x, y, -t / 10]), atol=1e-6)
        turned = Rotation.from_rotvec(np.outer(3 * t, [0, 0, 1])).as_matrix()
        np.testing.assert_allclose(poses[:, :3, :3], turned, atol=1e-6)
    pairs = ("shoulder", "elbow", "lift"), ("shoulder.pos", "elbow.pos", "lift.pos")
    named = JointModel(urdf, "hand", *pairs, np.pi / 180)
    (demo, _) = import_demonstrations(path, TASK, known_rig(joints=named))
    poses = demonstration_poses(demo)
    assert np.abs(poses[:, 1, 3]).max() < 0.03  # the same numbers, in degrees; a lift is in metres
    np.testing.assert_allclose(poses[:, 2, 3], -turns[: len(poses)] / 10, atol=1e-6)
    assert "unit_rad" in refusal(
        import_demonstrations, path, TASK, known_rig(joints=JointModel(urdf, "hand", unit_rad=57))
    )
    assert "hand" in refusal(import_demonstrations, path, TASK, known_rig(joints=JointModel(urdf, "tip")))
    few = JointModel(urdf, "hand", ("shoulder", "lift"), ("shoulder.pos", "lift.pos"))
    assert "no column for elbow" in refusal(import_demonstrations, path, TASK, known_rig(joints=few))
    wrong = JointModel(urdf, "hand", ("shoulder",), ("pan",))
    assert "shoulder" in refusal(import_demonstrations, path, TASK, known_rig(joints=wrong))
    urdf.write_text("<robot>")
    assert "URDF" in refusal(import_demonstrations, path, TASK, known_rig(joints=JointModel(urdf, "hand")))


# ---- times


@pytest.mark.parametrize("unit_s", [1.0, 1e-3, 1e-9], ids=["s", "ms", "ns"])
def test_frames_at_uneven_times_of_day_are_resampled(tmp_path, unit_s):
    path = lerobot_folder(tmp_path / "theirs", NAMES, end_effector)
    moments = {}

    def stamps(demo):
        steps = len(demo.trajectory)
        gaps = np.random.default_rng(steps).uniform(0.5, 2.5, steps) / RATE_HZ
        moments[steps] = np.cumsum(gaps) - gaps[0]
        return (1.76e9 + moments[steps]) / unit_s

    add_features(path, {"timestamp": stamps}, dtype="float64")
    for seed, demo in enumerate(import_demonstrations(path, TASK, known_rig())):
        original = demonstration(seed, steps=(20, 30)[seed])
        seconds = moments[len(original.trajectory)]
        assert demo.seconds == pytest.approx(seconds[-1], abs=1 / RATE_HZ)
        times = np.arange(len(demo.trajectory)) / RATE_HZ
        for column in (0, 4, 8):
            wanted = np.interp(times, seconds, original.trajectory.actions[:, column])
            np.testing.assert_allclose(demo.trajectory.actions[:, column], wanted, atol=2e-5)
    assert convert_demonstrations(path, tmp_path / "ours", TASK, DESCRIPTION, known_rig()) == 2
    ours = load_demonstrations(tmp_path / "ours")
    assert len(list(load_frames(tmp_path / "ours", 1))) == len(ours[1].trajectory)
    known = import_demonstrations(path, TASK, known_rig(rate_hz=10.0))  # the user knows better
    assert [len(demo.trajectory) for demo in known] == [20, 30]


def test_of_frames_at_the_same_time_the_first_one_counts(tmp_path):
    path = lerobot_folder(tmp_path / "theirs", NAMES, end_effector)
    add_features(path, {"timestamp": lambda demo: np.arange(len(demo.trajectory)) // 2 / RATE_HZ}, dtype="float64")
    for seed, demo in enumerate(import_demonstrations(path, TASK, known_rig())):
        original = demonstration(seed, steps=(20, 30)[seed]).trajectory.actions
        np.testing.assert_allclose(demo.trajectory.actions[:, :9], original[::2, :9], atol=1e-5)


def test_times_of_day_that_are_too_coarse_for_frames_are_ignored(tmp_path):
    path = lerobot_folder(tmp_path / "theirs", NAMES, end_effector)
    add_features(path, {"timestamp": lambda demo: 1.76e9 + 5 * np.arange(len(demo.trajectory))})  # in float32: 128 s
    assert [len(demo.trajectory) for demo in import_demonstrations(path, TASK, known_rig())] == [20, 30]


def test_times_that_go_back_are_refused(tmp_path):
    path = lerobot_folder(tmp_path / "theirs", NAMES, end_effector)
    add_features(path, {"timestamp": lambda demo: -np.arange(len(demo.trajectory))}, dtype="float64")
    assert "go back" in refusal(import_demonstrations, path, TASK, known_rig())


# ---- the command


def test_recordings_are_imported_from_the_command_line(tmp_path, capsys):
    path, out, rig = lerobot_folder(tmp_path / "theirs", NAMES, end_effector), tmp_path / "ours", tmp_path / "rig.json"
    command = ["import", str(path), "--rig", str(rig), "--task", TASK, "--out", str(out)]
    content = {"triangle": {"length": 0.1, "opening": 0.08}, "gripper": {"open": 100, "closed": 0}}
    rig.write_text(json.dumps(content))
    assert main(command) == 1
    assert "intrinsics" in capsys.readouterr().err
    seen = observation(0)
    content |= {
        "intrinsics": seen.intrinsics.tolist(),
        "camera_pose": seen.camera_pose.tolist(),
        "tool": TOOL.tolist(),
        "depth_key": "observation.depth",
        "depth_unit_m": 0.001,
    }
    rig.write_text(json.dumps(content))
    assert main(command) == 0
    assert "2 demonstrations" in capsys.readouterr().out
    for seed, demo in enumerate(load_demonstrations(out)):
        original = demonstration(seed, steps=len(demo.trajectory))
        np.testing.assert_allclose(demo.trajectory.actions, original.trajectory.actions, atol=1e-5)


def test_an_import_without_a_folder_goes_into_one_named_after_the_task(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "here" / "there"
    folder.mkdir(parents=True)
    monkeypatch.chdir(folder)
    path = lerobot_folder(tmp_path / "theirs", NAMES, end_effector)
    rig = {"triangle": {"length": 0.1, "opening": 0.08}, "gripper": {"open": 100, "closed": 0}}
    seen = observation(0)
    rig |= {"intrinsics": seen.intrinsics.tolist(), "camera_pose": seen.camera_pose.tolist(), "tool": TOOL.tolist()}
    rig |= {"depth_key": "observation.depth", "depth_unit_m": 0.001}
    Path("rig.json").write_text(json.dumps(rig))
    for task, name in (("metaworld/reach", "metaworld-reach"), ("../../push", "..-..-push")):
        assert main(["import", str(path), "--rig", "rig.json", "--task", task]) == 0
        assert len(load_demonstrations(Path("data") / name, task)) == 2
    assert sorted(file.name for file in tmp_path.iterdir()) == ["here", "theirs"]
    for task in ("", "..", "."):
        with pytest.raises(SystemExit):
            main(["import", str(path), "--rig", "rig.json", "--task", task])
        assert "must be a name" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({}, "triangle"),
        ({"triangle": {"length": 0.1}}, "opening"),
        ({"triangle": 3}, "triangle"),
        ({"intrinsic": 1}, "'intrinsic'"),
        ({"intrinsics": [[1, 2]]}, "(3, 3)"),
        ({"depth_unit_m": "mm"}, "number"),
        ({"depth_unit_m": -0.001}, "depth_unit_m must be a positive"),
        ({"rate_hz": 0}, "rate_hz must be a positive"),
        ({"position_unit_m": float("nan")}, "position_unit_m must be a positive"),
        ({"gripper": {"open": 1, "closed": "x"}}, "closed must be a number"),
        ({"gripper": {"open": True, "closed": 0}}, "open must be a number"),
        ({"triangle": {"length": "0.1", "opening": 0.08}}, "length must be a number"),
        ({"tool": np.diag([1, 1, 1000, 1]).tolist()}, "tool (4, 4) must hold a proper rotation"),
        ({"tool": np.full((4, 4), np.nan).tolist()}, "tool of shape (4, 4) holds values that are not finite"),
        ({"joints": {"urdf": "arm.urdf", "link": 3}}, "link must be text"),
        ({"joints": {"urdf": "arm.urdf", "link": "hand", "names": "a"}}, "names must be a list of text"),
        ({"camera": 3}, "text"),
        ({"rotation": "quat"}, "quat_xyzw"),
        ({"joints": {"urdf": "arm.urdf"}}, "link"),
        ({"joints": [{"urdf": "arm.urdf", "link": "hand"}]}, "two for two arms"),
        ({"gripper": [{"open": 0, "closed": 1}]}, "gripper must be an object"),
    ],
)
def test_a_wrong_description_of_a_rig_is_said_in_one_line(tmp_path, content, said):
    path = tmp_path / "rig.json"
    whole = {"triangle": {"length": 0.1, "opening": 0.08}} | content if content else {}
    path.write_text(json.dumps(whole))
    message = refusal(read_rig, path)
    assert said in message
    assert "rig.json" in message


def test_files_of_no_known_kind_are_refused(tmp_path):
    assert "no " in refusal(import_demonstrations, tmp_path / "nowhere.h5", TASK, Rig(TRIANGLE))
    (tmp_path / "noise.h5").write_bytes(b"not hdf5 at all")
    assert "noise.h5" in refusal(import_demonstrations, tmp_path / "noise.h5", TASK, Rig(TRIANGLE))
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["measurements"] = np.zeros(3)
    assert "none of the recordings" in refusal(import_demonstrations, tmp_path / "other.h5", TASK, Rig(TRIANGLE))
    with DatasetWriter(tmp_path / "ours", TASK, DESCRIPTION, RATE_HZ) as writer:
        writer.add(demonstration(0))
    assert "load_demonstrations" in refusal(import_demonstrations, tmp_path / "ours", TASK, Rig(TRIANGLE))
    with pytest.raises(InvalidValueError, match="different"):
        GripperCommand(open=1, closed=1)
