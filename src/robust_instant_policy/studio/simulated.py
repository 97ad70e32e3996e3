"""The cells of simulated tasks: bodies of SAPIEN and MuJoCo as surfaces."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import UsageError
from robust_instant_policy.geometry import FloatArray, make_pose, transform_points
from robust_instant_policy.studio.cell import Surface
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.simulated_task import SimulatedTask

SETTLE_S = 0.5  # for objects that were moved by hand to come to rest
GAMMA = 2.2  # of the colours that MuJoCo takes; surfaces have linear ones
BACKDROP = ("ground", "mat")  # bodies that are not drawn: they hide the table or the page's own floor
FURNITURE = ("table-workspace", *BACKDROP)
PAINT_M = 1e-4  # discs closer than this are drawn APART times farther apart, for the depth buffer of a browser
APART = 30


class SimulatedCell:
    """The cell of a simulated task; see `cell.Cell`."""

    def __init__(self, name: str):
        task: object = make_task(name)
        if not isinstance(task, SimulatedTask):
            raise UsageError(f"{name} has no cell that can be operated by hand")
        self._task, self._cell = task, task.cell
        self.task, self.description, self.goal = task.name, task.description, task.goal
        self.arms, self.triangle = task.arms, task.arms[0].triangle
        self.control_hz, self.record_every = task.control_hz, round(task.control_hz / task.record_hz)
        self.execute_hz = task.execute_hz
        self.workspace: FloatArray | None = task.workspace
        self._bodies: _Bodies = _SapienBodies(task.cell) if hasattr(task.cell, "agent") else _MujocoBodies(task.cell)

    @property
    def movable(self) -> Sequence[str]:
        return self._bodies.movable()

    def reset(self, seed: int) -> Observation:
        observation = self._task.reset(seed)
        self.arms = self._task.arms
        return observation

    def move(self, body: str, pose: FloatArray) -> Observation:
        self._bodies.place(body, pose)
        rest = np.concatenate([[*arm.home, arm.finger_travel] for arm in self.arms])
        for _ in range(round(SETTLE_S * self.control_hz)):
            self.advance(rest)
        return self._cell.photograph()

    def surfaces(self) -> Sequence[Surface]:
        return list(self._bodies.surfaces())

    def poses(self) -> Mapping[str, FloatArray]:
        return self._bodies.poses()

    def tool_poses(self) -> FloatArray:
        return self._cell.tool_poses()

    def advance(self, command: FloatArray) -> None:
        self._cell.advance(command)

    def failure(self) -> str:
        return self._cell.failure()

    def close(self) -> None:
        self._task.close()


class _SapienBodies:
    """Entities of a scene of ManiSkill, by name."""

    def __init__(self, env: Any):
        self._env = env

    def movable(self) -> list[str]:
        actors = self._env.scene.actors.items()
        return [name for name, actor in actors if actor.px_body_type != "static" and name not in FURNITURE]

    def place(self, body: str, pose: FloatArray) -> None:
        import sapien

        actor = self._env.scene.actors[body]
        actor.set_pose(sapien.Pose(pose))
        if actor.px_body_type == "dynamic":
            actor.set_linear_velocity(np.zeros((1, 3), dtype=np.float32))
            actor.set_angular_velocity(np.zeros((1, 3), dtype=np.float32))

    def surfaces(self) -> Iterator[Surface]:
        import sapien.render

        for name, entity in self._entities().items():
            for component in entity.components:
                if isinstance(component, sapien.render.RenderBodyComponent):
                    shapes = component.render_shapes
                    lowest = min((shape.half_length for shape in shapes if hasattr(shape, "half_length")), default=0.0)
                    for shape in shapes:
                        yield from _sapien_surfaces(name, shape, lowest)

    def poses(self) -> dict[str, FloatArray]:
        found = self._entities().items()
        return {name: entity.pose.to_transformation_matrix().astype(np.float64) for name, entity in found}

    def _entities(self) -> dict[str, Any]:
        scene = self._env.scene
        entities = {name: actor._objs[0] for name, actor in scene.actors.items() if name not in BACKDROP}
        for articulation in scene.articulations.values():
            entities |= {link.name: link._objs[0].entity for link in articulation.links}
        return entities


def _sapien_surfaces(body: str, shape: Any, lowest: float) -> Iterator[Surface]:
    """Surfaces of a ``shape`` of a body whose shortest cylinder has the half length ``lowest``, metres."""

    def half_length() -> float:
        above = shape.half_length - lowest
        return lowest + (APART * above if above < PAINT_M else above)

    scales = {  # of the unit shapes that SAPIEN has for its primitives
        "RenderShapeBox": lambda: shape.half_size,
        "RenderShapeCylinder": lambda: (half_length(), shape.radius, shape.radius),
        "RenderShapeSphere": lambda: (shape.radius,) * 3,
        "RenderShapeTriangleMesh": lambda: shape.scale,
    }
    scale = np.asarray(scales.get(type(shape).__name__, lambda: (1.0, 1.0, 1.0))())
    pose = shape.local_pose.to_transformation_matrix()
    for part in shape.parts:
        vertices = transform_points(pose, scale * part.vertices)
        texture = part.material.base_color_texture
        image = None if texture is None else np.asarray(texture.download())[..., :3]
        uvs = None if texture is None else np.asarray(part.get_vertex_uv(), dtype=np.float64)
        yield Surface(body, vertices, np.asarray(part.triangles), np.array(part.material.base_color), uvs, image)


class _MujocoBodies:
    """Bodies of a MuJoCo model, by name; geoms that stand only for collisions are left out."""

    def __init__(self, env: Any):
        self._env = env

    def movable(self) -> list[str]:
        import mujoco

        model = self._env.model
        free = [joint for joint in range(model.njnt) if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE]
        return [model.body(model.jnt_bodyid[joint]).name for joint in free]

    def place(self, body: str, pose: FloatArray) -> None:
        import mujoco

        model, data = self._env.model, self._env.data
        joint = model.body(body).jntadr[0]
        start, speed = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        data.qpos[start : start + 7] = [*pose[:3, 3], w, x, y, z]
        data.qvel[speed : speed + 6] = 0.0
        mujoco.mj_forward(model, data)

    def surfaces(self) -> Iterator[Surface]:
        import mujoco

        model = self._env.model
        for geom in range(model.ngeom):
            kind = mujoco.mjtGeom(model.geom_type[geom])
            if model.geom_group[geom] > 2 or model.geom_rgba[geom, 3] == 0 or kind == mujoco.mjtGeom.mjGEOM_PLANE:
                continue
            rotation = Rotation.from_quat(model.geom_quat[geom][[1, 2, 3, 0]])
            pose = make_pose(rotation.as_matrix(), model.geom_pos[geom])
            body = model.body(model.geom_bodyid[geom]).name
            yield (
                _mesh(model, geom, body, pose)
                if kind == mujoco.mjtGeom.mjGEOM_MESH
                else _primitive(model, geom, body, pose, kind.name)
            )

    def poses(self) -> dict[str, FloatArray]:
        model, data = self._env.model, self._env.data
        bodies = np.unique(model.geom_bodyid)
        return {model.body(body).name: make_pose(data.xmat[body].reshape(3, 3), data.xpos[body]) for body in bodies}


def _mesh(model: Any, geom: int, body: str, pose: FloatArray) -> Surface:
    mesh = model.geom_dataid[geom]
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    faces_at = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
    vertices = transform_points(pose, model.mesh_vert[first : first + count])
    faces = model.mesh_face[faces_at]
    colour, image = _look(model, geom)
    if image is None or model.mesh_texcoordadr[mesh] < 0:
        return Surface(body, vertices, faces, colour)
    uvs = model.mesh_texcoord[model.mesh_texcoordadr[mesh] + model.mesh_facetexcoord[faces_at].ravel()]
    corners = vertices[faces.ravel()]  # a vertex may have several texture coordinates
    return Surface(body, corners, np.arange(len(corners)).reshape(-1, 3), colour, uvs.astype(np.float64), image)


def _primitive(model: Any, geom: int, body: str, pose: FloatArray, kind: str) -> Surface:
    import trimesh.creation

    size = model.geom_size[geom]
    shapes = {
        "mjGEOM_BOX": lambda: trimesh.creation.box(2 * size),
        "mjGEOM_SPHERE": lambda: trimesh.creation.icosphere(2, size[0]),
        "mjGEOM_CYLINDER": lambda: trimesh.creation.cylinder(size[0], 2 * size[1], sections=24),
        "mjGEOM_CAPSULE": lambda: trimesh.creation.cylinder(size[0], 2 * (size[0] + size[1]), sections=24),
        "mjGEOM_ELLIPSOID": lambda: trimesh.creation.icosphere(2).apply_scale(size),
    }
    made = shapes.get(kind, shapes["mjGEOM_BOX"])()
    return Surface(body, transform_points(pose, made.vertices), np.asarray(made.faces), _look(model, geom)[0])


def _look(model: Any, geom: int) -> tuple[FloatArray, np.ndarray | None]:
    """Linear colour ``(4,)`` and texture ``(H, W, 3)`` of a geom."""
    import mujoco

    material = model.geom_matid[geom]
    rgba = np.array(model.geom_rgba[geom] if material < 0 else model.mat_rgba[material], dtype=np.float64)
    colour = np.array([*(rgba[:3] ** GAMMA), rgba[3]])
    texture = -1 if material < 0 else model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB]
    if texture < 0:
        return colour, None
    height, width, channels = (model.tex_height[texture], model.tex_width[texture], model.tex_nchannel[texture])
    start = model.tex_adr[texture]
    image = model.tex_data[start : start + height * width * channels].reshape(height, width, channels)
    return colour, np.ascontiguousarray(image[..., :3])


_Bodies = _SapienBodies | _MujocoBodies
