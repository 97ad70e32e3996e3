"""Materials of surfaces: paint, metal, wood grain."""

from dataclasses import dataclass

import numpy as np
import sapien.render
from numpy.typing import NDArray

from robust_instant_policy.tasks.textures import Color, wood


@dataclass(frozen=True)
class Paint:
    """``color`` in sRGB, each 0 to 1; ``grain`` adds wood fibres along the faces' length."""

    color: Color
    roughness: float = 0.6
    metallic: float = 0.0
    grain: bool = False

    def material(self, seed: int = 0) -> sapien.render.RenderMaterial:
        """A material of this paint; ``seed`` selects the wood texture."""
        material = sapien.render.RenderMaterial()
        material.roughness, material.metallic, material.specular = self.roughness, self.metallic, 0.3
        if self.grain:
            material.base_color = [1.0, 1.0, 1.0, 1.0]
            material.base_color_texture = texture(wood(self.color, np.random.default_rng(seed)))
        else:
            material.base_color = [*(channel**2.2 for channel in self.color), 1.0]
        return material


def texture(image: NDArray[np.uint8]) -> sapien.render.RenderTexture2D:
    """A texture from an sRGB ``image (H, W, 3)``."""
    opaque = np.full((*image.shape[:2], 1), 255, dtype=np.uint8)
    return sapien.render.RenderTexture2D(np.concatenate([image, opaque], axis=2), "R8G8B8A8Unorm", srgb=True)


WHITE = Paint((0.93, 0.92, 0.89))
STEEL = Paint((0.78, 0.79, 0.81), roughness=0.35, metallic=0.35)
BRASS = Paint((0.80, 0.62, 0.25), roughness=0.35, metallic=0.35)
BLACK = Paint((0.08, 0.08, 0.09), roughness=0.5)
RED = Paint((0.78, 0.12, 0.10), roughness=0.4)
