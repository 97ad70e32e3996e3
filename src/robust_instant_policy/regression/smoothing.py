"""How smooth the curve is: the stiffness with the least expected error."""

from dataclasses import replace

import numpy as np

from robust_instant_policy.regression.curve import multiply_banded, solve_banded
from robust_instant_policy.regression.likelihood import Fit, Problem, mean_over_scale, normal_equations, prices

STIFFNESSES = np.array([0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1000.0])  # λ that are tried, in 1/σ²
CORNER_SWEEPS = 2  # reweightings of the second differences at each stiffness tried


def choose_stiffness(problem: Problem, fit: Fit) -> Problem:
    """The problem with the stiffness λ whose curve is expected to lie closest to the truth, and the scale of ``fit``.

    Smoothing by S moves the unsmoothed curve ȳ, whose error has covariance C; the expected squared error of Sȳ is

        |Sȳ - ȳ|² + 2 tr(S C) + constant        (Mallows' Cp)

    C is measured as the scatter of the candidates' score contributions, each candidate as a whole, so that errors
    that are correlated along a candidate are not taken for detail of the curve.
    """
    fixed = replace(problem, fixed_scale=fit.squared_scale)
    count = len(problem.data)
    if count < 2 or not problem.differences.count:
        return fixed
    unit = np.sqrt(fit.squared_scale)
    normal, contributions = normal_equations(problem, fit)
    contributions = np.asfortranarray((contributions / unit).reshape(len(normal[0]), -1))
    penalty = problem.differences.penalty_matrix
    target = multiply_banded(normal + penalty(prices(problem, fit.squared_scale, fit.curvature, normal)), fit.curve)
    curve, curvature, least, choice = fit.curve, fit.curvature, np.inf, fixed
    for stiffness in (0.0, *STIFFNESSES):
        tried = replace(fixed, stiffness=float(stiffness))
        for _ in range(CORNER_SWEEPS):
            bands = normal + penalty(prices(tried, fit.squared_scale, curvature, normal))
            curve = solve_banded(bands, target)
            curvature = mean_over_scale(problem.differences(curve) ** 2, fit.squared_scale)
        moved = (curve - fit.curve) / unit
        risk = (moved * multiply_banded(normal, moved)).sum()
        risk += 2 * count / (count - 1) * (contributions * solve_banded(bands, contributions)).sum()
        if risk < least:
            least, choice = risk, tried
    return choice
