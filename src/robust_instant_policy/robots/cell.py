"""The description of a cell: one TOML file that names arms, grippers, camera, workspace and limits.

Lengths are in metres and joint angles in radians; ``turn_per_step`` and the orientation in ``base`` are in degrees.
``docs/robots.md`` explains each key. File names are relative to the file.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from robust_instant_policy.errors import CellError, DatasetError
from robust_instant_policy.files import read_regular
from robust_instant_policy.geometry import FloatArray, GripperTriangle, make_pose
from robust_instant_policy.motion.checks import TABLE_TOLERANCE_M
from robust_instant_policy.motion.limits import (
    ARM_DISTANCE_M,
    FOLLOWING_ERROR_RAD,
    LINK_DISTANCE_M,
    STEP_M,
    TURN_PER_STEP_RAD,
    Limits,
)

CELLS = Path(__file__).with_name("cells")  # those that come with the package: emulated ones
MIN_CONFIDENCE = 0.9  # of a plan; below it `rip run` refuses (docs/trust.md)
LARGEST = sys.float_info.max  # TOML has integers of any length, and inf
FAR_M = 5.0  # from the world's origin; more is a length in millimetres
SPEEDS = {"joint_speed": 2 * math.pi, "joint_acceleration": 100.0, "tool_speed": 2.0}  # rad/s, rad/s², m/s at most
PACES = 0.1, 1000.0
PORTS = ("port", "address", "device")  # keys by which a driver or leader finds its device
FIRST_RUN_SPEED = 0.25  # share of the usual speed, until a first run in a cell has ended well


class Section:
    """A table of a TOML file. Its keys are read one by one; errors name the file, the key and the expected value."""

    def __init__(self, values: Mapping[str, Any], where: str):
        self._values, self._where = dict(values), where

    def __contains__(self, key: str) -> bool:
        return key in self._values

    def text(self, key: str, default: str | None = None, choices: Sequence[str] = ()) -> str:
        value = self._take(key, default)
        if not isinstance(value, str) or (choices and value not in choices):
            raise self.error(key, f"must be {'one of ' + ', '.join(choices) if choices else 'text'}, not {value!r}")
        return value

    def number(self, key: str, default: float | None = None, least: float = -LARGEST, most: float = LARGEST) -> float:
        value = self._take(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
            raise self.error(key, f"must be a number from {least:g} to {most:g}, not {value!r}")
        return float(value)

    def whole(self, key: str, default: int | None = None, least: int = 0, most: float = math.inf) -> int:
        value = self._take(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            words = f"of at least {least}" if math.isinf(most) else f"from {least} to {most:g}"
            raise self.error(key, f"must be a whole number {words}, not {value!r}")
        return value

    def flag(self, key: str, default: bool | None = None) -> bool:
        value = self._take(key, default)
        if not isinstance(value, bool):
            raise self.error(key, f"must be true or false, not {value!r}")
        return value

    def array(self, key: str, shape: tuple[int | None, ...], default: object = None) -> FloatArray:
        """A finite array; None in ``shape`` stands for any length."""
        value = self._take(key, default)
        words = " x ".join("N" if size is None else str(size) for size in shape)
        try:
            array = np.array(value, dtype=np.float64)
        except (ValueError, TypeError, OverflowError):
            raise self.error(key, f"must be {words} numbers, not {str(value)[:80]}") from None
        fits = array.ndim == len(shape) and all(
            want in (size, None) for size, want in zip(array.shape, shape, strict=True)
        )
        if not fits or not np.isfinite(array).all():
            raise self.error(key, f"must be {words} finite numbers, not {str(value)[:80]}")
        array.flags.writeable = False
        return array

    def pose(self, key: str) -> FloatArray:
        """A pose ``(4, 4)``, metres: a rotation and a position that is not far away."""
        pose = self.array(key, (4, 4))
        turn = pose[:3, :3]
        if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0:
            raise self.error(key, "must be a pose: its first three columns are no right-handed rotation")
        if not np.allclose(pose[3], [0, 0, 0, 1]):
            raise self.error(key, "must be a pose with the last row 0, 0, 0, 1; was it transposed?")
        self._near(key, pose[:3, 3])
        return pose

    def _near(self, key: str, metres: FloatArray) -> None:
        if np.abs(metres).max() > FAR_M:
            raise self.error(key, f"must be in metres: {np.abs(metres).max():g} is more than {FAR_M:g} m")

    def box(self, key: str) -> FloatArray:
        """The lower and the upper corner ``(2, 3)`` of a box, metres, that is not below the table."""
        box = self.array(key, (2, 3))
        if not (box[0] < box[1]).all():
            raise self.error(key, "must be the lower and then the upper corner, [[x, y, z], [x, y, z]] in metres")
        self._near(key, box)
        if box[1, 2] <= 0:
            raise self.error(key, "must reach above the table, whose z is 0")
        return box

    def section(self, key: str) -> Section:
        value = self._take(key, None, f"[{key}]")
        if not isinstance(value, Mapping):
            raise self.error(key, f"must be a table, not {value!r}")
        return Section(value, f"{self._where}: {key}")

    def sections(self, key: str) -> list[Section]:
        value = self._take(key, None, f"[[{key}]]")
        if not isinstance(value, list) or not value or not all(isinstance(one, Mapping) for one in value):
            raise self.error(key, f"must be one or more tables [[{key}]]")
        return [Section(one, f"{self._where}: {key}[{index}]") for index, one in enumerate(value)]

    def rest(self) -> Mapping[str, Any]:
        """The keys that were not read yet, for a driver."""
        values, self._values = self._values, {}
        return MappingProxyType(values)

    def finish(self) -> None:
        """Raises `CellError` for a key that was not read: it is misspelt."""
        for key in self._values:
            raise self.error(key, "is not known here; is it misspelt?")

    def error(self, key: str, words: str) -> CellError:
        return CellError(f"{self._where}: {key} {words}")

    def _take(self, key: str, default: Any, table: str = "") -> Any:
        value = self._values.pop(key, default)
        if value is None and table:
            raise CellError(f"{self._where} lacks the table {table}; docs/robots.md shows a cell's file")
        if value is None:
            raise self.error(key, "is missing")
        return value


@dataclass(frozen=True)
class DeviceConfig:
    """A device: its ``kind``, which chooses the driver, and the driver's own ``options``, read with `section`."""

    kind: str
    options: Mapping[str, Any]
    where: str

    def section(self) -> Section:
        return Section(self.options, self.where)

    @classmethod
    def read(cls, section: Section, where: str) -> DeviceConfig:
        return cls(section.text("kind"), section.rest(), where)


@dataclass(frozen=True, eq=False)
class ArmConfig:
    """An arm of the cell.

    ``model`` is a known one or the path of a URDF; ``base (4, 4)`` its pose in the world; ``park (J,)`` the joint
    angles, rad, out of the camera's sight, where a run begins; ``gripper`` None for that of the model, ``tool (4, 4)``
    measured tool -> tool of the model, None where they are the same;
    ``joint_speed`` rad/s, ``joint_acceleration`` rad/s² and ``tool_speed`` m/s narrow the model's limits, None leaves
    them.
    """

    name: str
    model: str
    base: FloatArray
    park: FloatArray
    gripper: GripperTriangle | None
    tool: FloatArray | None
    driver: DeviceConfig
    leader: DeviceConfig | None
    joint_speed: float | None
    joint_acceleration: float | None
    tool_speed: float | None


@dataclass(frozen=True, eq=False)
class CellConfig:
    """A cell, as its file describes it.

    ``rate_hz`` is that of commands, ``execute_hz`` that of a plan's waypoints; ``limits`` holds the workspace and what
    else a motion must respect; a plan below ``min_confidence`` is refused; ``camera_pose (4, 4)`` is camera to world,
    OpenCV axes, None before the camera was calibrated; ``emulation`` is the table of an emulated cell, None with real
    devices. The world's origin lies on the table, z up.
    """

    path: Path
    name: str
    rate_hz: float
    execute_hz: float
    limits: Limits
    min_confidence: float
    first_run_speed: float
    arms: tuple[ArmConfig, ...]
    camera: DeviceConfig | None
    camera_pose: FloatArray | None
    camera_calibration: Path | None
    emulation: Mapping[str, Any] | None = field(default=None)

    def emulation_section(self) -> Section:
        """The table [emulation]; raises `CellError` for a cell with real devices."""
        if self.emulation is None:
            raise CellError(f"{self.path} has no table [emulation]: its devices are real")
        return Section(self.emulation, f"{self.path}: emulation")

    @property
    def pace(self) -> float:
        """How much faster than time the cell runs; 1 for real devices."""
        return 1.0 if self.emulation is None else float(self.emulation.get("pace", 1.0))

    @property
    def digest(self) -> str:
        """Digest of the camera's calibration, the grippers and the arms' bases: a plan holds in the cell it was made
        for."""
        parts: list[Any] = [None if self.camera_pose is None else np.round(self.camera_pose, 6).tolist()]
        for arm in self.arms:
            gripper = None if arm.gripper is None else [arm.gripper.length, arm.gripper.opening]
            parts.append([arm.name, arm.model, np.round(arm.base, 6).tolist(), gripper])
            if arm.tool is not None:
                parts.append(np.round(arm.tool, 6).tolist())
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:16]

    @classmethod
    def load(cls, path: str | Path) -> CellConfig:
        """Read a cell's file, or one of those in `CELLS` by its name. Raises `CellError` in one line that names the
        key."""
        path = Path(path)
        if not path.exists() and (CELLS / f"{path.name}.toml").exists():
            path = CELLS / f"{path.name}.toml"
        root = read_section(path)
        cell = root.section("cell")
        arms = tuple(_arm(section, path) for section in root.sections("arms"))
        if len({arm.name for arm in arms}) != len(arms):
            raise CellError(f"{path}: arms: two arms have the same name")
        camera, camera_pose, calibration = None, None, None
        if "camera" in root:
            section = root.section("camera")
            if "calibration" in section:
                calibration = path.parent / section.text("calibration")
                camera_pose = read_camera_pose(calibration) if calibration.exists() else None
            camera = DeviceConfig.read(section, f"{path}: camera")
        emulation = root.section("emulation").rest() if "emulation" in root else None
        if emulation is None:
            _check_ports(arms, path)
        else:
            Section(emulation, f"{path}: emulation").number("pace", 1.0, *PACES)
        config = cls(
            path=path,
            name=_name(cell, path.stem),
            rate_hz=cell.number("rate_hz", 50.0, 20.0, 500.0),  # servos and controllers stop after 100 ms of silence
            execute_hz=cell.number("execute_hz", 1.0, 0.1, 50.0),
            limits=_limits(cell),
            min_confidence=cell.number("min_confidence", MIN_CONFIDENCE, 0.0, 1.0),
            first_run_speed=cell.number("first_run_speed", FIRST_RUN_SPEED, 0.05, 1.0),
            arms=arms,
            camera=camera,
            camera_pose=camera_pose,
            camera_calibration=calibration,
            emulation=emulation,
        )
        cell.finish()
        root.finish()
        return config


def read_section(path: Path) -> Section:
    """A TOML file as a `Section`. Raises `CellError` for one that is missing or is not TOML."""
    try:
        return Section(tomllib.loads(read_regular(path).decode()), f"{path}")
    except FileNotFoundError:
        raise CellError(f"no file at {path}; docs/robots.md shows how to write one") from None
    except (DatasetError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise CellError(f"{path} is not a TOML file: {error}") from None


def read_camera_pose(path: Path) -> FloatArray:
    """``pose (4, 4)``, camera to world, of a calibration file; other keys are the calibration's own."""
    section = read_section(path)
    pose = section.pose("pose")
    if pose[2, 3] < 0:
        raise section.error("pose", f"must not be below the table, whose z is 0, but is at z = {pose[2, 3]:g}")
    return pose


def read_gripper(path: Path) -> tuple[GripperTriangle, FloatArray | None]:
    """``length`` and ``opening``, metres, of a gripper's file, and its ``tool (4, 4)``, measured tool -> tool of the
    arm's model, None without it; other keys are the calibration's own."""
    section = read_section(path)
    length, opening = (section.number(key, least=0.002, most=most) for key, most in (("length", 1.0), ("opening", 0.5)))
    return GripperTriangle(length, opening), section.pose("tool") if "tool" in section else None


def _limits(cell: Section) -> Limits:
    return Limits(
        cell.box("workspace"),
        table_depth=cell.number("table_depth", TABLE_TOLERANCE_M, 0.0, 0.05),
        arm_distance=cell.number("arm_distance", ARM_DISTANCE_M, 0.0, 1.0),
        link_distance=cell.number("link_distance", LINK_DISTANCE_M, -0.05, 1.0),
        turn_per_step=math.radians(cell.number("turn_per_step", math.degrees(TURN_PER_STEP_RAD), 1.0, 180.0)),
        step=cell.number("step", STEP_M, 0.01, 2.0),
        following_error=cell.number("following_error", FOLLOWING_ERROR_RAD, 0.01, 2.0),
    )


def _name(section: Section, default: str | None = None) -> str:
    """A name that is valid in file names and addresses."""
    name = section.text("name", default)
    if not re.fullmatch(r"\w[\w.-]*", name):
        raise section.error("name", f"must be letters, digits, _, . and -, not {name!r}")
    return name


def _check_ports(arms: Sequence[ArmConfig], path: Path) -> None:
    """Raises `CellError` for two devices at one port: a leader would be moved, or one arm by two commands."""
    used: dict[str, str] = {}
    for arm in arms:
        for what, device in (("driver", arm.driver), ("leader", arm.leader)):
            for port in (str(device.options[key]) for key in PORTS if device is not None and key in device.options):
                port = os.path.realpath(port) if port.startswith("/") else port  # a device has several names
                who = f"the {what} of {arm.name}"
                if port in used:
                    raise CellError(f"{path}: {used[port]} and {who} have the same port {port!r}")
                used[port] = who


def _arm(section: Section, path: Path) -> ArmConfig:
    name = _name(section)
    base = section.array("base", (6,), [0.0] * 6)
    if np.abs(base[:3]).max() > FAR_M:
        raise section.error("base", f"must begin with x, y, z in metres, not {base[:3].tolist()}")
    gripper = tool = None
    if "gripper" in section:
        file = path.parent / section.text("gripper")
        if not file.exists():
            words = (
                "take the key out until rip calibrate tool has written it; an arm of your own needs length and opening"
            )
            raise section.error("gripper", f"is wrong, there is no file at {file}: {words}, metres, by a ruler first")
        gripper, tool = read_gripper(file)
    config = ArmConfig(
        name=name,
        model=section.text("model"),
        base=make_pose(Rotation.from_euler("xyz", base[3:], degrees=True).as_matrix(), base[:3]),
        park=section.array("park", (None,)),
        gripper=gripper,
        tool=tool,
        driver=DeviceConfig.read(section.section("driver"), f"{path}: driver of {name}"),
        leader=DeviceConfig.read(section.section("leader"), f"{path}: leader of {name}")
        if "leader" in section
        else None,
        **{key: section.number(key, least=1e-3, most=most) if key in section else None for key, most in SPEEDS.items()},
    )
    section.finish()
    return config
