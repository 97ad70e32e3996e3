"""Which candidate is hallucinated, from which step on and in which dimensions.

The paper leaves recognising hallucinations to future work (Oh et al. 2025, Sec. VI). Here it is Page's cumulative sum
(1954): with e_t the squared residual of a candidate at step t, in scales, less what noise shows,

    S_t = max(0, S_{t-1} + e_t)

A wrong digit and a slow drift both drive it up, noise does not, and the step at which it last left zero is the onset.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression.candidates import Candidates

CLEAN_SQUARE = 3.0  # mean squared residual, in scales, that noise does not exceed for long
SINGLE_SHARE = 1 / 8  # of a single number's squared residual that counts like the mean of all: a wrong digit is one
FLAG_SCORE = 15.0  # cumulative sum from which a candidate counts as hallucinated
DIMENSION_SHARE = 0.2  # of the worst dimension's squared residual: dimensions above it are named with it
VARIATION_SHARE = 0.5  # least scale, in standard deviations of the demonstrations (docs/tables/naming.md)
TIMING_TOLERANCE = 0.5  # steps


class Fit(Protocol):
    """What is needed of a fitted regression."""

    def mean(self, times: ArrayLike | None = None) -> FloatArray: ...

    def scale(self, times: ArrayLike | None = None) -> FloatArray: ...


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Verdict on each of Q candidates.

    ``scores (Q,)`` grow with the evidence against a candidate; ``hallucinated (Q,)`` are those above `FLAG_SCORE`;
    ``onset (Q,)`` is the candidate's own step from which it is hallucinated, -1 if it is not; ``dimensions`` are, for
    each candidate, those in which it stands out.
    """

    scores: FloatArray
    hallucinated: np.ndarray
    onset: np.ndarray
    dimensions: tuple[tuple[int, ...], ...]


def diagnose(fit: Fit, candidates: Sequence[ArrayLike], times: Sequence[ArrayLike] | None = None) -> Diagnosis:
    """Verdict on ``candidates``, each ``(T_q, D)``, of which ``fit`` is the robust trajectory."""
    data = Candidates.from_arrays(candidates, times)
    if data.num_dimensions != fit.mean(data.times[:1]).shape[1]:
        raise InvalidValueError(f"candidates have {data.num_dimensions} dimensions, but the fit has others")
    return judge(data.split(scaled_residuals(fit, data)))


def scaled_residuals(fit: Fit, data: Candidates, variation: FloatArray | None = None) -> FloatArray:
    """Candidates less the robust trajectory ``(N, D)``, over the scale, within `TIMING_TOLERANCE`.

    ``variation (V,)``, evenly spread over [0, 1], is the standard deviation of demonstrations, where it is known:
    where they differ, candidates may differ as well.
    """
    scale = fit.scale(data.times)
    if variation is not None:
        usual = np.interp(data.times, np.linspace(0.0, 1.0, len(variation)), variation)
        scale = np.hypot(scale, VARIATION_SHARE * usual[:, None])
    shift = TIMING_TOLERANCE / max(float(np.median(data.lengths)) - 1, 1)
    choices = np.stack(
        [(data.values - fit.mean(np.clip(data.times + offset, 0, 1))) / scale for offset in (0.0, -shift, shift)]
    )
    best = (choices**2).sum(axis=2).argmin(axis=0)
    return choices[best, np.arange(len(best))]


def judge(residuals: Sequence[FloatArray]) -> Diagnosis:
    """Verdict from ``residuals``, each ``(T_q, D)``: candidate less robust trajectory, over the scale."""
    count = len(residuals)
    scores, onset = np.zeros(count), np.full(count, -1)
    dimensions: list[tuple[int, ...]] = [()] * count
    for q, residual in enumerate(residuals):
        squares = residual**2
        evidence = np.maximum(squares.mean(axis=1), SINGLE_SHARE * squares.max(axis=1)) - CLEAN_SQUARE
        total = np.concatenate([[0.0], np.cumsum(evidence)])
        climb = total - np.minimum.accumulate(total)
        scores[q] = climb.max()
        if scores[q] > FLAG_SCORE:
            alarm = int(np.argmax(climb > FLAG_SCORE))
            onset[q] = np.argmin(total[:alarm])
            worst = squares[onset[q] : int(np.argmax(climb))].mean(axis=0)
            dimensions[q] = tuple(int(d) for d in np.flatnonzero(worst > DIMENSION_SHARE * worst.max()))
    return Diagnosis(scores, onset >= 0, onset, tuple(dimensions))
