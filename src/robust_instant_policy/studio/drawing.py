"""Geometry that the page shows, independent of the browser."""

import hashlib
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies import Plan
from robust_instant_policy.studio.cell import Surface
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX

MAX_TEXTURE_PIXELS = 512
ROUGHNESS = 0.75
UNLIT = "KHR_materials_unlit"
WIDE_M2, UP = 0.1, 0.9  # area from which faces are wide, and vertical part of a normal that looks up
TUBE_SIDES = 12
TUBE_M = (0.003, 0.06)  # least and largest radius that is drawn
DASH = 2  # steps of a dash, and of the gap behind it
FOLLOWED, IGNORED = (0, 110, 60), (255, 244, 170)  # colours of the weights 1 and 0


def digest(surfaces: Sequence[Surface]) -> str:
    """Equal for equal ``surfaces``."""
    state = hashlib.blake2b(digest_size=16)
    for surface in surfaces:
        for array in (surface.vertices, surface.faces, surface.colour, surface.uvs, surface.texture):
            state.update(b"-" if array is None else np.ascontiguousarray(array).tobytes())
    return state.hexdigest()


def glb(surfaces: Sequence[Surface]) -> bytes:
    """The ``surfaces`` of one body as a binary glTF file. Wide faces that look up are drawn without lighting: lighting
    them takes a browser without a GPU a third of its time, and would change their colours by a few percent."""
    scene = trimesh.Scene()
    for surface in surfaces:
        wide = _looks_up(surface)
        for faces, name in ((surface.faces[~wide], "lit"), (surface.faces[wide], UNLIT)):
            if len(faces):
                scene.add_geometry(_mesh(surface, faces, name))
    with io.BytesIO() as buffer:
        scene.export(buffer, file_type="glb", tree_postprocessor=_mark_unlit)
        return buffer.getvalue()


def _looks_up(surface: Surface) -> np.ndarray:
    """Which of the ``faces (F,)`` look up, where these are wide in all."""
    corners = surface.vertices[surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # twice as long as the area
    up = normals[:, 2] > UP * np.linalg.norm(normals, axis=1)
    return up & (normals[up, 2].sum() / 2 > WIDE_M2)


def _mesh(surface: Surface, faces: np.ndarray, name: str) -> trimesh.Trimesh:
    image = None
    if surface.texture is not None:
        image = Image.fromarray(np.ascontiguousarray(surface.texture))
        image.thumbnail((MAX_TEXTURE_PIXELS, MAX_TEXTURE_PIXELS))
    material = trimesh.visual.material.PBRMaterial(
        name=name,
        baseColorFactor=np.clip(surface.colour * 255, 0, 255).astype(np.uint8),
        metallicFactor=0.0,
        roughnessFactor=ROUGHNESS,
        baseColorTexture=image,
    )
    visual = trimesh.visual.TextureVisuals(uv=surface.uvs, material=material)
    return trimesh.Trimesh(surface.vertices, faces, visual=visual, process=False)


def _mark_unlit(tree: dict[str, Any]) -> None:
    for material in tree.get("materials", ()):
        if material["name"] == UNLIT:
            material["extensions"] = {UNLIT: {}}
            tree["extensionsUsed"] = sorted({*tree.get("extensionsUsed", ()), UNLIT})


def polyline(points: FloatArray) -> FloatArray:
    """The segments ``(T - 1, 2, 3)`` between ``points (T, 3)``."""
    return np.stack([points[:-1], points[1:]], axis=1)


def weighed(plan: Plan, index: int, arm: int) -> tuple[FloatArray, np.ndarray]:
    """Segments ``(S, 2, 3)`` of a candidate's path and their colours ``(S, 2, 3)`` uint8 by weight.

    From the step on at which it is hallucinated, the path is dashed.
    """
    candidate = plan.candidates[index]
    weight = np.interp(candidate.times, plan.trajectory.times, plan.weights[index])
    share = np.clip(weight, 0, 1)[:, None]
    colours = (share * FOLLOWED + (1 - share) * IGNORED).astype(np.uint8)
    segments, steps = polyline(candidate.tool_points[:, arm]), np.arange(len(candidate) - 1)
    shown = np.ones(len(steps), dtype=bool)
    if plan.hallucinated[index]:
        shown = (steps < plan.onset[index]) | (steps // DASH % 2 == 0)
    return segments[shown], polyline(colours)[shown]


def spread(plan: Plan, arm: int) -> FloatArray:
    """Root-mean-square spread ``(T,)`` of an arm's points about the robust trajectory, metres."""
    columns = slice(ACTION_DIM * arm, ACTION_DIM * arm + STATE_INDEX)
    return np.sqrt((plan.scale[:, columns] ** 2).sum(axis=1) / 3)


def tube(points: FloatArray, radii: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Vertices ``(V, 3)`` and faces ``(F, 3)`` of a tube about ``points (T, 3)`` with ``radii (T,)``, metres."""
    along = np.gradient(points, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    aside = np.cross(along, [0.0, 0.0, 1.0])
    flat = np.linalg.norm(aside, axis=1) < 1e-3  # vertical stretches
    aside[flat] = [1.0, 0.0, 0.0]
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    other = np.cross(along, aside)
    angle = np.linspace(0, 2 * np.pi, TUBE_SIDES, endpoint=False)[:, None, None]
    rings = points + np.clip(radii, *TUBE_M)[:, None] * (np.cos(angle) * aside + np.sin(angle) * other)
    vertices = np.swapaxes(rings, 0, 1).reshape(-1, 3)
    step, side = np.meshgrid(np.arange(len(points) - 1), np.arange(TUBE_SIDES), indexing="ij")
    corner = [step * TUBE_SIDES + side, step * TUBE_SIDES + (side + 1) % TUBE_SIDES]
    faces = [
        [corner[0], corner[1], corner[0] + TUBE_SIDES],
        [corner[1], corner[1] + TUBE_SIDES, corner[0] + TUBE_SIDES],
    ]
    return vertices, np.concatenate([np.stack(face, axis=-1).reshape(-1, 3) for face in faces])
