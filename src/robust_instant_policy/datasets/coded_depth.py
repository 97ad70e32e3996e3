"""Depth coded in a colour image, robust to lossy video, for recorders without depth streams (LeRobot 0.4).

The image is twice as high as the depth. Its upper half is grey, with coarse steps; black is no reading. The lower half
holds fringes of the period P, as in three-step phase shifting of structured light:

    I_k(d) = 1/2 + A cos(2 pi d / P - 2 pi k / 3)  in the channels k = 0, 1, 2.

Their phase gives the depth modulo P, the grey value the multiple of P.
"""

import numpy as np
from numpy.typing import NDArray

COARSE_M = 0.016  # a step of grey
FIRST_GREY = 24  # of depth 0; half of it and less is no reading
PERIOD_M = 0.256
AMPLITUDE = 112.0  # of the fringes, of 255
MAX_MISMATCH_M = 0.05  # of grey value and phase; more at edges, where the video blurs both
MAX_COLOUR = 12.0  # mean difference of the channels of a half that is grey
SHIFTS = 2 * np.pi * np.arange(3) / 3


def encode(depth: NDArray) -> NDArray[np.uint8]:
    """Image ``(2H, W, 3)`` of ``depth (H, W)`` metres; beyond 3.7 m, and where it is 0 or NaN, there is no reading."""
    metres = np.nan_to_num(np.asarray(depth, dtype=np.float64), posinf=0.0, neginf=0.0)
    grey = FIRST_GREY + metres / COARSE_M
    is_read = (metres > 0) & (grey <= 255)
    coarse = np.repeat(np.where(is_read, grey, 0.0)[..., None], 3, axis=-1)
    fringes = 127.5 + AMPLITUDE * np.cos(2 * np.pi * metres[..., None] / PERIOD_M - SHIFTS)
    return np.rint(np.concatenate([coarse, np.where(is_read[..., None], fringes, 127.5)])).astype(np.uint8)


def decode(image: NDArray[np.uint8]) -> NDArray[np.float32] | None:
    """Depth ``(H, W)`` metres of an image ``(2H, W, 3)``, NaN where there is no reading; None for other images."""
    height, rest = divmod(image.shape[0], 2)
    coarse, fringes = image[:height].astype(np.float64), image[height:].astype(np.float64)
    if rest or np.ptp(coarse, axis=-1).mean() > MAX_COLOUR:
        return None
    rough = (coarse.mean(axis=-1) - FIRST_GREY) * COARSE_M
    phase = np.arctan2(fringes @ np.sin(SHIFTS), fringes @ np.cos(SHIFTS))
    fine = phase * PERIOD_M / (2 * np.pi)
    depth = fine + PERIOD_M * np.rint((rough - fine) / PERIOD_M)
    is_read = (rough > -0.5 * FIRST_GREY * COARSE_M) & (depth > 0) & (np.abs(depth - rough) < MAX_MISMATCH_M)
    return np.where(is_read, depth, np.nan).astype(np.float32)
