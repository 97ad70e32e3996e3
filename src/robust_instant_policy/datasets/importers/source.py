"""An episode of another format, and its conversion to a demonstration or to a list of missing data."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robust_instant_policy.checks import checked_array, checked_pose, checked_positive
from robust_instant_policy.datasets.importers.joints import JointModel
from robust_instant_policy.datasets.importers.layouts import ROTATIONS
from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import DatasetError, InvalidValueError
from robust_instant_policy.files import excerpt
from robust_instant_policy.geometry import FloatArray, GripperTriangle
from robust_instant_policy.trajectory import Trajectory


@dataclass(frozen=True)
class GripperCommand:
    """Meaning of recorded gripper values: those of ``open`` and ``closed``."""

    open: float
    closed: float

    def __post_init__(self) -> None:
        if not (np.isfinite([self.open, self.closed]).all() and self.open != self.closed):
            raise InvalidValueError(f"open and closed must be two different numbers, got {self.open} and {self.closed}")

    def state(self, values: ArrayLike) -> FloatArray:
        """Gripper state of ``values``, of any shape: 0 nearer to open, 1 nearer to closed."""
        values = np.asarray(values, dtype=np.float64)
        return (np.abs(values - self.closed) < np.abs(values - self.open)).astype(np.float64)


@dataclass(frozen=True, eq=False)
class Rig:
    """What the user knows about the robot and the camera of a recording, for data that the file does not contain.

    ``triangle`` is the gripper of the imported trajectories, that of the executing robot. ``camera`` names the camera
    of the start image. ``intrinsics (3, 3)``, ``camera_pose (4, 4)`` camera to world, OpenCV axes; ``tool (4, 4)`` the
    tool frame of `geometry` within the recorded end-effector frame; ``gripper`` the meaning of the last action or of
    the gripper's position; ``rate_hz`` the rate of the frames, in place of their timestamps.

    For LeRobot datasets, ``depth_key`` is the feature with the depth and ``depth_unit_m`` the metres per step, where
    the dataset does not say it; ``pose_key`` the one with the poses, ``rotation`` one of `layouts.ROTATIONS`, where
    names leave it open; ``position_unit_m`` and ``rotation_unit_rad`` the metres and radians per step of positions and
    angles; ``joints`` makes poses of joints, with one model for each arm, the left one first.
    Raises `InvalidValueError` for an unknown ``rotation``, a ``tool`` or ``camera_pose`` that is not rigid, and a rate
    or unit that is not positive.
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
    pose_key: str | None = None
    rotation: str | None = None
    position_unit_m: float = 1.0
    rotation_unit_rad: float = 1.0
    joints: JointModel | tuple[JointModel, ...] | None = None

    def __post_init__(self) -> None:
        if self.rotation is not None and self.rotation not in ROTATIONS:
            raise InvalidValueError(f"rotation must be one of {', '.join(ROTATIONS)}, got {self.rotation!r}")
        if isinstance(self.joints, tuple) and len(self.joints) != 2:
            raise InvalidValueError(f"joints must be one model, or two for two arms, got {len(self.joints)}")
        if self.intrinsics is not None:
            checked_array("intrinsics", self.intrinsics, "(3, 3)")
        for name in ("camera_pose", "tool"):
            if getattr(self, name) is not None:
                checked_pose(name, getattr(self, name))
        for name in ("rate_hz", "depth_unit_m", "position_unit_m", "rotation_unit_rad"):
            if getattr(self, name) is not None:
                checked_positive(name, getattr(self, name))


@dataclass(frozen=True, eq=False)
class SourceEpisode:
    """The data of a file about one episode; None for missing data.

    ``rgb``, ``depth`` (metres), ``intrinsics``, ``camera_pose`` as in `Observation`; ``poses (T, A, 4, 4)`` of the end
    effectors of A arms in the world; ``tool (4, 4)``, the tool frame of `geometry` within the end effector's own;
    ``gripper_values (T, A)`` and their meaning. The arms' axis may be left out where there is one arm.
    ``images`` returns ``(T, H, W, 3)`` uint8 of all steps.
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
        if self.poses.shape[:-2] != self.gripper_values.shape:
            poses, grippers = self.poses.shape[:-2], self.gripper_values.shape
            raise DatasetError(
                f"{self.name} has poses of {poses[0]} steps and {(*poses, 1)[1]} arms, but gripper values of "
                f"{grippers[0]} steps and {(*grippers, 1)[1]} arms"
            )
        if not np.isfinite(self.gripper_values).all():
            raise DatasetError(f"{self.name} is damaged: its gripper values are not all finite")
        try:
            trajectory = Trajectory.from_poses(
                self.poses @ self.tool, self.gripper.state(self.gripper_values), triangle
            )
            depth = self.depth
            if depth.ndim < 3 <= self.rgb.ndim and depth.size == self.rgb.shape[0] * self.rgb.shape[1]:
                depth = depth.reshape(self.rgb.shape[:2])  # it may be stored as one row of numbers
            observation = Observation(self.rgb, depth, self.intrinsics, self.camera_pose)
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
            "intrinsics": "the camera's intrinsics (in the rig: intrinsics, 3 x 3)",
            "camera_pose": "the camera's pose in the world (in the rig: camera_pose, 4 x 4, OpenCV axes)",
            "tool": "the tool frame within the end effector's (in the rig: tool, 4 x 4: z out of the gripper, "
            "y along the line on which the fingers open, origin between the fingertips)",
            "gripper": f"the meaning of its gripper values{span} (in the rig: gripper, with open and closed)",
            "rate_hz": "the recording rate (in the rig: rate_hz)",
        }
        return [description for name, description in needs.items() if getattr(self, name) is None]


def choose_camera(path: Path, cameras: Sequence[str], wanted: str | None) -> str | None:
    """The camera ``wanted``, or the only one. Raises `DatasetError` with the available ones."""
    if wanted is None and len(cameras) <= 1:
        return cameras[0] if cameras else None
    if wanted not in cameras:
        problem = "has several cameras" if wanted is None else f"has no camera {wanted!r}"
        raise DatasetError(f"{path} {problem}; give camera, one of: {excerpt(', '.join(cameras)) or 'none'}")
    return wanted
