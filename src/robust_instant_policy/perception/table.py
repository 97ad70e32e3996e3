"""The table in an image: its plane, where it ends, and its colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from robust_instant_policy.geometry import MAD_TO_STD, FloatArray, make_pose
from robust_instant_policy.perception.descriptors import Float32Array
from robust_instant_policy.pointcloud import table_plane

COLOUR_SAMPLES = 1000  # pixels of the table from which its colour is fitted,
TRIM_ROUNDS = 4  # in so many rounds, each without the pixels
TRIM_DEVIATIONS = 3.0  # beyond this Mahalanobis distance
COLOUR_NOISE = 0.02  # standard deviation of the camera's noise in a colour channel, of a range of 1
MIN_HEIGHT_M = 0.010  # above the table, for points of objects,
MIN_HEIGHT_DEVIATIONS = 4.0  # or this many standard deviations of the depth noise, if that is more
BELOW_M = 0.05  # a ray that ends this far under the plane has passed the table
MIN_BELOW_SHARE = 0.01  # of the image's points: fewer are errors of the depth
SQUARE_M = 0.005  # of the plane, that is on or beside the table as a whole
EDGE_MARGIN_M = 0.02  # by which an object may reach over the edge


@dataclass(frozen=True, eq=False)
class Table:
    """``plane (4,)``: unit normal, upward, and offset; ``noise``: standard deviation of its points, metres;
    ``on (N, 2)`` and ``off (M, 2)``: places in the plane, metres, where rays meet the table or pass beside it.
    """

    plane: FloatArray
    noise: float
    on: FloatArray
    off: FloatArray

    @classmethod
    def find(cls, points: FloatArray, camera: FloatArray, seed: int) -> Table:
        """The table in ``points (N, 3)`` that a camera at ``camera (3,)`` sees, metres, world."""
        plane = table_plane(points, seed)
        heights = points @ plane[:3] + plane[3]
        near = np.abs(heights)[np.abs(heights) < MIN_HEIGHT_M]
        noise = float(MAD_TO_STD * np.median(near)) if len(near) else 0.0
        below = heights < -max(BELOW_M, MIN_HEIGHT_DEVIATIONS * noise)
        if below.mean() < MIN_BELOW_SHARE:
            below[:] = False
        level = levelling(plane)[:3, :3]
        camera_height = camera @ plane[:3] + plane[3]
        share = (camera_height / (camera_height - heights[below]))[:, None]
        crossings = camera + share * (points[below] - camera)
        return cls(
            plane, noise, (points[np.abs(heights) < MIN_HEIGHT_M] @ level.T)[:, :2], (crossings @ level.T)[:, :2]
        )

    def heights(self, points: FloatArray) -> FloatArray:
        """Heights ``(N,)`` of ``points (N, 3)`` above the table, metres."""
        return points @ self.plane[:3] + self.plane[3]

    @property
    def least_height(self) -> float:
        """From which a point is above the table, metres."""
        return max(MIN_HEIGHT_M, MIN_HEIGHT_DEVIATIONS * self.noise)

    def beside(self, points: FloatArray) -> NDArray[np.bool_]:
        """Which of ``points (N, 3)`` are not above the table: their nearest place that a ray has tested is empty."""
        if not len(self.off) or not len(self.on):
            return np.zeros(len(points), dtype=bool)
        places = (points @ levelling(self.plane)[:3, :3].T)[:, :2]
        squares, of = np.unique(np.rint(places / SQUARE_M) @ (1, 1j), return_inverse=True)
        centres = np.stack([squares.real, squares.imag], axis=1) * SQUARE_M
        to_table, to_nothing = (
            cKDTree(tested[:: max(1, len(tested) // 4000)]).query(centres)[0] for tested in (self.on, self.off)
        )
        return (to_table > to_nothing + EDGE_MARGIN_M)[of]


def levelling(plane: FloatArray) -> FloatArray:
    """The smallest rotation ``(4, 4)`` that makes the normal of ``plane (4,)`` vertical."""
    a, b, c, _ = plane
    cross = np.array([[0, 0, -a], [0, 0, -b], [a, b, 0.0]])
    return make_pose(np.eye(3) + cross + cross @ cross / (1 + c), [0, 0, 0])


@dataclass(frozen=True, eq=False)
class TableColour:
    """Gaussian of the table's colours in [0, 1]: ``mean (3,)``; ``whitening (3, 3)`` maps to unit covariance."""

    mean: Float32Array
    whitening: Float32Array

    @classmethod
    def fit(cls, colours: Float32Array) -> TableColour:
        """Fitted to ``colours (N, 3)``, outliers trimmed."""
        colours = colours[:: max(1, len(colours) // COLOUR_SAMPLES)]
        for _ in range(TRIM_ROUNDS):
            covariance = np.cov(colours.T) + COLOUR_NOISE**2 * np.eye(3)
            whitening = np.linalg.inv(np.linalg.cholesky(covariance)).T.astype(np.float32)
            table = cls(np.median(colours, axis=0), whitening)
            colours = colours[table._mahalanobis(colours) < TRIM_DEVIATIONS]
        return table

    def distance(self, colours: Float32Array) -> Float32Array:
        """Mahalanobis distances ``(N,)`` of ``colours (N, 3)``, each first scaled up to the table's brightness.

        A shadow has the table's colour, darker.
        """
        brightness = np.maximum(colours.mean(axis=1), COLOUR_NOISE)
        return self._mahalanobis(colours * np.maximum(self.mean.mean() / brightness, 1)[:, None])

    def _mahalanobis(self, colours: Float32Array) -> Float32Array:
        return np.sqrt((((colours - self.mean) @ self.whitening) ** 2).sum(axis=1))
