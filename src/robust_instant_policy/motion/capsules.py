"""Arms as capsules, and distances between capsules: those of two arms, and those of one arm's own links.

A capsule is the set of points within a radius of a line segment. Each shape of an arm's model is enclosed in one.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.geometry import FloatArray, transform_points
from robust_instant_policy.motion.kinematics import Kinematics

NEIGHBOURS = 1  # joints between two links, up to which they are not checked against each other
POSES, ALWAYS = 200, 0.95  # random poses, and the share of them in which shapes that overlap by design do so
FAR_M = 1.0  # beyond which a distance is not computed
LINES = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))
SMALLEST = 1e-12  # squared length of a segment, m², below which it is a point


@dataclass(frozen=True, eq=False)
class Capsules:
    """Segments from ``start (..., C, 3)`` to ``stop (..., C, 3)``, metres, with ``radius (C,)``."""

    start: FloatArray
    stop: FloatArray
    radius: FloatArray

    def distances(self, other: Capsules) -> FloatArray:
        """Distances ``(..., C, D)`` between the surfaces of these capsules and those of ``other``, negative inside."""
        apart = segment_distance(
            self.start[..., :, None, :],
            self.stop[..., :, None, :],
            other.start[..., None, :, :],
            other.stop[..., None, :, :],
        )
        return apart - self.radius[:, None] - other.radius

    def between(self, one: np.ndarray, other: np.ndarray) -> FloatArray:
        """Distances ``(..., P)`` between the surfaces of the capsules with the indices ``one (P,)`` and ``other``."""
        ends = (self.start[..., one, :], self.stop[..., one, :], self.start[..., other, :], self.stop[..., other, :])
        return segment_distance(*ends) - self.radius[one] - self.radius[other]

    def lowest(self) -> FloatArray:
        """Height ``(..., C)`` of the lowest point of each, metres."""
        return np.minimum(self.start[..., 2], self.stop[..., 2]) - self.radius


def segment_distance(a: ArrayLike, b: ArrayLike, c: ArrayLike, d: ArrayLike) -> FloatArray:
    """Distance ``(...)`` between the segments from ``a`` to ``b`` and from ``c`` to ``d (..., 3)``.

    The closest points of the two lines, clamped to the segments one after the other (Ericson 2005, Sec. 5.1.9).
    """
    a, c = np.asarray(a, dtype=np.float64), np.asarray(c, dtype=np.float64)
    along, other, offset = np.asarray(b) - a, np.asarray(d) - c, a - c

    def dot(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.einsum("...i,...i->...", x, y)

    aa, bb, ab = dot(along, along), dot(other, other), dot(along, other)
    ra, rb = dot(along, offset), dot(other, offset)
    aa, bb = np.maximum(aa, SMALLEST), np.maximum(bb, SMALLEST)
    determinant = np.maximum(aa * bb - ab**2, SMALLEST)
    s = np.clip((ab * rb - ra * bb) / determinant, 0.0, 1.0)
    t = np.clip((ab * s + rb) / bb, 0.0, 1.0)
    s = np.clip((ab * t - ra) / aa, 0.0, 1.0)
    return np.linalg.norm(offset + s[..., None] * along - t[..., None] * other, axis=-1)


class ArmShape:
    """The links of an arm as capsules, for any joint angles.

    ``fixed (C,)`` marks the base; ``near_table (C,)`` is False for it and for links that only turn about the arm's
    first joint: they stand on the table;
    ``hand (C,)`` marks those beyond the last joint, which work at the table. ``links (C,)`` are the links' names, and
    ``pairs (2, P)`` the shapes of one arm that must not meet: two joints or more lie between their links, and they are
    apart in some poses, other than those that enclose a joint generously.
    """

    def __init__(self, kinematics: Kinematics):
        model = kinematics.model
        self._model, self._data, self._base = model, mujoco.MjData(model), kinematics.base
        self._num_joints = kinematics.num_joints
        depth = np.array([_joints_above(model, body, self._num_joints) for body in range(model.nbody)])
        depth = depth[model.geom_bodyid]
        self.fixed, self.near_table, self.hand = depth == 0, depth >= 2, depth >= self._num_joints
        shapes = [_enclosing(model, geom) for geom in range(model.ngeom)]
        self._local = np.array([(start, stop) for start, stop, _ in shapes]).reshape(-1, 2, 3)
        self.radius = np.array([radius for _, _, radius in shapes])
        self.links = [model.body(body).name for body in model.geom_bodyid]
        one, other = np.triu_indices(len(depth), 1)
        distant = np.abs(depth[one] - depth[other]) > NEIGHBOURS
        one, other = one[distant], other[distant]
        low, high = kinematics.joint_range.clip(-np.pi, np.pi).T
        poses = np.random.default_rng(0).uniform(low, high, (POSES, self._num_joints))
        self.pairs = np.stack([one, other])
        self.pairs = self.pairs[:, (self.link_distances(poses, self.at(poses)) < 0).mean(axis=0) < ALWAYS]

    def at(self, joints: ArrayLike) -> Capsules:
        """The capsules ``(N, C)`` in the world at ``joints (N, J)``."""
        joints = np.atleast_2d(np.asarray(joints, dtype=np.float64))
        ends = np.empty((len(joints), self._model.ngeom, 2, 3))
        for row, angles in enumerate(joints):
            self._place(angles)
            rotation = self._data.geom_xmat.reshape(-1, 3, 3)
            ends[row] = self._local @ rotation.swapaxes(1, 2) + self._data.geom_xpos[:, None]
        ends = transform_points(self._base, ends)
        return Capsules(ends[:, :, 0], ends[:, :, 1], self.radius)

    def height(self, links: Capsules) -> FloatArray:
        """Height ``(N,)`` above the table of the lowest of ``links`` that moves, metres.

        A hand works at the table, where its fingertips are checked: of its other parts the axes count.
        """
        height: FloatArray = (links.lowest() + np.where(self.hand, links.radius, 0.0))[:, self.near_table].min(axis=1)
        return height

    def distance(self, links: Capsules, other: ArmShape, others: Capsules) -> FloatArray:
        """Distance ``(N,)`` of ``links`` from the links ``others`` of an arm with the shape ``other``, metres."""
        apart = links.distances(others)
        apart[:, self.fixed[:, None] & other.fixed] = np.inf  # nothing moves there
        nearest: FloatArray = apart.min(axis=(1, 2))
        return nearest

    def link_distances(self, joints: FloatArray, capsules: Capsules, near: float = 0.0) -> FloatArray:
        """Distances ``(N, P)`` of `pairs` at ``joints (N, J)``, where the ``capsules`` are: those of the capsules, and
        where these are nearer than ``near``, metres, those of the shapes themselves, of meshes as convex hulls."""
        apart = capsules.between(*self.pairs)
        for row in np.flatnonzero((apart < near).any(axis=1)):
            self._place(joints[row])
            for pair in np.flatnonzero(apart[row] < near):
                one, other = self.pairs[:, pair]
                apart[row, pair] = mujoco.mj_geomDistance(self._model, self._data, one, other, FAR_M, None)
        return apart

    def _place(self, angles: FloatArray) -> None:
        self._data.qpos[: self._num_joints] = angles
        mujoco.mj_kinematics(self._model, self._data)


def _joints_above(model: mujoco.MjModel, body: int, num_joints: int) -> int:
    """How many of the arm's joints move ``body``."""
    count = 0
    while body:
        first, number = model.body_jntadr[body], model.body_jntnum[body]
        count += sum(joint < num_joints for joint in range(first, first + number))
        body = model.body_parentid[body]
    return count


def _enclosing(model: mujoco.MjModel, geom: int) -> tuple[FloatArray, FloatArray, float]:
    """A capsule around a shape, in its frame: both ends ``(3,)`` and the radius. Around a mesh or a box it is the
    smallest one along the longest side."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind in LINES or kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        half = np.array([0.0, 0.0, size[1] if kind in LINES else 0.0])
        return -half, half, float(size[0])
    middle, extent = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    points = extent * (np.array(list(product((-1, 1), repeat=3))))
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]] - middle
    axis = int(np.argmax(extent))
    across = np.linalg.norm(np.delete(points, axis, axis=1), axis=1)
    radius = float(across.max())
    half = np.eye(3)[axis] * max((np.abs(points[:, axis]) - np.sqrt(radius**2 - across**2)).max(), 0.0)
    return middle - half, middle + half, radius
