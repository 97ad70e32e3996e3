"""Demonstrations and plans as entities of Rerun: camera, point cloud, keypoints, candidates with weights, paths.

The entities are the same for all: ``world/camera`` with ``rgb`` and ``depth``, ``world/points``, ``world/keypoints``,
``world/candidates/Q``, ``world/plan``, ``world/measured``, ``weights/Q``, ``notes``. Steps are the timeline ``step``.
Importing it raises `MissingExtraError` without the extra `rerun`.
"""

import os
import socket
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import RipError, UsageError, needs_extra
from robust_instant_policy.files import PART_SUFFIX, excerpt, make_folder, require_replaceable
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies.policy import Plan
from robust_instant_policy.reporting.run import MEASURED_FILE, PLAN_FILE, SEEN_FILE
from robust_instant_policy.robots.path import MeasuredPath
from robust_instant_policy.trajectory import Trajectory

with needs_extra("rerun"):
    import rerun as rr
    import rerun.blueprint as rrb

LIVE = "live"  # in place of a file: a viewer, which is started where none runs
DEFAULT_PORT = 9876  # of Rerun's viewer
CONNECT_S = 5.0  # for a viewer to answer
FLUSH_S = 120.0  # for a viewer to take what was logged
MAX_POINTS = 40_000  # of a point cloud
POINT_M, KEYPOINT_M, PATH_M, CANDIDATE_M = 0.0015, 0.008, 0.004, 0.002  # radii
OPEN, CLOSED, MEASURED = (40, 120, 220), (220, 110, 30), (60, 160, 60)  # colours of a gripper, and of what it did
KEPT, HALLUCINATED = (90, 90, 200), (200, 60, 60)  # colours of candidates


@contextmanager
def open_recording(where: str, name: str) -> Iterator[rr.RecordingStream]:
    """A recording called ``name``: in the file ``where`` (.rrd), shown by a viewer (`LIVE`), or sent to the address of
    one (``rerun+http://…``). It is complete when the block ends; a file takes its name then.

    Raises `UsageError` for anything else, `RipError` where no viewer answers and where the file cannot be written.
    """
    recording = rr.RecordingStream("robust-instant-policy")
    try:
        part = _send_to(recording, where)
    except RuntimeError as error:
        raise RipError(f"cannot log to {where}: {excerpt(str(error).splitlines()[0])}") from None
    try:
        recording.send_recording_name(name)
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        yield recording
        try:
            recording.flush(timeout_sec=FLUSH_S)
        except (RuntimeError, ValueError) as error:
            raise RipError(f"what was logged did not arrive at {where}: {excerpt(error)}; is a viewer there?") from None
        recording.disconnect()
        if part is not None:
            part.replace(where)
    finally:
        recording.disconnect()
        if part is not None:
            part.unlink(missing_ok=True)


def _send_to(recording: rr.RecordingStream, where: str) -> Path | None:
    """Open ``where`` for the recording; returns the hidden neighbour of a file, to which it is written first."""
    if where.endswith(".rrd"):
        path = Path(where)
        require_replaceable(path)
        make_folder(path.absolute().parent)
        part = path.with_name(f".{path.name}.{os.getpid()}{PART_SUFFIX}")
        recording.save(part, default_blueprint=_blueprint())
        return part
    if where == LIVE:
        viewer = Path(sys.executable).with_name("rerun")  # of this environment, which need not be in PATH
        rr.spawn(connect=False, executable_path=str(viewer) if viewer.exists() else None, recording=recording)
        where = f"rerun+http://127.0.0.1:{DEFAULT_PORT}/proxy"
    if where.startswith(("rerun://", "rerun+http://", "rerun+https://")):
        _require_viewer(where)
        recording.connect_grpc(where, default_blueprint=_blueprint())
    else:
        raise UsageError(f"--rerun takes a file that ends in .rrd, {LIVE!r} or the address of a viewer, not {where!r}")
    return None


def _require_viewer(address: str) -> None:
    """Raises `RipError` where nothing listens at ``address``: the recording would wait for it."""
    try:
        place = urlsplit(address)
        socket.create_connection((place.hostname or "", place.port or DEFAULT_PORT), CONNECT_S).close()
    except (OSError, ValueError) as error:
        raise RipError(f"no viewer answers at {address} ({error}); start one with: rerun --serve-grpc") from None


def log_plan(
    recording: rr.RecordingStream, observation: Observation, plan: Plan, measured: FloatArray | None = None
) -> None:
    """Log what ``plan`` saw and chose and, where it was executed, the way ``measured (N, A, 3)`` of the points between
    the fingertips, metres, world."""
    _log_observation(recording, observation)
    labels = [f"{index + 1}: {confidence:.2f}" for index, confidence in enumerate(plan.keypoint_confidence)]
    recording.log("world/keypoints", rr.Points3D(plan.keypoints, radii=KEYPOINT_M, labels=labels, show_labels=False))
    recording.log("world/camera/rgb/keypoints", rr.Points2D(plan.pixels, radii=4, labels=labels, show_labels=False))
    for index, candidate in enumerate(plan.candidates):
        _log_candidate(recording, index, candidate, plan)
    _log_trajectory(recording, plan.trajectory)
    if measured is not None:
        strips = list(np.swapaxes(measured, 0, 1))
        labels = ["measured"] * len(strips)
        recording.log("world/measured", rr.LineStrips3D(strips, radii=PATH_M, colors=MEASURED, labels=labels))
    spread = plan.scale.reshape(len(plan.trajectory), plan.trajectory.num_arms, -1)[..., :9].mean(axis=(1, 2))
    for step, value in enumerate(spread):
        recording.set_time("step", sequence=step)
        recording.log("spread", rr.Scalars(float(value)))
    recording.reset_time()
    told = "unknown" if plan.confidence is None else f"{plan.confidence:.2f}"
    notes = "\n".join(f"- {note}" for note in plan.notes)
    text = f"# Confidence {told}\n\n{notes}"
    recording.log("notes", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)


def log_run(recording: rr.RecordingStream, folder: Path) -> None:
    """Log the plan of a run folder, and what was measured. Raises `DatasetError` where it holds no run."""
    measured = MeasuredPath.load(folder / MEASURED_FILE).measured_tools if (folder / MEASURED_FILE).exists() else None
    log_plan(recording, Observation.load(folder / SEEN_FILE), Plan.load(folder / PLAN_FILE), measured)


def log_demonstrations(recording: rr.RecordingStream, demonstrations: Sequence[Demonstration]) -> None:
    """Log every demonstration at its place of the timeline ``demonstration``, with its images where it has some."""
    for index, demonstration in enumerate(demonstrations):
        recording.set_time("demonstration", sequence=index)
        recording.set_time("step", sequence=0)
        _log_observation(recording, demonstration.observation)
        facts = "\n".join(f"- {name}: {value}" for name, value in demonstration.info.items())
        seed = "" if demonstration.seed is None else f", seed {demonstration.seed}"
        text = f"# {demonstration.task} {index}{seed}\n\n{demonstration.seconds:.1f} s\n\n{facts}"
        recording.log("notes", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
        _log_trajectory(recording, demonstration.trajectory)
        for step, image in enumerate(demonstration.frames() if demonstration.frames is not None else ()):
            recording.set_time("step", sequence=step)
            recording.log("world/camera/rgb", rr.Image(image).compress(jpeg_quality=80))


def _log_observation(recording: rr.RecordingStream, observation: Observation) -> None:
    height, width = observation.depth.shape
    pose = observation.camera_pose
    recording.log("world/camera", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
    recording.log(
        "world/camera",
        rr.Pinhole(image_from_camera=observation.intrinsics, width=width, height=height, image_plane_distance=0.2),
    )
    recording.log("world/camera/rgb", rr.Image(observation.rgb))
    recording.log("world/camera/depth", rr.DepthImage(np.nan_to_num(observation.depth), meter=1.0))
    points, colours = observation.points(MAX_POINTS)
    recording.log("world/points", rr.Points3D(points, colors=colours, radii=POINT_M))


def _log_candidate(recording: rr.RecordingStream, index: int, candidate: Trajectory, plan: Plan) -> None:
    """A candidate's path, the fainter the lower its weight, and its weight at each step of the plan."""
    is_ignored = bool(plan.hallucinated[index])
    name = f"candidate {index + 1}" + (f", hallucinated from step {plan.onset[index]}" if is_ignored else "")
    pieces = _pieces(candidate)
    steps = np.linspace(0, 1, max(len(candidate) - 1, 1))
    weights = np.interp(steps, plan.trajectory.times, plan.weights[index]).repeat(candidate.num_arms)
    rgb = np.tile(HALLUCINATED if is_ignored else KEPT, (len(pieces), 1))
    colours = np.column_stack([rgb, 40 + 215 * weights]).astype(np.uint8)
    path = f"world/candidates/{index + 1}"
    recording.log(path, rr.LineStrips3D(pieces, colors=colours, radii=CANDIDATE_M))
    recording.log(f"{path}/name", rr.Points3D(candidate.tool_points[-1, :1], labels=name, radii=CANDIDATE_M))
    recording.log(f"weights/{index + 1}", rr.SeriesLines(names=name, colors=rgb[:1]), static=True)
    for step, weight in enumerate(plan.weights[index]):
        recording.set_time("step", sequence=step)
        recording.log(f"weights/{index + 1}", rr.Scalars(float(weight)))
    recording.reset_time()


def _pieces(trajectory: Trajectory) -> FloatArray:
    """Segments ``((T - 1)·A, 2, 3)`` of the way between the fingertips, step by step."""
    tips = trajectory.tool_points
    return np.stack([tips[:-1], tips[1:]], axis=2).reshape(-1, 2, 3)


def _log_trajectory(recording: rr.RecordingStream, trajectory: Trajectory) -> None:
    """The way between the fingertips, in one colour where the gripper is open and in another where it is closed, and
    the gripper at each step: from one fingertip over the gripper point to the other one."""
    pieces = _pieces(trajectory)
    closed = trajectory.gripper_state[:-1].ravel() > 0.5
    colours = np.where(closed[:, None], CLOSED, OPEN).astype(np.uint8)
    recording.log("world/plan", rr.LineStrips3D(pieces, colors=colours, radii=PATH_M))
    for step, (arms, state) in enumerate(zip(trajectory.triplets, trajectory.gripper_state, strict=True)):
        recording.set_time("step", sequence=step)
        shades = [CLOSED if closed > 0.5 else OPEN for closed in state]
        recording.log("world/plan/gripper", rr.LineStrips3D(arms[:, [1, 0, 2]], colors=shades, radii=PATH_M))


def _blueprint() -> Any:
    space = rrb.Spatial3DView(origin="/", contents=["+ /world/**", "- /world/camera/depth"], name="scene and paths")
    image = rrb.Spatial2DView(origin="/world/camera", contents=["+ $origin/**", "- $origin/depth"], name="camera")
    depth = rrb.Spatial2DView(origin="/world/camera", contents=["+ $origin/depth"], name="depth")
    weights = rrb.TimeSeriesView(origin="/weights", name="weights of the candidates")
    notes = rrb.TextDocumentView(origin="/notes", name="notes")
    side = rrb.Vertical(rrb.Tabs(image, depth), weights, notes)
    return rrb.Blueprint(rrb.Horizontal(space, side, column_shares=[3, 2]), rrb.TimePanel(state="collapsed"))
