"""Where a vector of numbers holds poses: the names that datasets give to its columns.

A pose is x, y, z in any unit of length and a rotation, in one of `ROTATIONS`:

- ``rotvec``: a rotation vector (axis times angle), named wx wy wz, rx ry rz, ax ay az or axis_angle1 … 3;
- ``axis_angle``: a unit vector, named like a rotation vector, and the angle;
- ``rpy``: roll, pitch, yaw about the fixed axes x, y, z in this order, R = Rz(yaw) Ry(pitch) Rx(roll);
- ``quat_xyzw``, ``quat_wxyz``: a quaternion, named qx qy qz qw, or rx ry rz rw, in any order.

Names may have any prefix; ``left`` and ``right`` in it tell two arms apart. Those of velocities, forces and differences
are no pose.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robust_instant_policy.errors import DatasetError
from robust_instant_policy.geometry import FloatArray

ROTATIONS = {"rotvec": 3, "rpy": 3, "axis_angle": 4, "quat_xyzw": 4, "quat_wxyz": 4}  # kind, and how many numbers
MIN_QUATERNION = 1e-6  # shorter quaternions have no direction
FARTHEST_M = 20.0  # from the origin; farther, positions are not in metres
MAX_ANGLE_RAD = 4 * np.pi  # larger angles are not in radians
UNIT_TOLERANCE = 0.02  # of the length of an axis from 1
DOWN = -0.5  # height of a unit vector within 60 degrees of straight down
ARMS = ("left", "right")
WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+")
NO_POSE = {  # words in names of other vectors
    "vel", "velocity", "twist", "force", "torque", "wrench", "acc", "acceleration", "delta", "rel", "relative", "error",
}  # fmt: skip
POSITION = ("x", "y", "z")
QUATERNION_KINDS = ("quat_xyzw", "quat_wxyz")
# By the words at the end of a name, longest first: the axis that they mean.
SPELLINGS: dict[tuple[str, ...], str] = {
    **{(axis,): axis for axis in (*POSITION, "wx", "wy", "wz", "rx", "ry", "rz", "rw", "qx", "qy", "qz", "qw")},
    **{(name,): name for name in ("roll", "pitch", "yaw", "angle")},
    **{(f"a{axis}",): f"w{axis}" for axis in POSITION},
    **{(word, axis): f"q{axis}" for word in ("quat", "quaternion") for axis in ("x", "y", "z", "w")},
    **{(word, str(place)): f"q{place}" for word in ("quat", "quaternion") for place in range(4)},
    **{(word, axis): f"r{axis}" for word in ("rot", "rotation", "orientation") for axis in ("x", "y", "z", "w")},
    **{(word, axis): f"w{axis}" for word in ("rotvec", "axis", "angle") for axis in POSITION},
    **{("axis", "angle", str(number)): f"w{axis}" for number, axis in enumerate(POSITION, 1)},
}
TRIPLES = {"rotvec": (("wx", "wy", "wz"), ("rx", "ry", "rz")), "rpy": (("roll", "pitch", "yaw"),)}
QUATERNIONS = (("qx", "qy", "qz", "qw"), ("rx", "ry", "rz", "rw"))
NUMBERED = ("q0", "q1", "q2", "q3")  # a quaternion in an unknown order


@dataclass(frozen=True)
class Columns:
    """The columns of one arm's pose: three of the position, and those of a rotation of the kind ``rotation``.

    Those of a quaternion are in the order x, y, z, w, those of an axis with its angle begin with the axis; ``rotation``
    is empty for a quaternion whose order is unknown.
    """

    arm: str
    position: tuple[int, ...]
    turns: tuple[int, ...]
    rotation: str


def axis_names(feature: Mapping[str, Any]) -> list[str]:
    """Names of a vector's axes: a list, lists by kind of motor, or a map from the name to the column."""
    return _names(feature.get("names"))


def _names(names: object) -> list[str]:
    if isinstance(names, str):
        return [names]
    if isinstance(names, Mapping):
        if names and all(isinstance(column, int) for column in names.values()):
            return [str(name) for name, _ in sorted(names.items(), key=lambda pair: pair[1])]
        names = list(names.values())
    return [name for part in names for name in _names(part)] if isinstance(names, list) else []


def words_of(name: str) -> tuple[str, ...]:
    """The words in a name, such as ``left_ee.posX``, in lower case."""
    return tuple(word.lower() for word in WORD.findall(name))


def arm_of(name: str) -> str:
    """ "left" or "right" where a name says so, else empty."""
    words = words_of(name)
    return next((arm for arm in ARMS if arm in words), "")


def pose_columns(names: Sequence[str], rotation: str | None = None) -> list[Columns]:
    """The poses of the arms that ``names`` describe; empty where there are none, or several of one arm.

    ``rotation`` is the meaning of rx ry rz and the like, where the user knows it.
    """
    by_arm: dict[str, dict[str, list[int]]] = {}
    for column, name in enumerate(names):
        axis = _axis(name)
        if axis is not None:
            by_arm.setdefault(arm_of(name), {}).setdefault(axis, []).append(column)
    found = [_columns(arm, axes, rotation) for arm, axes in sorted(by_arm.items())]
    poses = [one for one in found if one is not None]
    return poses if len(poses) == 1 or [one.arm for one in poses] == list(ARMS) else []


def gripper_columns(names: Sequence[str]) -> dict[str, int]:
    """The first column whose name speaks of a gripper, not of its pose, by arm."""
    found: dict[str, int] = {}
    for column, name in enumerate(names):
        if is_gripper(name) and _axis(name) is None:
            found.setdefault("" if "finger" in name.lower() else arm_of(name), column)
    return found


def is_gripper(name: str) -> bool:
    """Whether a name is that of a gripper's position or command."""
    return any(word in name.lower() for word in ("gripper", "finger")) and not NO_POSE & set(words_of(name))


def unnamed_columns(size: int, rotation: str | None) -> Columns | None:
    """A vector of numbers without names as a pose; None where the kind of rotation is not known."""
    if rotation is not None:
        return Columns("", (0, 1, 2), _in_xyzw(tuple(range(3, 3 + ROTATIONS[rotation])), rotation), rotation)
    return Columns("", (0, 1, 2), (3, 4, 5, 6), "") if size in (7, 8) else None  # 8: with the gripper


def _axis(name: str) -> str | None:
    words = words_of(name)
    if NO_POSE & set(words):
        return None
    axis = next((SPELLINGS[words[-n:]] for n in (3, 2, 1) if words[-n:] in SPELLINGS), None)
    return None if axis == "angle" and is_gripper(name) else axis


def _columns(arm: str, axes: Mapping[str, list[int]], rotation: str | None) -> Columns | None:
    def columns(wanted: Sequence[str]) -> tuple[int, ...] | None:
        found = [axes.get(axis, []) for axis in wanted]
        return tuple(one[0] for one in found) if all(len(one) == 1 for one in found) else None

    position = columns(POSITION)
    if position is None:
        return None
    for quaternion in QUATERNIONS:
        if (turns := columns(quaternion)) is not None:
            return Columns(arm, position, turns, "quat_xyzw")
    if (turns := columns(NUMBERED)) is not None:
        return Columns(arm, position, _in_xyzw(turns, rotation), rotation if rotation in QUATERNION_KINDS else "")
    if rotation in (None, "axis_angle") and (turns := columns(("wx", "wy", "wz", "angle"))) is not None:
        return Columns(arm, position, turns, "axis_angle")
    for kind, spellings in TRIPLES.items():
        for spelling in spellings:
            if (turns := columns(spelling)) is not None:
                return Columns(arm, position, turns, rotation if rotation and rotation in TRIPLES else kind)
    return None


def _in_xyzw(turns: tuple[int, ...], rotation: str | None) -> tuple[int, ...]:
    return (*turns[1:], turns[0]) if rotation == "quat_wxyz" else turns


def rotations_of(name: str, turns: NDArray, rotation: str, unit_rad: float = 1.0) -> FloatArray:
    """Matrices ``(T, 3, 3)`` of ``turns (T, 3 or 4)``, quaternions as x, y, z, w; angles are in steps of ``unit_rad``.

    Raises `DatasetError`.
    """
    turns = turns.astype(np.float64)
    if rotation in QUATERNION_KINDS:
        if np.linalg.norm(turns, axis=1).min() < MIN_QUATERNION:
            raise DatasetError(f"{name}: quaternions must have length 1, and one is 0")
        return Rotation.from_quat(turns).as_matrix()
    angles = turns[:, 3:] if rotation == "axis_angle" else turns
    if (largest := np.abs(angles).max() * unit_rad) > MAX_ANGLE_RAD:
        raise DatasetError(
            f"{name}: angles reach {largest:.0f} rad; in degrees? Set rotation_unit_rad to 0.017453 in the rig"
        )
    if rotation == "rpy":
        return Rotation.from_euler("xyz", turns * unit_rad).as_matrix()
    if rotation == "rotvec":
        return Rotation.from_rotvec(turns * unit_rad).as_matrix()
    lengths = np.linalg.norm(turns[:, :3], axis=1)
    if np.abs(lengths[angles[:, 0] != 0] - 1).max(initial=0) > UNIT_TOLERANCE:
        raise DatasetError(f"{name}: the axes of its rotations do not have length 1; set rotation in the rig, rotvec")
    return Rotation.from_rotvec(turns[:, :3] * angles * unit_rad).as_matrix()


def poses_of(
    name: str,
    numbers: NDArray,
    columns: Columns,
    unit_m: float = 1.0,
    unit_rad: float = 1.0,
    tool: NDArray | None = None,
) -> FloatArray:
    """Poses ``(T, 4, 4)`` in ``columns`` of ``numbers (T, D)``; positions are in steps of ``unit_m`` metres, angles of
    ``unit_rad`` radians.

    A quaternion of unknown order is read in the one in which the approach direction (z of the ``tool``) makes sense:
    it points down. Raises `DatasetError` that begins with ``name`` if they are not poses, and where both orders
    or neither make sense.
    """
    chosen = [*columns.position, *columns.turns]
    if numbers.ndim != 2 or numbers.shape[1] <= max(chosen) or not np.isfinite(numbers[:, chosen]).all():
        raise DatasetError(f"{name}: poses must be finite, (T, {len(chosen)}), got {numbers.shape}")
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    poses[:, :3, 3] = numbers[:, list(columns.position)] * unit_m
    farthest = float(np.abs(poses[:, :3, 3]).max())
    if farthest > FARTHEST_M:
        raise DatasetError(
            f"{name}: positions reach {farthest:.0f} m; in millimetres? Set position_unit_m to 0.001 in the rig"
        )
    turns = numbers[:, list(columns.turns)]
    if columns.rotation:
        poses[:, :3, :3] = rotations_of(name, turns, columns.rotation, unit_rad)
        return poses
    approach = np.array([0.0, 0.0, 1.0]) if tool is None else np.asarray(tool)[:3, 2]
    orders = {"quat_xyzw": turns, "quat_wxyz": np.roll(turns, -1, axis=1)}
    matrices = {order: rotations_of(name, values, order) for order, values in orders.items()}
    # The gripper points down in nearly all steps.
    sensible = [order for order, matrix in matrices.items() if np.quantile((matrix @ approach)[:, 2], 0.9) < DOWN]
    if len(sensible) != 1:
        ways = "both orders" if sensible else "neither order"
        raise DatasetError(
            f"{name}: its quaternions have no order, and in {ways} the gripper points down; give rotation in the rig, "
            "quat_xyzw or quat_wxyz"
        )
    poses[:, :3, :3] = matrices[sensible[0]]
    return poses
