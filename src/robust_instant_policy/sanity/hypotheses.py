"""Known mistakes of cameras and recordings, each with the correction that undoes it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, GripperTriangle, invert_pose, make_pose


@dataclass(frozen=True)
class Hypothesis:
    """``cause`` completes "with …", ``remedy`` says what to do; ``correct`` undoes the mistake in an observation."""

    cause: str
    remedy: str
    correct: Callable[[Observation], Observation]


def _of_pose(cause: str, remedy: str, change: Callable[[FloatArray], FloatArray]) -> Hypothesis:
    return Hypothesis(cause, remedy, lambda o: replace(o, camera_pose=change(o.camera_pose)))


def _of_intrinsics(cause: str, scale: tuple[float, float, float]) -> Hypothesis:
    x, y, centre = scale
    factors = np.array([[x, 1, centre], [1, y, centre], [1, 1, 1]])
    remedy = "use the intrinsics of the stream and resolution that depth and colour were taken with"
    return Hypothesis(cause, remedy, lambda o: replace(o, intrinsics=o.intrinsics * factors))


def _of_depth(factor: float, why: str) -> Hypothesis:
    return Hypothesis(
        f"depth multiplied by {factor:g}",
        f"check the depth unit{why}",
        lambda o: replace(o, depth=o.depth * np.float32(factor)),
    )


def _of_image(what: str, rows: int, cols: int) -> Hypothesis:
    return Hypothesis(
        f"the image {what}",
        "undo that in the camera's driver, for colour and depth",
        lambda o: replace(o, rgb=o.rgb[::rows, ::cols], depth=o.depth[::rows, ::cols]),
    )


def along_axis(observation: Observation) -> Observation:
    """Depth measured along the rays, turned into depth along the optical axis."""
    rows, cols = np.mgrid[: observation.depth.shape[0], : observation.depth.shape[1]]
    rays = np.stack([cols, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(observation.intrinsics).T
    return replace(observation, depth=(observation.depth / np.linalg.norm(rays, axis=-1)).astype(np.float32))


SMALLEST_RAD = 2 * np.pi * np.deg2rad(1.0)  # above what any rotation becomes whose radians are read as degrees
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
TURNS = (("turned upside down", -1, -1), ("mirrored left to right", 1, -1), ("flipped top to bottom", -1, 1))

OF_POSE = (
    _of_pose("the inverse camera pose", "camera_pose must map camera to world: invert it", invert_pose),
    _of_pose(
        "the transposed rotation of the camera pose",
        "transpose it: the columns of the rotation are the camera's axes in the world",
        lambda pose: make_pose(pose[:3, :3].T, pose[:3, 3]),
    ),
    _of_pose(
        "the camera's axes changed from OpenGL to OpenCV",
        "camera_pose must have OpenCV axes (x right, y down, z forward): negate its second and third column",
        lambda pose: pose @ OPENGL,
    ),
    _of_pose(
        "the inverse camera pose with axes changed from OpenGL to OpenCV",
        "invert camera_pose and negate its second and third column",
        lambda pose: invert_pose(pose) @ OPENGL,
    ),
)
OF_INTRINSICS = tuple(
    _of_intrinsics(f"a focal length (fx, fy of the intrinsics) {factor:.3g} times as long", (factor, factor, 1))
    for factor in (2.0, 0.5, 1 / 0.65, 0.65)
) + tuple(
    _of_intrinsics(f"intrinsics of a resolution {factor:g} times as large", (factor, factor, factor))
    for factor in (2.0, 0.5, 1.5, 2 / 3)
)
OF_DEPTH = (
    _of_depth(10.0, " (0.1 mm read as 1 mm?)"),
    _of_depth(0.1, " (1 mm read as 0.1 mm?)"),
    _of_depth(4.0, " (0.25 mm read as 0.1 mm, as with a RealSense D405?)"),
    _of_depth(0.25, " (0.1 mm read as 0.25 mm?)"),
    _of_depth(0.001, " (millimetres taken for metres)"),
    _of_depth(1000.0, " (divided by 1000 once too often)"),
    Hypothesis("depth along the optical axis in place of along the rays", "convert ray length to depth", along_axis),
)
OF_IMAGES = tuple(_of_image(*turn) for turn in TURNS)
DISPLACED = tuple(
    _of_pose(
        f"the camera moved by about {by * 100:+.0f} cm along the world's {'xyz'[axis]} axis",
        "the camera's pose is off, or the tool's offset: calibrate both again",
        lambda pose, axis=axis, by=by: make_pose(np.eye(3), by * np.eye(3)[axis]) @ pose,  # type: ignore[misc]
    )
    for axis in range(3)
    for by in (-0.15, -0.1, -0.05, 0.05, 0.1, 0.15)
)
ALL = OF_POSE + OF_INTRINSICS + OF_DEPTH + OF_IMAGES


def rotations_read_otherwise(triplets: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    """Each other reading of a rotation's numbers, and ``triplets (N, 3, 3)`` with the rotation that they give then."""
    triangle = GripperTriangle.from_triplets(triplets)
    poses = triangle.poses(triplets)
    now = Rotation.from_matrix(poses[:, :3, :3])
    angles = now.as_euler("xyz")
    readings = []
    if now.magnitude().max() < SMALLEST_RAD:
        readings.append(("Euler angles read as radians, not degrees", Rotation.from_euler("xyz", np.rad2deg(angles))))
    readings += [
        (f"quaternions read as {order}", Rotation.from_quat(np.roll(now.as_quat(), roll, axis=1)))
        for order, roll in (("wxyz", -1), ("xyzw", 1))
    ]
    for words, rotation in readings:
        poses[:, :3, :3] = rotation.as_matrix()
        yield words, triangle.triplets(poses)
