"""The colour of the table that objects stand on."""

from __future__ import annotations

import numpy as np

from robust_instant_policy.perception.descriptors import Float32Array

GAUSSIAN_ROUNDS = 4
INLIER_DEVIATIONS = 3.0
COLOUR_NOISE = 0.02  # of a channel's range; less is the camera's noise


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
