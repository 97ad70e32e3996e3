"""Textures of materials, as sRGB images."""

import numpy as np
from numpy.typing import NDArray

Color = tuple[float, float, float]

GRAIN_PIXELS = 128
GRAIN_LINES = 9  # across a face
GRAIN_CONTRAST = 0.16
BRISTLE_CONTRAST = 0.25

LAMINATE: Color = (0.80, 0.80, 0.78)
LAMINATE_PIXELS = 512
LAMINATE_CONTRAST = 0.02


def wood(color: Color, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Wood with fibres along the rows of the image."""
    down = np.linspace(0.0, 1.0, GRAIN_PIXELS)[:, None]
    along = np.linspace(0.0, 1.0, GRAIN_PIXELS)[None]
    bend = 0.04 * np.sin(2 * np.pi * (along * rng.uniform(0.5, 1.5) + rng.random()))
    fibres = np.zeros((GRAIN_PIXELS, GRAIN_PIXELS))
    for octave in (1.0, 2.3, 5.1):
        fibres += np.sin(2 * np.pi * (GRAIN_LINES * octave * (down + bend) + rng.random())) / octave
    fibres += 0.5 * np.repeat(rng.normal(0.0, 1.0, (GRAIN_PIXELS, 1)), GRAIN_PIXELS, axis=1)
    shade = 1.0 + GRAIN_CONTRAST * fibres / np.abs(fibres).max()
    return (np.clip(np.array(color) * shade[..., None], 0.0, 1.0) * 255).astype(np.uint8)


def laminate(rng: np.random.Generator) -> NDArray[np.uint8]:
    """A light grey, slightly speckled table top."""
    speckle = rng.normal(0.0, 1.0, (LAMINATE_PIXELS, LAMINATE_PIXELS, 1))
    return (np.clip(np.array(LAMINATE) * (1 + LAMINATE_CONTRAST * speckle), 0.0, 1.0) * 255).astype(np.uint8)


def bristles(color: Color, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Bristles along the columns of the image."""
    shade = 1 + BRISTLE_CONTRAST * rng.normal(0.0, 1.0, (1, GRAIN_PIXELS, 1))
    return np.broadcast_to(
        (np.clip(np.array(color) * shade, 0.0, 1.0) * 255).astype(np.uint8), (GRAIN_PIXELS, GRAIN_PIXELS, 3)
    ).copy()
