"""Geometry and markup that the page shows; nothing here knows the browser."""

from __future__ import annotations

import base64
import hashlib
import html
import io
from collections.abc import Sequence

import numpy as np
import trimesh
from PIL import Image

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.perception import KeypointExtractor
from robust_instant_policy.policies import Context, LocatedScene, Plan
from robust_instant_policy.studio.cell import Surface
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX, Trajectory

MAX_TEXTURE_PIXELS = 512
ROUGHNESS = 0.75
TUBE_SIDES = 12
TUBE_M = (0.003, 0.06)  # least and largest radius that is drawn
DASH = 2  # steps of a dash, and of the gap behind it
FOLLOWED, IGNORED = np.array([0, 110, 60]), np.array([255, 244, 170])  # colours of the weights 1 and 0
KEYPOINT_COLOURS = ("#e6194b", "#3cb44b", "#ffe119", "#4363d8", "#f58231", "#911eb4", "#42d4f4", "#f032e6")


def digest(surfaces: Sequence[Surface]) -> str:
    """Equal for equal ``surfaces``."""
    state = hashlib.blake2b(digest_size=16)
    for surface in surfaces:
        for array in (surface.vertices, surface.faces, surface.colour, surface.texture):
            state.update(b"-" if array is None else np.ascontiguousarray(array).tobytes())
    return state.hexdigest()


def glb(surfaces: Sequence[Surface]) -> bytes:
    """The ``surfaces`` of one body as a binary glTF file."""
    scene = trimesh.Scene()
    for surface in surfaces:
        material = trimesh.visual.material.PBRMaterial(
            baseColorFactor=np.clip(surface.colour * 255, 0, 255).astype(np.uint8),
            metallicFactor=0.0,
            roughnessFactor=ROUGHNESS,
            baseColorTexture=None if surface.texture is None else _image(surface.texture),
        )
        visual = trimesh.visual.TextureVisuals(uv=surface.uvs, material=material)
        scene.add_geometry(trimesh.Trimesh(surface.vertices, surface.faces, visual=visual, process=False))
    with io.BytesIO() as buffer:
        scene.export(buffer, file_type="glb")
        return buffer.getvalue()


def _image(texture: np.ndarray) -> Image.Image:
    image = Image.fromarray(np.ascontiguousarray(texture))
    image.thumbnail((MAX_TEXTURE_PIXELS, MAX_TEXTURE_PIXELS))
    return image


def tool_path(trajectory: Trajectory, arm: int) -> FloatArray:
    """Midpoints ``(T, 3)`` between the fingertips, metres."""
    return trajectory.triplets[:, arm, 1:].mean(axis=1)


def polyline(points: FloatArray) -> FloatArray:
    """The segments ``(T - 1, 2, 3)`` between ``points (T, 3)``."""
    return np.stack([points[:-1], points[1:]], axis=1)


def weighed(plan: Plan, index: int, arm: int) -> tuple[FloatArray, np.ndarray]:
    """Segments ``(S, 2, 3)`` of a candidate's path and their colours ``(S, 2, 3)`` uint8 by weight.

    From the step on at which it is hallucinated, the path is dashed.
    """
    candidate = plan.candidates[index]
    weight = np.interp(candidate.times, plan.trajectory.times, plan.weights[index])
    colours = (IGNORED + np.clip(weight, 0, 1)[:, None] * (FOLLOWED - IGNORED)).astype(np.uint8)
    segments, steps = polyline(tool_path(candidate, arm)), np.arange(len(candidate) - 1)
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


def keypoint_picture(rgb: np.ndarray, context: Context | None = None, scene: LocatedScene | None = None) -> str:
    """HTML of the start image, with the keypoints of ``scene``; the pointer on one tells what is known of it."""
    height, width = rgb.shape[:2]
    with io.BytesIO() as buffer:
        Image.fromarray(rgb).save(buffer, "JPEG", quality=88)
        data = base64.b64encode(buffer.getvalue()).decode()
    marks = []
    if context is not None and scene is not None:
        size = width / 256
        for index, (u, v) in enumerate(scene.located.pixels + 0.5):
            told = html.escape(_known(context, scene, index))
            colour = KEYPOINT_COLOURS[index % len(KEYPOINT_COLOURS)]
            marks.append(
                f'<g class="keypoint"><title>{told}</title><circle cx="{u:.1f}" cy="{v:.1f}" r="{5 * size:.1f}" '
                f'fill="{colour}" stroke="#000" stroke-width="{size:.1f}"/><text x="{u:.1f}" y="{v + 2.4 * size:.1f}" '
                f'font-size="{7 * size:.1f}" text-anchor="middle">{index}</text></g>'
            )
    return (
        f'<svg viewBox="0 0 {width} {height}" style="width:100%;border-radius:6px">'
        f'<image href="data:image/jpeg;base64,{data}" width="{width}" height="{height}"/>{"".join(marks)}</svg>'
    )


def _known(context: Context, scene: LocatedScene, index: int) -> str:
    """What is known of a keypoint: its object, how sure it is here, and in the demonstrations."""
    sure = f"here {scene.located.confidence[index]:.2f}"
    if not isinstance(context.extractor, KeypointExtractor):
        return f"keypoint {index}: confidence {sure}"
    shown = ", ".join(f"{value:.2f}" for value in context.extractor.confidence_[:, index])
    return (
        f"keypoint {index} on object {context.extractor.object_of_[index]}: confidence {sure}; demonstrations {shown}"
    )
