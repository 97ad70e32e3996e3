"""Geometry and markup that the page shows; nothing here knows the browser."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Sequence

import numpy as np
import trimesh
from PIL import Image

from robust_instant_policy.studio.cell import Surface

MAX_TEXTURE_PIXELS = 512
ROUGHNESS = 0.75


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
