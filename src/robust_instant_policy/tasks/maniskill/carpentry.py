"""Links made of boxes and cylinders, with equal visual and collision shapes."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from robust_instant_policy.tasks.maniskill.mechanism import Mechanism, resist
from robust_instant_policy.tasks.maniskill.paint import Paint

AXES = {"x": (1.0, 0.0, 0.0, 0.0), "y": (0.70710678, 0.0, 0.0, 0.70710678), "z": (0.70710678, 0.0, -0.70710678, 0.0)}
WOOD_DENSITY = 600.0  # kg/m³


def add_box(builder: Any, size: ArrayLike, centre: ArrayLike, paint: Paint, *, collide: bool = True) -> None:
    """A box of ``size (3,)`` m around ``centre (3,)`` m in the link's frame."""
    half = np.asarray(size, dtype=np.float64) / 2
    pose = sapien.Pose(centre)
    seed = int(1e4 * abs(half.sum() + np.abs(centre).sum()))
    builder.add_box_visual(pose, half, paint.material(seed))
    if collide:
        builder.add_box_collision(pose, half, density=WOOD_DENSITY)


def add_cylinder(
    builder: Any,
    radius: float,
    length: float,
    centre: ArrayLike,
    axis: str | ArrayLike,
    paint: Paint,
    *,
    collide: bool = True,
) -> None:
    """A cylinder around ``centre (3,)`` along ``axis``: ``"x"``, ``"y"``, ``"z"`` or a direction ``(3,)``."""
    pose = sapien.Pose(centre, AXES[axis] if isinstance(axis, str) else _turn_x_to(np.asarray(axis)))
    builder.add_cylinder_visual(pose, radius, length / 2, paint.material())
    if collide:
        builder.add_cylinder_collision(pose, radius, length / 2, density=WOOD_DENSITY)


def add_ball(builder: Any, radius: float, centre: ArrayLike, paint: Paint) -> None:
    """A sphere around ``centre (3,)``."""
    builder.add_sphere_visual(sapien.Pose(centre), radius, paint.material())
    builder.add_sphere_collision(sapien.Pose(centre), radius, density=WOOD_DENSITY)


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint at ``at (3,)`` that turns its link about ``axis (3,)`` (``kind`` "revolute") or moves it along it
    ("prismatic"), from 0 to ``limit`` rad or metres, against viscous ``damping`` (N m s/rad or N s/m) and PhysX's
    coefficient of ``friction``."""

    name: str
    kind: str
    at: ArrayLike
    axis: ArrayLike
    limit: float
    damping: float
    friction: float


def build_mechanism(
    scene: Any, name: str, build_body: Callable[[Any], None], part: str, build_part: Callable[[Any], None], joint: Joint
) -> Mechanism:
    """An object of a fixed body and one ``part`` on a ``joint``; the part's frame is the body's moved to the joint."""
    builder = scene.create_articulation_builder()
    body = builder.create_link_builder()
    body.set_name("body")
    build_body(body)
    link = builder.create_link_builder(body)
    link.set_name(part)
    link.set_joint_name(joint.name)
    turn = _turn_x_to(np.asarray(joint.axis, dtype=np.float64))
    poses = sapien.Pose(joint.at, turn), sapien.Pose([0, 0, 0], turn)
    link.set_joint_properties(joint.kind, [[0.0, joint.limit]], *poses)
    build_part(link)
    builder.initial_pose = sapien.Pose([0.2, 0, 0])
    articulation = builder.build(name=name, fix_root_link=True)
    resist(articulation, joint.name, joint.damping, joint.friction)
    return Mechanism(articulation, joint.name, part, np.eye(4))


def _turn_x_to(direction: np.ndarray) -> list[float]:
    """Quaternion (w, x, y, z) that rotates the x axis to ``direction (3,)``."""
    turned, _ = Rotation.align_vectors(direction[None] / np.linalg.norm(direction), [[1.0, 0.0, 0.0]])
    x, y, z, w = turned.as_quat()
    return [w, x, y, z]
