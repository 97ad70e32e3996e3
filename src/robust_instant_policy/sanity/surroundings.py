"""How far is a plan displaced from the place of a thing to which the demonstrations went?

At some moment of a task the gripper is always at the same place of the same thing. There, the heights and colours that
the start image shows around the gripper repeat from demonstration to demonstration. A plan is displaced by as much as a
new image's map around the planned gripper must be shifted to match theirs. No keypoints are used, so that this is a
second way to place the gripper, independent of the first.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import cKDTree

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.sanity.view import View
from robust_instant_policy.trajectory import ACTION_DIM, STATE_INDEX

CELL_M = 0.006  # side of a map's cell
HALF_CELLS = 10  # of the map that is matched, to each side of the gripper
REACH_CELLS = 6  # of the largest shift
COLOUR_M = 0.05  # difference of height that counts as much as the full range of a colour
FLOOR_M = np.array([0.004, 0.002, 0.002, 0.002])  # smallest deviation of height and colours
LOWEST_M, HIGHEST_M = -0.02, 0.25  # heights above the table are cut off there
OUTLIER = 9.0  # squared deviations, of a cell, that count at most
MIN_KNOWN = 0.5  # share of a map's cells that must be known
EVERY = 3  # steps from one moment that is tried to the next
MIN_VARIATION_M = 0.01  # of the gripper's place over the demonstrations; a common home says nothing
USUALLY = 0.75  # quantile over the demonstrations
UNKNOWN_M = 0.1  # as which a displacement counts that is not known
MOMENTS = 3  # that are kept for each arm
MIN_DEMONSTRATIONS = 3

_SIDE = CELL_M * np.arange(-HALF_CELLS - REACH_CELLS, HALF_CELLS + REACH_CELLS + 1)
_GRID = np.stack(np.meshgrid(_SIDE, _SIDE, indexing="ij"), axis=-1)  # (n, n, 2)
_INNER = slice(REACH_CELLS, -REACH_CELLS)


@dataclass(frozen=True, eq=False)
class Moment:
    """Step ``step`` of arm ``arm``: ``mean`` and ``deviation (m, m, 4)`` of height and colours around the gripper, on
    the world's axes or, ``turned``, the gripper's; ``precision``, metres, by which demonstrations are displaced."""

    step: int
    arm: int
    turned: bool
    mean: FloatArray
    deviation: FloatArray
    precision: float


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The ``moments`` of each arm at which what lies around the gripper repeats best; ``num_steps`` of a plan."""

    moments: tuple[tuple[Moment, ...], ...]
    num_steps: int

    @classmethod
    def of(cls, views: Sequence[View], actions: FloatArray) -> Self:
        """Of demonstrations: their ``views`` and aligned ``actions (I, T, 10·A)``, step t meaning the same in each."""
        steps, arms = actions.shape[1], actions.shape[2] // ACTION_DIM
        if len(views) < MIN_DEMONSTRATIONS:
            return cls(((),) * arms, steps)
        surfaces = [_Surface.of(view) for view in views]
        return cls(tuple(_best_moments(surfaces, actions, arm) for arm in range(arms)), steps)

    @property
    def precision(self) -> float:
        """By how much the demonstrations are displaced against each other, metres, of the worse arm; NaN unknown."""
        return max((own[0].precision for own in self.moments if own), default=float("nan"))

    def displacement(self, view: View, actions: FloatArray) -> float:
        """By how much a plan's ``actions (T, 10·A)`` are displaced in ``view``, metres, of the worse arm.

        NaN unknown.
        """
        if len(actions) != self.num_steps:
            return float("nan")
        surface = _Surface.of(view)
        found = [[_displacement(surface, actions, moment) for moment in own] for own in self.moments]
        known = [np.mean([d for d in own if np.isfinite(d)]) for own in found if np.isfinite(own).any()]
        return float(max(known, default=float("nan")))


@dataclass(frozen=True, eq=False)
class _Surface:
    """The points of a view from above: a ``tree`` of their places, and height and colours ``values (N, 4)``."""

    tree: cKDTree
    values: FloatArray

    @classmethod
    def of(cls, view: View) -> Self:
        known = np.isfinite(view.depth)
        height = np.clip(view.height[known], LOWEST_M, HIGHEST_M)
        return cls(cKDTree(view.points[known][:, :2]), np.column_stack([height, view.rgb[known] * (COLOUR_M / 255)]))

    def map(self, action: FloatArray, turned: bool) -> FloatArray:
        """Height and colours ``(n, n, 4)`` around the gripper of one arm's ``action (10,)``; NaN unknown."""
        _, left, right = action[:STATE_INDEX].reshape(3, 3)
        across = (left - right)[:2] / max(float(np.linalg.norm((left - right)[:2])), 1e-9)
        axes = np.array([across, [-across[1], across[0]]]) if turned else np.eye(2)
        places = ((left + right) / 2)[:2] + _GRID @ axes
        distance, nearest = self.tree.query(places.reshape(-1, 2))
        values = np.where((distance < 1.5 * CELL_M)[:, None], self.values[nearest], np.nan)
        return values.reshape(*places.shape[:2], -1).astype(np.float32)


def _best_moments(surfaces: Sequence[_Surface], actions: FloatArray, arm: int) -> tuple[Moment, ...]:
    """Those at which each demonstration is displaced least against the others."""
    own = actions[..., ACTION_DIM * arm : ACTION_DIM * (arm + 1)]
    middles = own[..., 3:STATE_INDEX].reshape(*own.shape[:2], 2, 3).mean(axis=2)  # (I, T, 3)
    varied = np.sqrt(middles.var(axis=0).sum(axis=-1)) > MIN_VARIATION_M
    changes = np.flatnonzero(np.diff(own[0, :, STATE_INDEX] > 0.5))
    tried = {*range(0, own.shape[1], EVERY), own.shape[1] - 1, *changes, *(changes + 1)}
    found = []
    for step in sorted(step for step in tried if varied[step]):
        for turned in (False, True):
            maps = np.stack([s.map(a[step], turned) for s, a in zip(surfaces, own, strict=True)])
            shifts = [
                shift(one, *_usual(np.delete(maps, index, axis=0)[:, _INNER, _INNER])) for index, one in enumerate(maps)
            ]
            usual = np.nan_to_num(shifts, nan=UNKNOWN_M)
            precision = float(np.quantile(usual, USUALLY))
            found.append(((precision, float(np.mean(usual))), step, turned, maps))
    found = [one for one in found if one[0][0] < UNKNOWN_M]
    found.sort(key=lambda one: one[0])
    return tuple(
        Moment(int(step), arm, turned, *_usual(maps[:, _INNER, _INNER]), precision)
        for (precision, _), step, turned, maps in found[:MOMENTS]
    )


def _usual(maps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and deviation ``(m, m, 4)`` of ``maps (I, m, m, 4)``; NaN where none knows a cell."""
    known = np.isfinite(maps)
    count = known.sum(axis=0)
    with np.errstate(invalid="ignore"):
        mean = np.where(known, maps, 0.0).sum(axis=0) / count
        variance = np.where(known, (maps - mean) ** 2, 0.0).sum(axis=0) / count
    return mean, np.sqrt(variance + FLOOR_M**2)


def _displacement(surface: _Surface, actions: FloatArray, moment: Moment) -> float:
    action = actions[moment.step, ACTION_DIM * moment.arm : ACTION_DIM * (moment.arm + 1)]
    return shift(surface.map(action, moment.turned), moment.mean, moment.deviation)


def shift(found: FloatArray, mean: FloatArray, deviation: FloatArray) -> float:
    """Distance, metres, by which ``found (n, n, 4)`` must be shifted to fit ``mean`` and ``deviation (m, m, 4)`` best.

    The squared deviations, cut off at `OUTLIER`, are averaged over the cells that are known. NaN where these are few.
    """
    windows = sliding_window_view(found, mean.shape[:2], axis=(0, 1))  # (k, k, 4, m, m)
    middle, weight = (np.moveaxis(values, -1, 0).astype(np.float32) for values in (mean, 1 / deviation))
    squares = ((windows - middle) * weight) ** 2
    known = np.isfinite(squares)
    share = known.mean(axis=(2, 3, 4))
    if share[REACH_CELLS, REACH_CELLS] < MIN_KNOWN:
        return float("nan")
    cost = np.where(known, np.minimum(squares, OUTLIER), 0.0).mean(axis=(2, 3, 4)) / np.maximum(share, MIN_KNOWN)
    cost[share < MIN_KNOWN] = np.inf
    best = np.array(np.unravel_index(int(cost.argmin()), cost.shape)) - REACH_CELLS
    return float(CELL_M * np.linalg.norm(best))
