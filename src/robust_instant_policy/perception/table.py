"""The table that objects stand on: its plane and its colour."""

from __future__ import annotations

import numpy as np

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.perception.descriptors import Float32Array

ON_TABLE_M = 0.006  # points this near to a plane speak for it
SAMPLED_POINTS = 1500
SAMPLED_PLANES = 60
LEVEL = 0.9  # upward part of a unit normal from which a plane counts as horizontal
GAUSSIAN_ROUNDS = 4
INLIER_DEVIATIONS = 3.0
COLOUR_NOISE = 0.02  # of a channel's range; less is the camera's noise


def table_plane(points: FloatArray, seed: int) -> FloatArray:
    """Plane ``(4,)`` (unit normal, upward; offset) that holds most of ``points (N, 3)`` and is nearly horizontal."""
    rng = np.random.default_rng(seed)
    points = points[rng.choice(len(points), min(len(points), SAMPLED_POINTS), replace=False)]
    corners = points[rng.integers(len(points), size=(SAMPLED_PLANES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[(level := np.abs(normals[:, 2]) > LEVEL * lengths) & (lengths > 0)]
    if len(normals) == 0:
        return np.array([0.0, 0.0, 1.0, -np.median(points[:, 2])])
    normals /= (np.sign(normals[:, 2]) * np.linalg.norm(normals, axis=1))[:, None]
    offsets = -(normals * corners[level & (lengths > 0), 0]).sum(axis=1)
    near = np.abs(points @ normals.T + offsets) < ON_TABLE_M
    inliers = points[near[:, near.sum(axis=0).argmax()]]
    centre = inliers.mean(axis=0)
    normal = np.linalg.eigh(np.cov((inliers - centre).T))[1][:, 0]
    normal = normal * np.sign(normal[2])
    return np.append(normal, -normal @ centre)


class TableColour:
    """The commonest of ``colours (N, 3)``: a Gaussian fitted to what remains when outliers are dropped."""

    def __init__(self, colours: Float32Array):
        for _ in range(GAUSSIAN_ROUNDS):
            self._mean = np.median(colours, axis=0)
            covariance = np.cov(colours.T) + COLOUR_NOISE**2 * np.eye(3)
            self._whiten = np.linalg.inv(np.linalg.cholesky(covariance)).T.astype(np.float32)
            colours = colours[self._deviations(colours) < INLIER_DEVIATIONS]

    def strangeness(self, colours: Float32Array) -> Float32Array:
        """How many deviations ``(N,)`` each of ``colours (N, 3)`` lies from the table's, shadows aside.

        A darker point is first brightened to the mean, since a shadow is the same colour, darker.
        """
        brightness = np.maximum(colours.mean(axis=1), COLOUR_NOISE)
        return self._deviations(colours * np.maximum(self._mean.mean() / brightness, 1)[:, None])

    def _deviations(self, colours: Float32Array) -> Float32Array:
        return np.sqrt((((colours - self._mean) @ self._whiten) ** 2).sum(axis=1))
