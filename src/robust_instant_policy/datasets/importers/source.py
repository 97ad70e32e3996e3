"""An episode of another format, and its conversion to a demonstration or to a list of missing data."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import DatasetError, InvalidValueError
from robust_instant_policy.geometry import FloatArray, GripperTriangle
from robust_instant_policy.trajectory import Trajectory

MIN_QUATERNION = 1e-6  # shorter quaternions have no direction


@dataclass(frozen=True)
class GripperCommand:
    """Meaning of recorded gripper values: those of ``open`` and ``closed``."""

    open: float
    closed: float

    def __post_init__(self) -> None:
        if not (np.isfinite([self.open, self.closed]).all() and self.open != self.closed):
            raise InvalidValueError(f"open and closed must be two different numbers, got {self.open} and {self.closed}")

    def state(self, values: ArrayLike) -> FloatArray:
        """Gripper state of ``values (T,)``: 0 nearer to open, 1 nearer to closed."""
        values = np.asarray(values, dtype=np.float64)
        return (np.abs(values - self.closed) < np.abs(values - self.open)).astype(np.float64)


def poses_of(name: str, numbers: NDArray, rotation: Sequence[int]) -> FloatArray:
    """Poses ``(T, 4, 4)`` of ``numbers (T, D)``: three coordinates, and the rotation in the columns ``rotation``, three
    of a rotation vector or four of a quaternion x, y, z, w.

    Raises `DatasetError` that begins with ``name`` if they are not poses.
    """
    if numbers.ndim != 2 or numbers.shape[1] < 3 + len(rotation) or not np.isfinite(numbers).all():
        raise DatasetError(f"{name}: poses must be finite, (T, {3 + len(rotation)}), got {numbers.shape}")
    turns = numbers[:, list(rotation)].astype(np.float64)
    if len(rotation) == 4 and np.linalg.norm(turns, axis=1).min() < MIN_QUATERNION:
        raise DatasetError(f"{name}: quaternions must have length 1, and one is 0")
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    poses[:, :3, :3] = (Rotation.from_quat if len(rotation) == 4 else Rotation.from_rotvec)(turns).as_matrix()
    poses[:, :3, 3] = numbers[:, :3]
    return poses


@dataclass(frozen=True, eq=False)
class Rig:
    """What the user knows about the robot and the camera of a recording, for data that the file does not contain.

    ``triangle`` is the gripper of the imported trajectories, that of the executing robot. ``camera`` names the camera
    of the start image. ``intrinsics (3, 3)``, ``camera_pose (4, 4)`` camera to world, OpenCV axes; ``tool (4, 4)`` the
    tool frame of `geometry` within the recorded end-effector frame; ``gripper`` the meaning of the last action or of
    the gripper's position; ``rate_hz`` the rate of the frames. For LeRobot datasets, ``depth_key`` is the feature with
    the depth and ``depth_unit_m`` the metres per step.
    """

    triangle: GripperTriangle
    camera: str | None = None
    intrinsics: FloatArray | None = None
    camera_pose: FloatArray | None = None
    tool: FloatArray | None = None
    gripper: GripperCommand | None = None
    rate_hz: float | None = None
    depth_key: str | None = None
    depth_unit_m: float | None = None


@dataclass(frozen=True, eq=False)
class SourceEpisode:
    """The data of a file about one episode; None for missing data.

    ``rgb``, ``depth`` (metres), ``intrinsics``, ``camera_pose`` as in `Observation`; ``poses (T, 4, 4)`` of the
    end effector in the world; ``tool (4, 4)``, the tool frame of `geometry` within the end effector's own;
    ``gripper_values (T,)`` and their meaning. ``images`` returns ``(T, H, W, 3)`` uint8 of all steps.
    ``advice`` says how to obtain a file with the missing data.
    """

    name: str
    rgb: NDArray[np.uint8] | None = None
    depth: NDArray[np.float32] | None = None
    intrinsics: FloatArray | None = None
    camera_pose: FloatArray | None = None
    poses: FloatArray | None = None
    tool: FloatArray | None = None
    gripper_values: FloatArray | None = None
    gripper: GripperCommand | None = None
    rate_hz: float | None = None
    images: Callable[[], NDArray[np.uint8]] | None = None
    info: Mapping[str, str | float | int] = field(default_factory=dict)
    advice: str = ""

    def on(self, rig: Rig) -> SourceEpisode:
        """The episode with the data of ``rig``, which override those of the file."""
        names = ("intrinsics", "camera_pose", "tool", "gripper", "rate_hz")
        known = {name: getattr(rig, name) for name in names if getattr(rig, name) is not None}
        return replace(self, **known)

    def demonstration(self, task: str, triangle: GripperTriangle) -> Demonstration:
        """Raises `DatasetError` that lists all missing data of a demonstration."""
        if (
            self.poses is None
            or self.gripper_values is None
            or self.rgb is None
            or self.depth is None
            or self.intrinsics is None
            or self.camera_pose is None
            or self.tool is None
            or self.gripper is None
            or self.rate_hz is None
        ):
            raise DatasetError(f"{self.name} lacks {'; '.join(self._missing())}{self.advice and '. ' + self.advice}")
        if len(self.poses) != len(self.gripper_values):
            raise DatasetError(
                f"{self.name} is damaged: it has {len(self.poses)} poses and {len(self.gripper_values)} gripper values"
            )
        if not np.isfinite(self.gripper_values).all():
            raise DatasetError(f"{self.name} is damaged: its gripper values are not all finite")
        try:
            trajectory = Trajectory.from_poses(
                self.poses @ self.tool, self.gripper.state(self.gripper_values), triangle
            )
            observation = Observation(self.rgb, self.depth, self.intrinsics, self.camera_pose)
            return Demonstration(observation, trajectory, self.rate_hz, task, info=self.info)
        except InvalidValueError as error:
            raise DatasetError(f"{self.name}: {error}") from error

    def _missing(self) -> list[str]:
        values = self.gripper_values
        span = "" if values is None else f", which lie between {values.min():g} and {values.max():g}"
        needs = {
            "poses": "end-effector poses",
            "gripper_values": "the gripper's commands or positions",
            "rgb": "a colour image of the start",
            "depth": "a depth image of the start",
            "intrinsics": "the camera's intrinsics (known? Rig(intrinsics=), 3 x 3)",
            "camera_pose": "the camera's pose in the world (known? Rig(camera_pose=), 4 x 4, OpenCV axes)",
            "tool": "the tool frame within the end effector's (known? Rig(tool=), 4 x 4: z out of the gripper, "
            "y along the line on which the fingers open, origin between the fingertips)",
            "gripper": f"the meaning of its gripper values{span} (known? Rig(gripper=GripperCommand(open=, closed=)))",
            "rate_hz": "the recording rate (known? Rig(rate_hz=))",
        }
        return [description for name, description in needs.items() if getattr(self, name) is None]
