"""Rejection of outlying stretches: a hallucination is seldom a matter of one step."""

from dataclasses import replace

import numpy as np

from robust_instant_policy.regression.em import expected_precision
from robust_instant_policy.regression.likelihood import Fit, Problem, evaluate
from robust_instant_policy.regression.viterbi import viterbi

OUTLYING = 0.7  # -log w from which a step speaks against its candidate: about twice the scale
TRANSITION_COST = 1.0  # -log w, at the beginning and at the end of a rejected stretch
REJECTED_TRUST = 1e-3  # not 0, so that a step at which all candidates are rejected still has a mean


def reject_stretches(problem: Problem, fit: Fit) -> tuple[Problem, Fit]:
    """The problem and fit without the stretches of steps in which a candidate stands out from ``fit``.

    They maximise Σ_t (-log w_t - `OUTLYING`) [t rejected] - `TRANSITION_COST` · (number of transitions), a Viterbi
    path for each candidate. Where ν → ∞, w = 1 and nothing is rejected.
    """
    evidence = -np.log(expected_precision(fit.distance, problem.dof)) - OUTLYING
    lengths = problem.data.lengths[:, None]
    steps = np.arange(lengths.max())
    padded = np.full((len(lengths), len(steps)), -np.inf)
    padded[steps < lengths] = evidence
    rejected = viterbi(padded, TRANSITION_COST)[steps < lengths]
    trusting = replace(problem, trust=np.where(rejected, REJECTED_TRUST, 1.0))
    return trusting, evaluate(trusting, fit.curve, fit.squared_scale, fit.profile)
