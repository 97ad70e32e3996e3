"""How smooth the curve is: chosen from the data, by the error that each choice may be expected to have."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from robust_instant_policy.regression.basis import multiply_banded, solve_banded

if TYPE_CHECKING:
    from robust_instant_policy.regression.student_t import PenalisedLikelihood, State

STIFFNESSES = np.array([0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1000.0])  # prices on squared acceleration, in 1/σ²
CORNER_SWEEPS = 2  # reweightings of the accelerations at each stiffness tried
NEARLY_GAUSSIAN_DOF = 30.0  # from here on smoothing fades, so that ν → ∞ is the mean of the candidates


def choose_stiffness(model: PenalisedLikelihood, state: State) -> float:
    """The price on accelerations whose curve is expected to lie closest to the truth.

    Smoothing by S moves the unsmoothed curve ȳ, whose error has covariance C; the expected squared error of Sȳ is
    |Sȳ - ȳ|² + 2 tr(S C) up to a constant (Mallows' Cp). C is measured as the scatter of what each candidate
    contributes to ȳ, so that errors that wander along a candidate are not taken for detail of the curve.
    """
    if len(model.data) < 2 or not model.roughness.count:
        return 0.0
    unit, acceleration = np.sqrt(state.squared_scale), model.acceleration(state)
    normal, pulls = model.pulls(state)
    pulls = np.asfortranarray((pulls / unit).reshape(len(normal[0]), -1))
    target = multiply_banded(normal + model.price_matrix(state.squared_scale, acceleration, 0.0), state.curve)
    smooth = state
    inflation = 2 * len(model.data) / (len(model.data) - 1)
    best, choice = np.inf, 0.0
    for stiffness in (0.0, *STIFFNESSES * smoothing_share(model.dof)):
        for _ in range(CORNER_SWEEPS):
            bands = normal + model.price_matrix(state.squared_scale, model.acceleration(smooth), stiffness)
            smooth = replace(smooth, curve=solve_banded(bands, target))
        moved = (smooth.curve - state.curve) / unit
        risk = (moved * multiply_banded(normal, moved)).sum()
        risk += inflation * (pulls * solve_banded(bands, pulls)).sum()
        if risk < best:
            best, choice = risk, stiffness
    return choice


def smoothing_share(dof: float) -> float:
    """How much of all smoothing is wanted: 1, but ever less where ν → ∞ is to be the mean of the candidates."""
    return min(1.0, NEARLY_GAUSSIAN_DOF / dof) ** 2
