"""Joint positions and a URDF become poses of a link. Needs MuJoCo and mink (extra `robots`)."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robust_instant_policy.errors import DatasetError, MissingExtraError
from robust_instant_policy.files import excerpt, read_regular
from robust_instant_policy.geometry import FloatArray

SUFFIXES = (".pos", "_pos", ".position", "_position")


@dataclass(frozen=True)
class JointModel:
    """The arm of a recording of joint positions.

    ``urdf`` describes it; ``link`` is the one whose poses are wanted, in the URDF's base frame. ``names`` are the
    URDF's joints in the order of ``columns``, the names of the recording's columns; without them both are those
    that the URDF and the recording have in common. A step of a column is ``unit_rad`` radians (0.01745: degrees), or
    metres.
    """

    urdf: Path
    link: str
    names: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    unit_rad: float = 1.0

    def poses(self, names: Sequence[str], values: FloatArray) -> FloatArray:
        """Poses ``(T, 4, 4)`` of the link for ``values (T, D)`` in columns called ``names``. Raises `DatasetError`."""
        try:
            import mink
            import mujoco
        except ImportError as error:
            raise MissingExtraError(error.name or "mink", "robots") from error
        model = _load(mujoco, self.urdf)
        joints = [model.joint(index).name for index in range(model.njnt)]
        chosen = self._pairs(names, joints)
        if not _has(mujoco, model, self.link):
            links = ", ".join(model.body(index).name for index in range(1, model.nbody))
            raise DatasetError(f"{self.urdf} has no link {self.link!r}; it has: {excerpt(links)}")
        configuration = mink.Configuration(model)
        poses = np.empty((len(values), 4, 4))
        q = configuration.q.copy()
        for row, pose in zip(values, poses, strict=True):
            for column, joint in chosen:
                q[model.joint(joint).qposadr[0]] = row[column] * self.unit_rad
            configuration.update(q)
            pose[:] = configuration.get_transform_frame_to_world(self.link, "body").as_matrix()
        return poses

    def _pairs(self, names: Sequence[str], joints: Sequence[str]) -> list[tuple[int, str]]:
        """Column and joint, for every joint whose position is known."""
        columns = self.columns or tuple(names)
        if self.names and len(self.names) == len(columns):
            wanted = dict(zip(columns, self.names, strict=True))
        else:
            wanted = {name: _stem(name) for name in columns if _stem(name) in joints}
        pairs = [(names.index(column), joint) for column, joint in wanted.items() if column in names]
        unknown = [joint for _, joint in pairs if joint not in joints]
        if not pairs or unknown or (self.names and len(pairs) != len(self.names)):
            raise DatasetError(
                f"the joints of {self.urdf} ({excerpt(', '.join(joints))}) are not those of the recording "
                f"({excerpt(', '.join(names))}); give names and columns in the same order"
            )
        return pairs


def _stem(name: str) -> str:
    return next((name.removesuffix(suffix) for suffix in SUFFIXES if name.endswith(suffix)), name)


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


def _has(mujoco: Any, model: Any, link: str) -> bool:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, link) >= 0
