"""Viterbi path of two states."""

import numpy as np

from robust_instant_policy.geometry import FloatArray


def viterbi(score: FloatArray, transition_cost: float) -> np.ndarray:
    """States ``(..., T)``, true or false, that maximise Σ_t score_t [state_t] - cost · (number of transitions).

    ``score (..., T)`` is that of being true at each step; being false scores 0. Only the lead of the best path that
    ends true over the best that ends false is needed: lead_t = clip(lead_{t-1}, ±cost) + score_t.
    """
    steps = np.moveaxis(score, -1, 0)
    lead = np.empty_like(steps)
    lead[0] = steps[0]
    for t in range(1, len(steps)):
        lead[t] = np.minimum(np.maximum(lead[t - 1], -transition_cost), transition_cost) + steps[t]
    state = np.empty(steps.shape, dtype=bool)
    state[-1] = lead[-1] > 0
    for t in range(len(steps) - 2, -1, -1):
        state[t] = np.where(state[t + 1], lead[t] > -transition_cost, lead[t] > transition_cost)
    return np.moveaxis(state, 0, -1)
