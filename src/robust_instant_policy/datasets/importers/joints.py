"""Joint positions and a URDF become poses of a link. Needs MuJoCo and mink (extra `robots`)."""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robust_instant_policy.checks import checked_pose, checked_positive
from robust_instant_policy.datasets.importers.layouts import MAX_ANGLE_RAD, arm_of
from robust_instant_policy.errors import DatasetError, needs_extra
from robust_instant_policy.files import excerpt, read_regular
from robust_instant_policy.geometry import FloatArray

SUFFIX = r"[._]pos(ition)?$"


@dataclass(frozen=True)
class JointModel:
    """The arm of a recording of joint positions.

    ``urdf`` describes it; ``link`` is the one whose poses are wanted, in the URDF's base frame. ``names`` are the
    URDF's joints in the order of ``columns``, the names of the recording's columns; without them both are those
    that the URDF and the recording have in common. A step of an angle is ``unit_rad`` radians (0.01745: degrees);
    sliding joints are in metres. ``base (4, 4)`` is the pose of the URDF's base in the world, by default its origin.
    Raises `InvalidValueError` for another ``base`` or unit.
    """

    urdf: Path
    link: str
    names: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    unit_rad: float = 1.0
    base: FloatArray | None = None

    def __post_init__(self) -> None:
        checked_positive("unit_rad", self.unit_rad)
        if self.base is not None:
            checked_pose("base", self.base)

    def poses(self, names: Sequence[str], values: FloatArray, arm: str = "") -> FloatArray:
        """Poses ``(T, 4, 4)`` of the link for ``values (T, D)`` in columns called ``names``, of one ``arm`` of two
        ("left", "right"). Raises `DatasetError`.
        """
        with needs_extra("robots"):
            import mink
            import mujoco
        model = _load(mujoco, self.urdf)
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, self.link) < 0:
            links = ", ".join(model.body(index).name for index in range(1, model.nbody))
            raise DatasetError(f"{self.urdf} has no link {self.link!r}; it has: {excerpt(links)}")
        chosen = self._pairs(names, [model.joint(index).name for index in range(model.njnt)], arm)
        lacking = [joint for joint in _moving(model, self.link) if joint not in chosen]
        if lacking:
            raise DatasetError(
                f"the recording has no column for {excerpt(', '.join(lacking))}, which moves {self.link!r}; pair them "
                "with names and columns, or make the joint fixed in the URDF"
            )
        steps = {joint: self._unit(mujoco, model.joint(joint), values[:, column]) for joint, column in chosen.items()}
        configuration = mink.Configuration(model)
        poses = np.empty((len(values), 4, 4))
        q = configuration.q.copy()
        for row, pose in zip(values, poses, strict=True):
            for joint, column in chosen.items():
                q[model.joint(joint).qposadr[0]] = row[column] * steps[joint]
            configuration.update(q)
            pose[:] = configuration.get_transform_frame_to_world(self.link, "body").as_matrix()
        return poses if self.base is None else self.base @ poses

    def _pairs(self, names: Sequence[str], joints: Sequence[str], arm: str) -> dict[str, int]:
        """The column of every joint whose position is known."""
        columns = self.columns or tuple(names)
        if self.names and len(self.names) == len(columns):
            wanted = dict(zip(self.names, columns, strict=True))
        else:
            wanted = {}
            for name in columns:
                bare = re.sub(SUFFIX, "", name) if arm_of(name) in ("", arm) else ""
                for joint in (bare, bare.removeprefix(f"{arm}_"), bare.removesuffix(f"_{arm}")):
                    if joint in joints:
                        wanted.setdefault(joint, name)
        pairs = {joint: names.index(column) for joint, column in wanted.items() if column in names}
        unknown = [joint for joint in pairs if joint not in joints]
        if not pairs or unknown or (self.names and len(pairs) != len(self.names)):
            raise DatasetError(
                f"the joints of {self.urdf} ({excerpt(', '.join(joints))}) are not those of the recording "
                f"({excerpt(', '.join(names))}); give names and columns in the same order"
            )
        return pairs

    def _unit(self, mujoco: Any, joint: Any, values: FloatArray) -> float:
        """Radians or metres per step of ``values``. Raises `DatasetError` where they are no angles in that unit."""
        if joint.type[0] != mujoco.mjtJoint.mjJNT_HINGE:
            return 1.0
        if (largest := np.abs(values).max() * self.unit_rad) > MAX_ANGLE_RAD:
            raise DatasetError(
                f"the angles of {joint.name} reach {largest:.0f} rad; in degrees? Set unit_rad of joints to 0.017453"
            )
        return self.unit_rad


def _moving(model: Any, link: str) -> list[str]:
    """Names of the joints between the base and ``link``."""
    body, joints = model.body(link).id, []
    while body:
        first = model.body_jntadr[body]
        joints += [model.joint(index).name for index in range(first, first + model.body_jntnum[body])]
        body = model.body_parentid[body]
    return joints


def _load(mujoco: Any, path: Path) -> Any:
    """The kinematics of a URDF, without its meshes. Raises `DatasetError`."""
    try:
        root = ElementTree.fromstring(read_regular(path))
        for link in root.iter("link"):
            for part in [part for part in link if part.tag in ("visual", "collision")]:
                link.remove(part)
        options = ElementTree.SubElement(root, "mujoco")
        ElementTree.SubElement(
            options, "compiler", fusestatic="false", discardvisual="true", boundmass="0.001", boundinertia="0.000001"
        )
        return mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    except FileNotFoundError:
        raise DatasetError(f"there is no file {path}") from None
    except (ElementTree.ParseError, ValueError) as error:
        raise DatasetError(f"{path} is not a URDF that MuJoCo reads: {excerpt(error)}") from None
