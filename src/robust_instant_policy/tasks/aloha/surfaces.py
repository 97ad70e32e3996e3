"""Parts of objects: textured visual meshes, and collision shapes."""

from dataclasses import dataclass, field, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from robust_instant_policy.geometry import FloatArray

Image = NDArray[np.uint8]
Body = Any  # mujoco.MjsBody

VISUAL_GROUP, SOLID_GROUP = 1, 3  # only the former is rendered
ROLLING_M = 2e-4  # resistance of small hard things to rolling
TORSION_M = 5e-3


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles ``faces (F, 3)`` over ``vertices (V, 3)`` in metres, with texture coordinates ``uvs (V, 2)``."""

    vertices: FloatArray
    faces: NDArray[np.integer]
    uvs: FloatArray = field(repr=False)


def revolved(profile: ArrayLike, sides: int = 48, flat: bool = False) -> Surface:
    """The surface of revolution of ``profile (N, 2)`` (radius, height) about z; u runs around it, v along it.

    ``flat`` keeps its ``sides`` as facets with an edge between them.
    """
    profile = np.asarray(profile, dtype=np.float64)
    angles = np.linspace(0.0, 2 * np.pi, sides + 1)
    if flat:
        angles = np.repeat(angles, 2)[1:-1]
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    vertices = np.concatenate(
        [
            profile[None, :, :1] * ring[:, None],
            np.broadcast_to(profile[None, :, 1:], (len(ring), len(profile), 1)),
        ],
        axis=2,
    )
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    return _sheet(vertices, angles / (2 * np.pi), along / along[-1], every=2 if flat else 1)


def box_surface(size: ArrayLike) -> Surface:
    """A box of full ``size (3,)`` about the origin; every face has the whole texture."""
    half = np.asarray(size, dtype=np.float64) / 2
    vertices: list[list[FloatArray]] = []
    faces: list[list[int]] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal, across = np.eye(3)[axis] * sign, np.eye(3)[(axis + 1) % 3]
            up = np.cross(normal, across)
            first = 4 * len(vertices)
            vertices.append([(normal + a * across + b * up) * half for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
            faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return Surface(np.reshape(vertices, (-1, 3)), np.array(faces), np.tile(corners, (6, 1)))


def moved(surface: Surface, offset: ArrayLike) -> Surface:
    """``surface`` shifted by ``offset (3,)`` metres."""
    return replace(surface, vertices=surface.vertices + np.asarray(offset, dtype=np.float64))


def tube(points: ArrayLike, radius: float, sides: int = 14) -> Surface:
    """A round bar of ``radius`` along ``points (N, 3)``, closed at its ends; u runs around it, v along it."""
    points = np.asarray(points, dtype=np.float64)
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = np.cross(tangents, np.where(np.abs(tangents[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]]))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    angles = np.linspace(0.0, 2 * np.pi, sides + 1)[:, None, None]
    rings = points + radius * (np.cos(angles) * across + np.sin(angles) * np.cross(tangents, across))
    tips = np.broadcast_to(points[[0, -1]] + radius * tangents[[0, -1]] * [[-1], [1]], (sides + 1, 2, 3))
    rows = np.concatenate([tips[:, :1], rings, tips[:, 1:]], axis=1)
    return _sheet(rows, np.linspace(0.0, 1.0, sides + 1), np.linspace(0.0, 1.0, rows.shape[1]))


def _sheet(rows: FloatArray, u: FloatArray, v: FloatArray, every: int = 1) -> Surface:
    """Triangles between a grid of points ``rows (U, V, 3)``: from ``every`` such row to the next one."""
    count = rows.shape[1]
    first = (np.arange(0, len(rows) - 1, every)[:, None] * count + np.arange(count - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([first, first + count, first + count + 1], axis=1),
            np.stack([first, first + count + 1, first + 1], axis=1),
        ]
    )
    return Surface(rows.reshape(-1, 3), faces, np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2))


def add_surface(spec: mujoco.MjSpec, body: Body, name: str, surface: Surface, image: Image, shine: float = 0.2) -> None:
    """Show ``surface`` on ``body``, textured with sRGB ``image (H, W, 3)``; without collision."""
    mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert = surface.vertices.astype(np.float32).ravel()
    mesh.userface = surface.faces.astype(np.int32).ravel()
    mesh.usertexcoord = surface.uvs.astype(np.float32).ravel()
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=image.shape[1])
    texture.height, texture.nchannel, texture.data = image.shape[0], 3, np.ascontiguousarray(image).tobytes()
    material = spec.add_material(name=name, specular=shine, shininess=shine, reflectance=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=name,
        contype=0,
        conaffinity=0,
        mass=0.0,
        group=VISUAL_GROUP,
    )


def paint(color: ArrayLike) -> Image:
    """One colour, each channel 0 to 1."""
    return np.broadcast_to((np.clip(color, 0, 1) * 255).astype(np.uint8), (4, 4, 3)).copy()


def add_solid(
    body: Body,
    kind: mujoco.mjtGeom,
    size: ArrayLike,
    *,
    position: ArrayLike = (0.0, 0.0, 0.0),
    rotation: ArrayLike | None = None,
    mass: float = 0.0,
    friction: float = 0.6,
    **more: Any,
) -> Any:
    """A collision shape: a primitive of MuJoCo's ``size`` (half lengths), rotated by ``rotation (3, 3)``."""
    quaternion = np.array([1.0, 0.0, 0.0, 0.0])
    if rotation is not None:
        quaternion = Rotation.from_matrix(rotation).as_quat()[[3, 0, 1, 2]]
    sizes = np.zeros(3)
    sizes[: np.size(size)] = size
    return body.add_geom(
        type=kind,
        size=sizes,
        pos=position,
        quat=quaternion,
        mass=mass,
        friction=[friction, TORSION_M, ROLLING_M],
        condim=6,
        group=SOLID_GROUP,
        **more,
    )


def add_hull(
    spec: mujoco.MjSpec, body: Body, name: str, points: ArrayLike, *, friction: ArrayLike = 0.6, **more: Any
) -> Any:
    """A collision shape: the hull of ``points (N, 3)``; ``friction`` is sliding only, or MuJoCo's three values."""
    spec.add_mesh(name=name).uservert = np.asarray(points, dtype=np.float32).ravel()
    frictions = np.array([0.0, TORSION_M, ROLLING_M])
    frictions[: np.size(friction)] = friction
    options = {"condim": 6, "group": SOLID_GROUP} | more
    return body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, friction=frictions, **options)


def add_bar(body: Body, start: ArrayLike, stop: ArrayLike, radius: float, **more: Any) -> Any:
    """A capsule from ``start (3,)`` to ``stop (3,)``."""
    start, stop = np.asarray(start, dtype=np.float64), np.asarray(stop, dtype=np.float64)
    length = float(np.linalg.norm(stop - start))
    rotation = Rotation.align_vectors((stop - start)[None] / length, [[0.0, 0.0, 1.0]])[0].as_matrix()
    return add_solid(
        body,
        mujoco.mjtGeom.mjGEOM_CAPSULE,
        (radius, length / 2),
        position=(start + stop) / 2,
        rotation=rotation,
        **more,
    )


def free_body(spec: mujoco.MjSpec, name: str, pose: FloatArray) -> Body:
    """A free body at ``pose (4, 4)``."""
    body = fixed_body(spec, name, pose)
    body.add_freejoint(name=name)
    return body


def fixed_body(spec: mujoco.MjSpec, name: str, pose: FloatArray) -> Body:
    """A fixed body at ``pose (4, 4)``."""
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]
    return spec.worldbody.add_body(name=name, pos=pose[:3, 3], quat=quaternion)
