"""When a gripper opens and closes, from what was recorded of it.

A plan says at which waypoint the state changes, so a recording must say it where the hand nearly stops: at that
waypoint the execution waits while the fingers travel. A commanded state changes earlier, a finger width passes any
threshold at another moment; the slowest moment of the hand while the fingers travel is the same in both.

    opening   ‾‾‾‾‾‾‾\\____________          fingers travel from a to b
    speed     ‾‾\\_______/‾‾‾‾‾‾‾            the hand is slowest at c, a <= c <= b
    state     0000000000 1111111            changes at c
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.geometry import FloatArray

MIN_TRAVEL = 0.15  # of the widest opening; fingers that move less do not open or close
ENDS = 0.05  # of the travel, at its two ends, that does not count as travelling
SLOW = 0.1  # of the usual speed, the `USUAL_PERCENTILE`, below which a hand waits
USUAL_PERCENTILE = 75
MIN_DWELL_S = 0.15  # shorter waits do not show how long the fingers travel
UNKNOWN_DWELL_S = 0.45  # enough for the parallel grippers of the simulated tasks


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


@dataclass(frozen=True)
class Pace:
    """How long demonstrations took: ``seconds`` of an episode, and ``dwell``, the seconds to wait where a gripper opens
    or closes. ``state`` says what their gripper state is: "commanded" where the hand waits after a change, for the
    fingers to travel, "measured" where it waits before, "unknown" where it does not wait; then ``dwell`` is
    `UNKNOWN_DWELL_S`.
    """

    seconds: float
    dwell: float
    state: str

    @classmethod
    def of(cls, demonstrations: Sequence[Demonstration]) -> Pace:
        """The medians over ``demonstrations``."""
        waits = [wait for demonstration in demonstrations for wait in _waits(demonstration)]
        seconds = float(np.median([demonstration.seconds for demonstration in demonstrations]))
        before, after = np.median(waits, axis=0) if waits else (0.0, 0.0)
        if before + after < MIN_DWELL_S:
            return cls(seconds, UNKNOWN_DWELL_S, "unknown")
        return cls(seconds, float(before + after), "measured" if before > after else "commanded")


def _waits(demonstration: Demonstration) -> list[tuple[float, float]]:
    """Seconds before and after each change of a gripper's state in which its fingertips hardly move."""
    trajectory = demonstration.trajectory
    found: list[tuple[float, float]] = []
    if len(trajectory) < 2:
        return found
    for arm in range(trajectory.num_arms):
        points = trajectory.triplets[:, arm, 1:].mean(axis=1)
        speed = np.linalg.norm(np.diff(points, axis=0), axis=1)
        slow = speed < SLOW * np.percentile(speed, USUAL_PERCENTILE)
        closed = trajectory.gripper_state[:, arm] > 0.5
        for change in np.flatnonzero(closed[1:] != closed[:-1]):  # between this step and the next
            moving = np.flatnonzero(~slow)
            earlier, later = moving[moving < change], moving[moving > change]
            start = earlier[-1] + 1 if len(earlier) else 0
            end = later[0] if len(later) else len(slow)
            found.append(((change - start) / demonstration.rate_hz, (end - change) / demonstration.rate_hz))
    return found
