"""What all images show in and around an object: it tells its turn where its own points look the same after some.

A horizontal grid in the object's frame. For each cell the images tell the chance that something stands there: a handle,
a door or a lever of few points decides, where a mean over all of the object's points would not. Objects that differ in
size between images also have typical sizes along their two horizontal axes: a wrong turn exchanges these. And they have
a typical height: another thing is higher or lower.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from robust_instant_policy.geometry import FloatArray, robust_std
from robust_instant_policy.perception.registration import horizontal_axes
from robust_instant_policy.perception.view import FREE, OCCUPIED, View

CELL_M = 0.006
CONTEXT_M = 0.06  # around the object
BLUR_CELLS = 0.7  # standard deviation
LEAST_CHANCE = 0.12  # that a cell is not as in all images before
EVIDENCE_SCALE = 8.0  # neighbouring cells of the grid are not independent
PRIOR_DEVIATION = 0.12  # of the logarithm of a size, before any image,
LIFT_M = 0.2  # by which an object is higher, that counts like one that is larger by a factor of e
PRIOR_IMAGES = 2  # that counts like this many
LEAST_DEVIATION = 2.0  # of the logarithm of the chance, added to that over the images
UNUSUAL_DEVIATIONS = 3.0  # below what is usual, for a confidence of 1/e
UNUSUAL_LIFT_M = 0.02  # above or below where it usually is, for a confidence of 1/e
MAX_SIZE_PENALTIES = 6.0, 6.0, 12.0  # of the logarithm of the chance, for each axis, and for the height


@dataclass(frozen=True, eq=False)
class Surroundings:
    """``evidence_of (3, n)``: for each of n ``cells (n, 2)``, horizontal places in the reference image's world, metres,
    the logarithm of the chance of its state in an image (see `view.Ground`) against that of a coin; whether the motions
    in the images include changes of size, ``stretch``; the object's horizontal ``axes (2, 2)`` as rows, and the median
    and the deviation ``sizes (2, 3)`` of how much larger it is along them and how much higher (`log_sizes`); the same,
    ``usual (2,)``, of `log_chance` in the images, where it is known.
    """

    cells: FloatArray
    evidence_of: FloatArray
    stretch: bool
    axes: FloatArray
    sizes: FloatArray
    usual: FloatArray | None = None

    @classmethod
    def of(
        cls, points: FloatArray, views: Sequence[View], motions: Sequence[FloatArray], stretch: bool
    ) -> Surroundings:
        """Of an object with ``points (N, 3)`` in the reference image, at its ``motions`` in ``views``."""
        cells, shape = grid_around(points)
        axes = horizontal_axes(points)[:2, :2]
        states = np.array([shown(cells, view, motion[None])[0] for view, motion in zip(views, motions, strict=True)])
        sizes = log_sizes(axes, np.array(motions))
        seen = cls.from_states(cells, shape, states, stretch, axes, sizes)
        chances = seen.log_chance_of(states, sizes)[1:]  # the first is the reference image
        return replace(seen, usual=np.stack([np.median(chances), robust_std(chances)])) if len(chances) else seen

    @classmethod
    def from_states(
        cls,
        cells: FloatArray,
        shape: tuple[int, int],
        states: NDArray[np.int8],
        stretch: bool,
        axes: FloatArray,
        sizes: FloatArray,
    ) -> Surroundings:
        """From the ``states (I, n)`` of ``cells (n, 2)`` of a grid of ``shape`` and the `log_sizes` ``(I, 3)`` along
        ``axes (2, 2)`` in I images.
        """
        occupied, free = (states == OCCUPIED).sum(axis=0), (states == FREE).sum(axis=0)
        chance = ((occupied + 0.5) / (occupied + free + 1)).reshape(shape)
        chance = gaussian_filter(chance, BLUR_CELLS).clip(LEAST_CHANCE, 1 - LEAST_CHANCE).reshape(-1)
        evidence = np.log(2 * np.stack([np.full(len(cells), 0.5), 1 - chance, chance]))
        variance = PRIOR_IMAGES * PRIOR_DEVIATION**2 + len(sizes) * robust_std(sizes) ** 2
        deviation = np.sqrt(variance / (PRIOR_IMAGES + len(sizes)))
        return cls(cells, evidence, stretch, axes, np.stack([np.median(sizes, axis=0), deviation]))

    def log_chance(self, view: View, motions: FloatArray) -> FloatArray:
        """Logarithms ``(C,)`` of the chance of what ``view`` shows around the object, of its size and of its height,
        at ``motions (C, 4, 4)``.
        """
        return self.log_chance_of(shown(self.cells, view, motions), log_sizes(self.axes, motions))

    def likeness(self, view: View, motion: FloatArray) -> float:
        """In [0, 1], less the more `log_chance` at ``motion (4, 4)`` is below what is usual, and at another height."""
        if self.usual is None:
            return 1.0
        lack = self.usual[0] - float(self.log_chance(view, motion[None])[0])
        lift = LIFT_M * abs(log_sizes(self.axes, motion[None])[0, 2] - self.sizes[0, 2])
        return float(
            np.exp(-max(lack, 0) / (UNUSUAL_DEVIATIONS * (self.usual[1] + LEAST_DEVIATION)) - lift / UNUSUAL_LIFT_M)
        )

    def log_chance_of(self, states: NDArray[np.int8], sizes: FloatArray) -> FloatArray:
        """The same of ``states (C, n)`` of the cells and `log_sizes` ``(C, 3)``."""
        evidence = self.evidence_of[states, np.arange(len(self.cells))].sum(axis=1) / EVIDENCE_SCALE
        return np.asarray(evidence - self._size_penalties(sizes).sum(axis=1))

    def height_penalty(self, motions: FloatArray) -> FloatArray:
        """What the height at ``motions (C, 4, 4)`` takes from the logarithm of their chance, ``(C,)``."""
        return self._size_penalties(log_sizes(self.axes, motions))[:, 2]

    def _size_penalties(self, sizes: FloatArray) -> FloatArray:
        return np.minimum(((sizes - self.sizes[0]) / self.sizes[1]) ** 2 / 2, MAX_SIZE_PENALTIES)


def log_sizes(axes: FloatArray, motions: FloatArray) -> FloatArray:
    """Logarithms of the factors by which ``motions (C, 4, 4)`` stretch an object along ``axes (2, 2)``, and by how much
    they lift it, in units of `LIFT_M`: ``(C, 3)``.
    """
    stretched = np.log(np.linalg.norm(motions[:, :2, :2] @ axes.T, axis=1))
    return np.concatenate([stretched, motions[:, 2:3, 3] / LIFT_M], axis=1)


def grid_around(points: FloatArray) -> tuple[FloatArray, tuple[int, int]]:
    """Cells ``(n, 2)`` around an object with ``points (N, 3)``, metres, and the shape of their grid."""
    lower, upper = points[:, :2].min(axis=0) - CONTEXT_M, points[:, :2].max(axis=0) + CONTEXT_M
    axes = [np.arange(start, end, CELL_M) for start, end in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2), (len(axes[0]), len(axes[1]))


def shown(cells: FloatArray, view: View, motions: FloatArray) -> NDArray[np.int8]:
    """What ``view`` shows at ``cells (n, 2)`` of the reference image under ``motions (C, 4, 4)``: states ``(C, n)``."""
    return view.ground.at(cells @ np.swapaxes(motions[:, :2, :2], 1, 2) + motions[:, None, :2, 3])
