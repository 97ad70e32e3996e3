"""Articulated objects, and the geometry of the moving part that an expert needs.

All positions are in the object's frame: on the table, z up, its -x side facing the robot at yaw 0.
"""

from dataclasses import dataclass

import sapien
import torch
from mani_skill.utils.structs.articulation import Articulation
from mani_skill.utils.structs.link import Link

from robust_instant_policy.geometry import FloatArray


@dataclass(frozen=True, eq=False)
class Drawer:
    """A closed drawer that slides out along -x by ``travel`` m; ``handle (3,)`` is the grasp point."""

    handle: FloatArray
    travel: float


@dataclass(frozen=True, eq=False)
class Door:
    """A door in the plane x = 0 when closed, its hinge's foot at ``hinge (2,)``.

    ``side`` is 1 where the hinge is on the +y side and the door reaches to -y, -1 for the mirror image; ``width``
    and ``top`` (height of the upper edge) in metres.
    """

    hinge: FloatArray
    side: float
    width: float
    top: float


@dataclass(frozen=True, eq=False)
class Lever:
    """A lever that rotates about the vertical axis through ``pivot (2,)``.

    Closed it points at angle ``start`` rad; it opens by ``turn`` rad, counter-clockwise where ``sign`` is 1.
    ``length``, ``half_width`` and ``height`` (of its middle) in metres.
    """

    pivot: FloatArray
    start: float
    sign: float
    turn: float
    length: float
    half_width: float
    height: float


@dataclass(frozen=True, eq=False)
class Mechanism:
    """An articulation whose ``joint`` moves ``link``; ``origin (4, 4)`` is its root in the object's frame."""

    articulation: Articulation
    joint: str
    link: str
    origin: FloatArray

    @property
    def _index(self) -> int:
        return [joint.name for joint in self.articulation.active_joints].index(self.joint)

    @property
    def _closed(self) -> torch.Tensor:
        return closed_joints(self.articulation)

    @property
    def moving_link(self) -> Link:
        return self.articulation.links_map[self.link]

    @property
    def position(self) -> torch.Tensor:
        """Distance of ``joint`` from its closed end, ``(1,)``, in rad or metres."""
        return (self.articulation.get_qpos() - self._closed)[:, self._index]

    def place(self, pose: FloatArray, position: float) -> None:
        """Put the object at ``pose (4, 4)``, its joint ``position`` from closed, all its others closed."""
        self.articulation.set_pose(sapien.Pose(pose @ self.origin))
        joints = self._closed
        joints[:, self._index] += position
        self.articulation.set_qpos(joints)
        self.articulation.set_qvel(torch.zeros_like(joints))

    def is_still(self, linear: float, angular: float) -> bool:
        """Whether the moving link is not faster than ``linear`` m/s and ``angular`` rad/s."""
        link = self.moving_link
        slow = bool(torch.linalg.norm(link.linear_velocity) <= linear)
        return slow and bool(torch.linalg.norm(link.angular_velocity) <= angular)


def closed_joints(articulation: Articulation) -> torch.Tensor:
    """Joint positions ``(1, J)`` with everything closed: the lower limits, 0 where a joint has none."""
    return articulation.get_qlimits()[:, :, 0].nan_to_num(0.0, 0.0, 0.0)


def resist(articulation: Articulation, joint: str, damping: float, friction: float) -> None:
    """Give ``joint`` viscous ``damping`` (N s/m or N m s/rad) and PhysX's coefficient of ``friction``."""
    moving = articulation.joints_map[joint]
    moving.set_drive_properties(0.0, damping)
    moving.set_friction(friction)
