"""Two states that persist: the best sequence of yes and no when every change has a price."""

from __future__ import annotations

import numpy as np

from robust_instant_policy.geometry import FloatArray


def persistent(gain: FloatArray, cost: float) -> np.ndarray:
    """States ``(..., T)``, true or false, that earn the most ``gain (..., T)`` of being true, less ``cost`` a change.

    This is the Viterbi path of two states: only the difference of their best scores matters, and it never leaves
    ±``cost`` before a step's own gain is added. ``cost`` may be ``(...)``.
    """
    steps = np.moveaxis(gain, -1, 0)
    lead = np.empty_like(steps)
    lead[0] = steps[0]
    for t in range(1, len(steps)):
        lead[t] = np.minimum(np.maximum(lead[t - 1], -cost), cost) + steps[t]
    state = np.empty(steps.shape, dtype=bool)
    state[-1] = lead[-1] > 0
    for t in range(len(steps) - 2, -1, -1):
        state[t] = np.where(state[t + 1], lead[t] > -cost, lead[t] > cost)
    return np.moveaxis(state, 0, -1)
