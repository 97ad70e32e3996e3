"""Faults that users and cameras make, as functions from sound demonstrations and a sound scene to corrupted copies.

``FAULTS`` maps a name to a `Fault`. Each is applied to all of the demonstrations, to the new scene, or to both, as
its ``where`` says; ``plan`` faults corrupt a plan. ``expected`` are the causes that name it rightly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.ndimage import binary_dilation, label
from scipy.spatial.transform import Rotation

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.geometry import FloatArray, GripperTriangle, invert_pose, make_pose, project
from robust_instant_policy.trajectory import STATE_INDEX, Trajectory

Where = Literal["demonstrations", "scene", "both"]
Demonstrations = list[Demonstration]
SEED = 7


@dataclass(frozen=True)
class Fault:
    """One fault: ``demonstrations`` and ``scene`` are the functions that corrupt them (None: left alone).

    ``plan`` corrupts a planned trajectory. ``expected`` are words of which one must stand in a finding's cause or
    message for the fault to be named rightly.
    """

    name: str
    expected: tuple[str, ...]
    demonstrations: Callable[[Sequence[Demonstration]], Demonstrations] | None = None
    scene: Callable[[Observation, Sequence[Demonstration]], Observation] | None = None
    plan: Callable[[Trajectory], Trajectory] | None = None


def camera(observation: Observation, pose: FloatArray) -> Observation:
    return replace(observation, camera_pose=pose)


def inverse_pose(o: Observation) -> Observation:
    return camera(o, invert_pose(o.camera_pose))


def transposed_rotation(o: Observation) -> Observation:
    return camera(o, make_pose(o.camera_pose[:3, :3].T, o.camera_pose[:3, 3]))


def opengl_axes(o: Observation) -> Observation:
    return camera(o, o.camera_pose @ np.diag([1.0, -1.0, -1.0, 1.0]))


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Callable[[Observation], Observation]:
    return lambda o: camera(o, make_pose(np.eye(3), (x, y, z)) @ o.camera_pose)


def turned(axis: str, degrees: float) -> Callable[[Observation], Observation]:
    """The camera's pose turned about itself, by the world's axes."""

    def apply(o: Observation) -> Observation:
        turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
        return camera(o, make_pose(turn @ o.camera_pose[:3, :3], o.camera_pose[:3, 3]))

    return apply


def focal(x: float, y: float, centre: float = 1.0) -> Callable[[Observation], Observation]:
    scale = np.array([[x, 1, centre], [1, y, centre], [1, 1, 1]])
    return lambda o: replace(o, intrinsics=o.intrinsics * scale)


def off_centre(pixels: float) -> Callable[[Observation], Observation]:
    def apply(o: Observation) -> Observation:
        shift = np.zeros((3, 3))
        shift[0, 2] = pixels * o.rgb.shape[1]
        return replace(o, intrinsics=o.intrinsics + shift)

    return apply


def depth_times(factor: float) -> Callable[[Observation], Observation]:
    return lambda o: replace(o, depth=o.depth * np.float32(factor))


def depth_plus(metres: float) -> Callable[[Observation], Observation]:
    return lambda o: replace(o, depth=np.where(o.depth > 0, o.depth + np.float32(metres), 0).astype(np.float32))


def ray_length(o: Observation) -> Observation:
    """Depth along the ray in place of along the axis."""
    rows, cols = np.mgrid[: o.depth.shape[0], : o.depth.shape[1]]
    rays = np.stack([cols, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(o.intrinsics).T
    return replace(o, depth=(o.depth * np.linalg.norm(rays, axis=-1)).astype(np.float32))


def disparity(o: Observation) -> Observation:
    return replace(o, depth=np.where(o.depth > 0, 0.5 / np.maximum(o.depth, 1e-3), 0).astype(np.float32))


def flipped(rows: int, cols: int, rgb: bool = True, depth: bool = True) -> Callable[[Observation], Observation]:
    """``rows`` and ``cols`` are 1 or -1; -1 turns that axis round."""

    def apply(o: Observation) -> Observation:
        return replace(
            o, rgb=o.rgb[::rows, ::cols] if rgb else o.rgb, depth=o.depth[::rows, ::cols] if depth else o.depth
        )

    return apply


def shifted_depth(pixels: int) -> Callable[[Observation], Observation]:
    """Depth that is not aligned to colour, by ``pixels`` of 256."""

    def apply(o: Observation) -> Observation:
        by = round(pixels * o.rgb.shape[1] / 256)
        return replace(o, depth=np.roll(o.depth, by, axis=1))

    return apply


def zoomed_depth(o: Observation) -> Observation:
    """Depth of a wider lens than colour: it fills the middle 70% only."""
    h, w = o.depth.shape
    rows = np.rint((np.arange(h) - h / 2) / 0.7 + h / 2).astype(int)
    cols = np.rint((np.arange(w) - w / 2) / 0.7 + w / 2).astype(int)
    inside = ((rows >= 0) & (rows < h))[:, None] & ((cols >= 0) & (cols < w))[None]
    return replace(o, depth=np.where(inside, o.depth[rows.clip(0, h - 1)][:, cols.clip(0, w - 1)], 0))


def bgr(o: Observation) -> Observation:
    return replace(o, rgb=o.rgb[..., ::-1])


def depth_stripe(o: Observation) -> Observation:
    """A band of rows reads 30% too near, across the whole image."""
    depth, height = o.depth.copy(), o.depth.shape[0]
    depth[int(0.4 * height) : int(0.55 * height)] *= np.float32(0.7)
    return replace(o, depth=depth)


def cropped(share: float) -> Callable[[Observation], Observation]:
    """The image cut on the left and at the top, with the intrinsics of the whole one."""

    def apply(o: Observation) -> Observation:
        by = round(share * o.rgb.shape[1])
        return replace(o, rgb=o.rgb[by:, by:], depth=o.depth[by:, by:])

    return apply


def no_depth(o: Observation) -> Observation:
    return replace(o, depth=np.zeros_like(o.depth))


def flat_depth(o: Observation) -> Observation:
    return replace(o, depth=np.full_like(o.depth, np.nanmedian(o.depth[o.depth > 0])))


def black(o: Observation) -> Observation:
    return replace(o, rgb=np.zeros_like(o.rgb))


def picture_moved(share: float) -> Callable[[Observation], Observation]:
    """What is seen after the camera was moved sideways by ``share`` of the image's width, its pose left as it was."""

    def apply(o: Observation) -> Observation:
        by = round(share * o.rgb.shape[1])
        index = np.clip(np.arange(o.rgb.shape[1]) + by, 0, o.rgb.shape[1] - 1)
        return replace(o, rgb=o.rgb[:, index], depth=o.depth[:, index])

    return apply


def picture_nearer(metres: float) -> Callable[[Observation], Observation]:
    """What is seen after the camera was lowered by ``metres``, its pose left as it was."""

    def apply(o: Observation) -> Observation:
        height = float(np.nanmedian(o.depth[o.depth > 0]))
        zoom = height / (height - metres)
        centre = o.intrinsics[[1, 0], 2]
        rows, cols = (
            np.clip(np.rint((np.arange(n) - c) / zoom + c).astype(int), 0, n - 1)
            for n, c in zip(o.depth.shape, centre, strict=True)
        )
        depth = o.depth[rows][:, cols]
        return replace(
            o,
            rgb=o.rgb[rows][:, cols],
            depth=np.where(depth > 0, depth - np.float32(metres), 0).astype(np.float32),
        )

    return apply


# Faults of the demonstrations alone.


def each(change: Callable[[Observation], Observation]) -> Callable[[Sequence[Demonstration]], Demonstrations]:
    return lambda ds: [replace(d, observation=change(d.observation)) for d in ds]


def actions(change: Callable[[FloatArray], FloatArray]) -> Callable[[Sequence[Demonstration]], Demonstrations]:
    """``change`` maps actions ``(T, A, 10)``."""

    def apply(ds: Sequence[Demonstration]) -> Demonstrations:
        changed = []
        for d in ds:
            own = d.trajectory.actions.reshape(len(d.trajectory), -1, STATE_INDEX + 1)
            new = change(own.copy()).reshape(len(own), -1)
            changed.append(replace(d, trajectory=Trajectory(new, d.trajectory.times)))
        return changed

    return apply


def points(change: Callable[[FloatArray], FloatArray]) -> Callable[[Sequence[Demonstration]], Demonstrations]:
    """``change`` maps points ``(T, A, 3, 3)``."""

    def on_actions(own: FloatArray) -> FloatArray:
        own[..., :STATE_INDEX] = change(own[..., :STATE_INDEX].reshape(*own.shape[:2], 3, 3)).reshape(
            *own.shape[:2], STATE_INDEX
        )
        return own

    return actions(on_actions)


def states(change: Callable[[FloatArray], FloatArray]) -> Callable[[Sequence[Demonstration]], Demonstrations]:
    def on_actions(own: FloatArray) -> FloatArray:
        own[..., STATE_INDEX] = change(own[..., STATE_INDEX])
        return own

    return actions(on_actions)


def quaternion_order(triplets: FloatArray) -> FloatArray:
    """Poses written as wxyz and read as xyzw."""
    triangle = GripperTriangle.from_triplets(triplets)
    poses = triangle.poses(triplets)
    xyzw = Rotation.from_matrix(poses[..., :3, :3].reshape(-1, 3, 3)).as_quat()
    wrong = Rotation.from_quat(np.roll(xyzw, 1, axis=1)).as_matrix()
    poses[..., :3, :3] = wrong.reshape(poses[..., :3, :3].shape)
    return triangle.triplets(poses)


def tool_along_x(triplets: FloatArray) -> FloatArray:
    """A tool frame whose approach is x, taken for z."""
    triangle = GripperTriangle.from_triplets(triplets)
    turn = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    return triangle.triplets(triangle.poses(triplets) @ make_pose(turn, (0, 0, 0)))


def flange(triplets: FloatArray) -> FloatArray:
    """The flange's pose taken for the tool's: everything 15 cm too high along the approach."""
    middle = triplets[..., 1:, :].mean(axis=-2)
    approach = middle - triplets[..., 0, :]
    return triplets - 0.15 * (approach / np.linalg.norm(approach, axis=-1, keepdims=True))[..., None, :]


def reversed_in_time(d: Demonstration) -> Demonstration:
    return replace(d, trajectory=Trajectory.from_actions(d.trajectory.actions[::-1]))


def arms_exchanged(own: FloatArray) -> FloatArray:
    return own[:, ::-1].copy()


def rotations(change: Callable[[Rotation], Rotation]) -> Callable[[FloatArray], FloatArray]:
    """The gripper turned about its tool point by a mistake in reading its rotation."""

    def apply(triplets: FloatArray) -> FloatArray:
        triangle = GripperTriangle.from_triplets(triplets)
        poses = triangle.poses(triplets)
        wrong = change(Rotation.from_matrix(poses[..., :3, :3].reshape(-1, 3, 3))).as_matrix()
        poses[..., :3, :3] = wrong.reshape(poses[..., :3, :3].shape)
        return triangle.triplets(poses)

    return apply


def radians_as_degrees(own: Rotation) -> Rotation:
    return Rotation.from_euler("xyz", own.as_euler("xyz"), degrees=True)


def degrees_as_radians(own: Rotation) -> Rotation:
    return Rotation.from_euler("xyz", own.as_euler("xyz", degrees=True))


def shuffled(ds: Sequence[Demonstration]) -> Demonstrations:
    return [replace(d, observation=ds[(i + 3) % len(ds)].observation) for i, d in enumerate(ds)]


def crossed(depth: bool) -> Callable[[Sequence[Demonstration]], Demonstrations]:
    """The depth, or the colour, of another episode."""

    def apply(ds: Sequence[Demonstration]) -> Demonstrations:
        others = [ds[(i + 3) % len(ds)].observation for i in range(len(ds))]
        return [
            replace(
                d,
                observation=replace(d.observation, depth=o.depth) if depth else replace(d.observation, rgb=o.rgb),
            )
            for d, o in zip(ds, others, strict=True)
        ]

    return apply


def one(change: Callable[[Demonstration], Demonstration], index: int = 4):
    return lambda ds: [change(d) if i == index else d for i, d in enumerate(ds)]


def mirrored_path(d: Demonstration) -> Demonstration:
    own = d.trajectory.actions.copy().reshape(len(d.trajectory), -1, 10)
    own[..., [1, 4, 7]] *= -1
    own[..., [0, 3, 6]] *= -1
    return replace(d, trajectory=Trajectory(own.reshape(len(own), -1), d.trajectory.times))


def lost_tracking(d: Demonstration) -> Demonstration:
    """The gripper is half a metre away at one step."""
    own = d.trajectory.actions.copy().reshape(len(d.trajectory), -1, 10)
    own[len(own) // 2, :, :9] += 0.5
    return replace(d, trajectory=Trajectory(own.reshape(len(own), -1), d.trajectory.times))


def longer(factor: int):
    def change(d: Demonstration) -> Demonstration:
        rows = np.repeat(d.trajectory.actions, factor, axis=0)
        return replace(d, trajectory=Trajectory.from_actions(rows))

    return change


def one_step(d: Demonstration) -> Demonstration:
    return replace(d, trajectory=Trajectory.from_actions(d.trajectory.actions[:1]))


def cut(d: Demonstration) -> Demonstration:
    return replace(d, trajectory=Trajectory.from_actions(d.trajectory.actions[: len(d.trajectory) // 3]))


def same_scene(ds: Sequence[Demonstration]) -> Demonstrations:
    return [ds[0]] * len(ds)


def duplicates(ds: Sequence[Demonstration]) -> Demonstrations:
    return [*ds[: len(ds) // 2], *ds[: len(ds) // 2]]


def half_moved(ds: Sequence[Demonstration]) -> Demonstrations:
    """The camera's pose is 10 cm off from the middle of the recording on."""
    half = len(ds) // 2
    return [*ds[:half], *each(moved(x=0.1))(ds[half:])]


def rates(value: float) -> Callable[[Sequence[Demonstration]], Demonstrations]:
    return lambda ds: [replace(d, rate_hz=value) for d in ds]


def tasks_mixed(ds: Sequence[Demonstration]) -> Demonstrations:
    return [replace(d, task="another") if i >= len(ds) // 2 else d for i, d in enumerate(ds)]


def scattered(sigma: float) -> Callable[[Sequence[Demonstration]], Demonstrations]:
    """Each path displaced on the table by its own error: a camera that is loose, or calibrated anew each time."""

    def apply(ds: Sequence[Demonstration]) -> Demonstrations:
        rng = np.random.default_rng(SEED)
        offsets = rng.normal(0, sigma, (len(ds), 2))
        return [points(lambda p, by=(x, y, 0.0): p + by)([d])[0] for d, (x, y) in zip(ds, offsets, strict=True)]

    return apply


def first(count: int) -> Callable[[Sequence[Demonstration]], Demonstrations]:
    return lambda ds: list(ds[:count])


def neighbouring(count: int) -> Callable[[Sequence[Demonstration]], Demonstrations]:
    """The demonstrations that begin their work nearest to the first one's: a corner of the table."""

    def apply(ds: Sequence[Demonstration]) -> Demonstrations:
        low = np.stack(
            [tips[tips[:, 2].argmin()] for tips in (d.trajectory.triplets[:, 0, 1:].mean(axis=1) for d in ds)]
        )
        return [ds[i] for i in np.argsort(np.linalg.norm(low - low[0], axis=1), kind="stable")[:count]]

    return apply


def half_hidden(o: Observation) -> Observation:
    """The left half of what stands above the table is covered by something that looks like the table."""
    table = float(np.median(o.depth[o.depth > 0]))
    raised = (o.depth > 0) & (o.depth < table - 0.015)
    if not raised.any():
        return o
    columns = np.flatnonzero(raised.any(axis=0))
    hidden = raised & (np.arange(o.depth.shape[1]) < np.median(columns))
    rgb, depth = o.rgb.copy(), o.depth.copy()
    rgb[hidden], depth[hidden] = np.median(o.rgb.reshape(-1, 3), axis=0), table
    return replace(o, rgb=rgb, depth=depth)


def turned_camera(o: Observation, degrees: float) -> Observation:
    turn = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    return replace(o, camera_pose=o.camera_pose @ make_pose(turn, (0, 0, 0)))


def raised_pixels(o: Observation) -> tuple[FloatArray, FloatArray]:
    """Rows and columns of the pixels that stand above the table."""
    table = float(np.median(o.depth[o.depth > 0]))
    return np.nonzero((o.depth > 0) & (o.depth < table - 0.015))


def without_depth(o: Observation, pixels: FloatArray, radius_m: float = 0.025) -> Observation:
    """No depth within ``radius_m`` of ``pixels (N, 2)``, as on glass or polished metal."""
    depth = o.depth.copy()
    reach = radius_m * o.intrinsics[0, 0] / np.median(depth[depth > 0])
    rows, cols = np.indices(depth.shape)
    for u, v in pixels:
        depth[(cols - u) ** 2 + (rows - v) ** 2 < reach**2] = 0
    return replace(o, depth=depth)


def no_depth_at_grasps(d: Demonstration) -> Demonstration:
    """No depth where grippers close, or else where the lowest fingertip is."""
    closed = d.trajectory.gripper_state > 0.5
    steps, arms = np.nonzero(closed[1:] & ~closed[:-1])
    middles = d.trajectory.triplets[:, :, 1:].mean(axis=2)
    if not len(steps):
        steps, arms = np.array(np.unravel_index([middles[..., 2].argmin()], middles.shape[:2]))
    pixels = project(middles[steps, arms], d.observation.intrinsics, d.observation.camera_pose)
    return replace(d, observation=without_depth(d.observation, pixels))


def no_depth_on_a_thing(o: Observation) -> Observation:
    """No depth on what stands in the middle of what stands above the table."""
    rows, cols = raised_pixels(o)
    middle = np.argmin((rows - np.median(rows)) ** 2 + (cols - np.median(cols)) ** 2)
    return without_depth(o, np.array([[cols[middle], rows[middle]]]))


def eight_bits(observation: Observation) -> Observation:
    """Depth in steps of 8 mm of a table that is tilted by 0.3 m over the image: a flat one has a few levels anyway."""
    tilt = np.linspace(0, 0.3, observation.depth.shape[1], dtype=np.float32)
    return replace(observation, depth=np.rint((observation.depth + tilt) * 127) / np.float32(127))


def twice(o: Observation) -> Observation:
    """What stands above the table a second time, where the table is free; unchanged where there is no room."""
    rows, cols = raised_pixels(o)
    height, width = o.depth.shape
    taken = np.zeros(o.depth.shape, dtype=bool)
    taken[rows, cols] = True
    shifts = [(down, right) for down in range(-height, height, 10) for right in range(-width, width, 10)]
    for down, right in sorted(shifts, key=lambda shift: shift[0] ** 2 + shift[1] ** 2):
        there = rows + down, cols + right
        inside = (np.array(there) >= 0).all() and there[0].max() < height and there[1].max() < width
        if inside and not taken[there].any():
            rgb, depth = o.rgb.copy(), o.depth.copy()
            rgb[there], depth[there] = o.rgb[rows, cols], o.depth[rows, cols]
            return replace(o, rgb=rgb, depth=depth)
    return o


def replaced(o: Observation) -> Observation:
    """What stands in the middle of what stands above the table is gone, and a red block stands in the upper left."""
    rows, cols = raised_pixels(o)
    raised = np.zeros(o.depth.shape, dtype=bool)
    raised[rows, cols] = True
    things, _ = label(binary_dilation(raised, iterations=3))
    middle = np.argmin((rows - np.median(rows)) ** 2 + (cols - np.median(cols)) ** 2)
    gone = things == things[rows[middle], cols[middle]]
    rgb, depth = o.rgb.copy(), o.depth.copy()
    rgb[gone], depth[gone] = np.median(o.rgb[~raised], axis=0), np.median(o.depth[o.depth > 0])
    height, width = o.depth.shape
    block = np.s_[height // 10 : height // 5, width // 10 : width // 6]
    rgb[block], depth[block] = (200, 30, 30), depth[block] - 0.05
    return replace(o, rgb=rgb, depth=depth)


# Faults of a plan.


def plan_points(change: Callable[[FloatArray], FloatArray]) -> Callable[[Trajectory], Trajectory]:
    def apply(plan: Trajectory) -> Trajectory:
        own = plan.actions.reshape(len(plan), -1, 10).copy()
        own[..., :STATE_INDEX] = change(own[..., :STATE_INDEX].reshape(*own.shape[:2], 3, 3)).reshape(
            *own.shape[:2], STATE_INDEX
        )
        return Trajectory(own.reshape(len(plan), -1), plan.times)

    return apply


def jump(metres: float) -> Callable[[FloatArray], FloatArray]:
    def change(own: FloatArray) -> FloatArray:
        own[len(own) // 2] += [metres, 0, 0]
        return own

    return change


def spin(degrees: float) -> Callable[[FloatArray], FloatArray]:
    """One step's gripper turned about its approach."""

    def change(own: FloatArray) -> FloatArray:
        triangle = GripperTriangle.from_triplets(own)
        poses = triangle.poses(own)
        poses[len(own) // 2] = poses[len(own) // 2] @ make_pose(
            Rotation.from_euler("z", degrees, degrees=True).as_matrix(), (0, 0, 0)
        )
        return triangle.triplets(poses)

    return change


def about_the_fingertips(own: FloatArray) -> FloatArray:
    """The gripper point below the fingertips."""
    return 2 * own[..., 1:, :].mean(axis=-2, keepdims=True) - own


def lower(metres: float) -> Callable[[FloatArray], FloatArray]:
    return lambda own: own - [0, 0, metres]


def plan_states(change: Callable[[FloatArray], FloatArray]) -> Callable[[Trajectory], Trajectory]:
    def apply(plan: Trajectory) -> Trajectory:
        own = plan.actions.copy()
        own[:, STATE_INDEX::10] = change(own[:, STATE_INDEX::10])
        return Trajectory(own, plan.times)

    return apply


def flutter(state: FloatArray) -> FloatArray:
    state[len(state) // 2 :: 2] = 1 - state[len(state) // 2 :: 2]
    return state


def _image_faults() -> dict[str, tuple[Callable[[Observation], Observation], tuple[str, ...]]]:
    """Faults that an observation may have, with the words that name them."""
    return {
        "inverse-pose": (inverse_pose, ("inverse camera pose",)),
        "transposed-rotation": (transposed_rotation, ("transposed", "inverse camera pose")),
        "opengl-axes": (opengl_axes, ("OpenGL",)),
        "fx-half": (focal(0.5, 1), ("focal length", "fx")),
        "f-half": (focal(0.5, 0.5), ("intrinsics", "focal length")),
        "f-half-and-centre": (focal(0.5, 0.5, 0.5), ("intrinsics", "resolution", "principal point")),
        "f-0.65": (focal(0.65, 0.65), ("intrinsics", "focal length")),
        "f-double": (focal(2, 2), ("intrinsics", "focal length")),
        "f-double-and-centre": (focal(2, 2, 2), ("intrinsics", "resolution", "principal point")),
        "fx-negative": (focal(-1, 1), ("negative", "focal length")),
        "off-centre": (off_centre(0.3), ("principal point", "intrinsics")),
        "millimetres": (depth_times(1000), ("millimetres",)),
        "depth-0.1": (depth_times(0.1), ("depth",)),
        "depth-10": (depth_times(10), ("depth",)),
        "depth-0.25": (depth_times(0.25), ("depth",)),
        "depth-0.9": (depth_times(0.9), ("depth", "table")),
        "depth-plus-5cm": (depth_plus(0.05), ("depth", "table", "camera")),
        "ray-length": (ray_length, ("ray", "depth", "flat")),
        "disparity": (disparity, ("depth",)),
        "upside-down": (flipped(-1, -1), ("upside down", "flipped", "mirrored", "turned")),
        "mirrored": (flipped(1, -1), ("mirrored", "flipped")),
        "flipped": (flipped(-1, 1), ("flipped", "mirrored")),
        "rgb-mirrored": (flipped(1, -1, depth=False), ("colour", "mirrored")),
        "rgb-upside-down": (flipped(-1, -1, depth=False), ("colour", "turned", "upside down")),
        "depth-mirrored": (flipped(1, -1, rgb=False), ("depth", "mirrored")),
        "depth-flipped": (flipped(-1, 1, rgb=False), ("depth", "flipped")),
        "depth-not-aligned": (shifted_depth(24), ("colour", "aligned", "depth")),
        "depth-6px": (shifted_depth(6), ("displaced",)),
        "depth-other-lens": (zoomed_depth, ("colour", "aligned", "depth")),
        "camera-10cm-low": (moved(z=-0.1), ("camera", "table")),
        "camera-10cm-high": (moved(z=0.1), ("camera", "table")),
        "camera-10cm-x": (moved(x=0.1), ("camera",)),
        "camera-10cm-y": (moved(y=0.1), ("camera",)),
        "camera-5deg-roll": (turned("x", 5), ("camera", "table")),
        "camera-5deg-yaw": (turned("z", 5), ("camera",)),
        "camera-180deg-yaw": (turned("z", 180), ("camera",)),
        "camera-3cm-low": (moved(z=-0.03), ("camera", "table", "above")),
        "camera-3cm-x": (moved(x=0.03), ("camera", "displaced")),
        "cropped-3%": (cropped(0.03), ("crop", "principal point")),
        "cropped-10%": (cropped(0.1), ("crop", "principal point")),
        "depth-stripe": (depth_stripe, ("rows",)),
        "no-depth": (no_depth, ("depth",)),
        "flat-depth": (flat_depth, ("depth", "raised")),
        "black": (black, ("colour", "dark", "black")),
        "bgr": (bgr, ("BGR", "colour", "channels")),
    }


def _faults() -> dict[str, Fault]:
    found: dict[str, Fault] = {}

    def add(name: str, expected: tuple[str, ...], **functions) -> None:
        found[name] = Fault(name, expected, **functions)

    for name, (change, expected) in _image_faults().items():
        add(f"{name}:both", expected, demonstrations=each(change), scene=lambda o, _, c=change: c(o))
        add(f"{name}:scene", expected, scene=lambda o, _, c=change: c(o))
        add(f"{name}:demos", expected, demonstrations=each(change))
    add("moved-sideways:scene", ("camera", "moved"), scene=lambda o, _: picture_moved(0.12)(o))
    add("moved-sideways-3%:scene", ("camera", "moved"), scene=lambda o, _: picture_moved(0.03)(o))
    add("lowered:scene", ("camera", "moved", "table"), scene=lambda o, _: picture_nearer(0.1)(o))
    add("depth-of-another:scene", ("colour", "depth"), scene=lambda o, ds: replace(o, depth=ds[0].observation.depth))
    add("rgb-of-another:scene", ("colour", "depth"), scene=lambda o, ds: replace(o, rgb=ds[0].observation.rgb))
    add("depth-of-another:demos", ("colour", "depth", "another"), demonstrations=crossed(True))
    add("rgb-of-another:demos", ("colour", "depth", "another"), demonstrations=crossed(False))
    add("shuffled:demos", ("other images", "shuffled"), demonstrations=shuffled)
    add("camera-half-moved:demos", ("camera",), demonstrations=half_moved)
    add("actions-mm:demos", ("millimetres",), demonstrations=points(lambda p: p * 1000))
    add("actions-cm:demos", ("centimetres",), demonstrations=points(lambda p: p * 100))
    add("quaternion-order:demos", ("quaternion",), demonstrations=points(quaternion_order))
    add("tool-along-x:demos", ("tool", "gripper"), demonstrations=points(tool_along_x))
    add("flange:demos", ("surface", "tool", "camera"), demonstrations=points(flange))
    add("paths-3cm-x:demos", ("displaced",), demonstrations=points(lambda p: p + np.array([0.03, 0, 0])))
    add("paths-3cm-y:demos", ("displaced",), demonstrations=points(lambda p: p + np.array([0, 0.03, 0])))
    add("paths-3cm-up:demos", ("above", "surface"), demonstrations=points(lambda p: p + np.array([0, 0, 0.03])))
    add("reversed:demos", ("backwards",), demonstrations=lambda ds: [reversed_in_time(d) for d in ds])
    add("arms-exchanged:demos", ("which arm",), demonstrations=actions(arms_exchanged))
    add("radians-as-degrees:demos", ("degrees",), demonstrations=points(rotations(radians_as_degrees)))
    add("degrees-as-radians:demos", ("radians", "rotation"), demonstrations=points(rotations(degrees_as_radians)))
    add("axes-swapped:demos", ("axes", "x and y"), demonstrations=points(lambda p: p[..., [1, 0, 2]]))
    add("base-frame:demos", ("surface", "camera"), demonstrations=points(lambda p: p + np.array([0.5, 0, 0])))
    add("state-255:demos", ("0 or 1",), demonstrations=states(lambda g: g * 255))
    add("state-half:demos", ("0 or 1",), demonstrations=states(lambda g: g * 0.5))
    add("state-minus:demos", ("0 or 1",), demonstrations=states(lambda g: g * 2 - 1))
    add("state-inverted:demos", ("inverted", "closed"), demonstrations=states(lambda g: 1 - g))
    add("fps-0:demos", ("rate",), demonstrations=rates(0.0))
    add("fps-negative:demos", ("rate",), demonstrations=rates(-10.0))
    add("fps-nan:demos", ("rate",), demonstrations=rates(float("nan")))
    add("one-step:demos", ("step",), demonstrations=one(one_step))
    add("jump-0.5m:demos", ("tracking",), demonstrations=one(lost_tracking))
    add("rate-0.001:demos", ("rate",), demonstrations=rates(1e-3))
    add("100x-longer:demos", ("long",), demonstrations=one(longer(100)))
    add("cut-off:demos", ("contradict", "others", "short"), demonstrations=one(cut))
    add("contradicts:demos", ("demonstration 4", "contradict"), demonstrations=one(mirrored_path))
    add("one-scene:demos", ("one scene", "same"), demonstrations=same_scene)
    add("duplicates:demos", ("same", "duplicate"), demonstrations=duplicates)
    add("tasks-mixed:demos", ("task",), demonstrations=tasks_mixed)
    for centimetres in (1, 2, 4):
        add(f"scattered-{centimetres}cm:demos", ("contradict", "repeat"), demonstrations=scattered(centimetres / 100))
    for count in (1, 2, 3):
        add(f"first-{count}:demos", (), demonstrations=first(count))
    add("neighbouring-4:demos", ("outside",), demonstrations=neighbouring(4))
    add("pitch-1deg:scene", ("said to be",), scene=lambda o, _: turned_camera(o, 1.0))
    add("depth-8-bit:scene", ("8 bits",), scene=lambda o, _: eight_bits(o))
    add("grey:scene", ("infrared",), scene=lambda o, _: replace(o, rgb=o.rgb[..., [1, 1, 1]]))
    add("half-hidden:scene", ("recognised",), scene=lambda o, _: half_hidden(o))
    add("no-depth-at-grasps:demos", ("depth",), demonstrations=lambda ds: list(map(no_depth_at_grasps, ds)))
    add("no-depth-on-a-thing:scene", ("depth",), scene=lambda o, _: no_depth_on_a_thing(o))
    add("twice:scene", ("looks like",), scene=lambda o, _: twice(o))
    add("replaced:scene", ("recognised",), scene=lambda o, _: replaced(o))
    add("jump-0.8m:plan", ("step", "m from"), plan=plan_points(jump(0.8)))
    add("jump-0.3m:plan", ("step", "m from"), plan=plan_points(jump(0.3)))
    add("turn-179:plan", ("turn",), plan=plan_points(spin(179.0)))
    add("turn-90:plan", ("turn",), plan=plan_points(spin(90.0)))
    add("times-10:plan", ("position", "outside"), plan=plan_points(lambda p: p * 10))
    add("into-the-table:plan", ("table", "low"), plan=plan_points(lower(0.09)))
    add("too-low-3cm:plan", ("table", "low"), plan=plan_points(lower(0.03)))
    add("never-closes:plan", ("gripper",), plan=plan_states(np.zeros_like))
    add("flutter:plan", ("gripper",), plan=plan_states(flutter))
    add("collapsed:plan", ("finger", "gripper"), plan=plan_points(lambda p: np.repeat(p[..., 1:2, :], 3, axis=-2)))
    add("upside-down:plan", ("turn", "approach", "gripper"), plan=plan_points(about_the_fingertips))
    return found


FAULTS = _faults()
