"""When a gripper opens and closes, from what was recorded of it.

A plan says at which waypoint the state changes, so a recording must say it where the hand nearly stops: at that
waypoint the execution waits while the fingers travel. A commanded state changes earlier, a finger width passes any
threshold at another moment; the slowest moment of the hand while the fingers travel is the same in both.

    opening   ‾‾‾‾‾‾‾\\____________          fingers travel from a to b
    speed     ‾‾\\_______/‾‾‾‾‾‾‾            the hand is slowest at c, a <= c <= b
    state     0000000000 1111111            changes at c
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.geometry import FloatArray

MIN_TRAVEL = 0.15  # of the widest opening; fingers that move less do not open or close
ENDS = 0.05  # of the travel, at its two ends, that does not count as travelling


def state_of_opening(opening: FloatArray, points: FloatArray) -> NDArray[np.bool_]:
    """Gripper state ``(T,)``, True where closed, from finger ``opening (T,)`` and gripper ``points (T, 3)``, metres.

    Each change is where the hand is slowest while the fingers travel.
    """
    widest, travel = float(opening.max()), float(np.ptp(opening))
    if travel < MIN_TRAVEL * widest:
        return np.zeros(len(opening), dtype=bool)
    closing = opening < widest - travel / 2
    speed = np.linalg.norm(np.diff(points, axis=0, append=points[-1:]), axis=1)
    state = np.full(len(opening), closing[0])
    for crossing in np.flatnonzero(closing[1:] != closing[:-1]) + 1:
        first, last = _travelling(opening, int(crossing), ENDS * travel)
        change = first + int(speed[first : last + 1].argmin())
        state[change:] = closing[crossing]
    return state


def _travelling(opening: FloatArray, crossing: int, ends: float) -> tuple[int, int]:
    """First and last step of the travel that passes ``crossing``, without its first and last ``ends`` metres."""
    sign = 1.0 if opening[crossing] < opening[crossing - 1] else -1.0
    falling = sign * opening  # decreases while the fingers travel
    first, last = crossing - 1, crossing
    while first > 0 and falling[first - 1] > falling[first]:
        first -= 1
    while last + 1 < len(opening) and falling[last + 1] < falling[last]:
        last += 1
    inner = (falling[first : last + 1] <= falling[first] - ends) & (falling[first : last + 1] >= falling[last] + ends)
    steps = first + np.flatnonzero(inner)
    return (int(steps[0]), int(steps[-1])) if len(steps) else (crossing, crossing)
