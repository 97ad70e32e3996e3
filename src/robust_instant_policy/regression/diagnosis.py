"""Which candidate is hallucinated, from which step on and in which dimensions; and how sure the robust trajectory is.

The paper leaves recognising hallucinations to future work (Oh et al. 2025, Sec. VI). Here the squared residuals of a
candidate, in scales of what trustworthy candidates show, are summed along it and the sum starts again whenever it
would fall below zero (the cumulative sum of Page 1954). A wrong digit and a slow drift both drive it up, noise does
not, and the step at which it last left zero is where the hallucination began.

Where demonstrations differ from each other, as they do on a free way, candidates may differ as well: a scale is never
taken for less than half of what demonstrations vary.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import fdtr

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression.alignment import Candidates

CLEAN_SQUARE = 3.0  # mean squared residual, in scales, that noise does not exceed for long
SINGLE_SHARE = 1 / 8  # of a single number's squared residual that counts like the mean of all: a wrong digit is one
FLAG_SCORE = 15.0  # excess over CLEAN_SQUARE, summed along a stretch, from which a candidate counts as hallucinated
DIMENSION_SHARE = 0.2  # of the worst dimension's squared residual: dimensions above it are named with it
VARIATION_SHARE = 0.5  # of what demonstrations vary: a candidate knows the scene (docs/tables/naming.md)
TIMING_SLACK = 0.5  # steps early or late that are nobody's hallucination
MAJORITY = 0.5  # share of the candidates that must agree before their agreement counts in full
FREEDOM_PER_CANDIDATE = (
    4.0  # degrees of freedom of errors pooled over steps and dimensions; set so that intervals cover
)
MIN_FREEDOM = 0.25  # candidates beyond the first, at least, that an error is estimated from
COORDINATES = 3.0  # a point is off in three directions at once


class Fit(Protocol):
    """What is needed of a fitted regression."""

    def mean(self, times: ArrayLike | None = None) -> FloatArray: ...

    def scale(self, times: ArrayLike | None = None) -> FloatArray: ...

    def standard_error(self, times: ArrayLike | None = None) -> FloatArray: ...


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
    return judge(scaled_residuals(fit, Candidates.from_arrays(candidates, times)))


def scaled_residuals(fit: Fit, data: Candidates, variation: FloatArray | None = None) -> list[FloatArray]:
    """Candidates less the robust trajectory ``(T_q, D)``, over the scale, each step compared at its best timing.

    ``variation (B,)``, evenly spread over [0, 1], is the standard deviation of demonstrations, where it is known.
    """
    scale = fit.scale(data.times)
    if variation is not None:
        habit = np.interp(data.times, np.linspace(0.0, 1.0, len(variation)), variation)
        scale = np.hypot(scale, VARIATION_SHARE * habit[:, None])
    slack = TIMING_SLACK / max(float(np.median(data.lengths)) - 1, 1)
    choices = np.stack(
        [(data.values - fit.mean(np.clip(data.times + shift, 0, 1))) / scale for shift in (0.0, -slack, slack)]
    )
    best = (choices**2).sum(axis=2).argmin(axis=0)
    return data.split(choices[best, np.arange(len(best))])


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


def confidence(standard_error: FloatArray, weights: FloatArray, tolerance: float) -> float:
    """Probability, at the least sure step, that a point of the trajectory lies within ``tolerance`` of the truth.

    ``standard_error (T, D)`` is that of coordinates, in the unit of ``tolerance``; ``weights (Q, T)`` are those of the
    candidates. Where less than half of them agree the probability shrinks: it may be the wrong ones that agree.
    """
    if np.isinf(standard_error).any():
        return 0.0
    worst = np.maximum(standard_error.max(axis=1), np.finfo(float).eps * tolerance)
    freedom = error_freedom(effective_count(weights))
    within = fdtr(COORDINATES, freedom, (tolerance / worst) ** 2 / COORDINATES)
    return float((within * np.minimum(1.0, weights.mean(axis=0) / MAJORITY)).min())


def effective_count(weights: FloatArray) -> FloatArray:
    """How many candidates decide ``(T,)``, from their ``weights (Q, T)``."""
    return weights.sum(axis=0) ** 2 / np.maximum((weights**2).sum(axis=0), np.finfo(float).tiny)


def small_sample_factor(deciding: FloatArray) -> FloatArray:
    """n / (n - 1): what squared residuals about a mean of n = ``deciding (T,)`` candidates lack of squared errors."""
    return deciding / np.maximum(deciding - 1, MIN_FREEDOM)


def error_freedom(deciding: FloatArray) -> FloatArray:
    """Degrees of freedom of an error that was estimated from ``deciding (T,)`` candidates."""
    return FREEDOM_PER_CANDIDATE * np.maximum(deciding - 1, MIN_FREEDOM)
