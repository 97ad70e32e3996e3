"""Which candidate is hallucinated, from which step on and in which dimensions; and how sure the result is.

The paper leaves "explicitly recogniz[ing] hallucinations" to future work. Here each candidate's squared residuals,
in units of the scale that the trustworthy candidates show, are summed over the stretch where they stand out most
(the cumulative sum of Page 1954). One wrong digit and a slow drift both reach a large sum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robust_instant_policy.geometry import FloatArray

CLEAN_SQUARE = 6.0  # mean squared residual, in scales, that a trustworthy candidate may show at a step
FLAG_SCORE = 12.0  # excess over CLEAN_SQUARE, summed over a stretch, from which a candidate counts as hallucinated
DIMENSION_SHARE = 0.2  # of the largest squared residual of the stretch: dimensions above it are named


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Verdict on each of Q candidates.

    ``scores (Q,)`` grow with the evidence; ``hallucinated (Q,)`` are those above the threshold; ``onset (Q,)`` is the
    candidate's own step where its hallucinated stretch begins (-1 if none); ``dimensions`` are those it stands out in.
    """

    scores: FloatArray
    hallucinated: np.ndarray
    onset: np.ndarray
    dimensions: tuple[tuple[int, ...], ...]


def diagnose(residuals: list[FloatArray]) -> Diagnosis:
    """Verdict from ``residuals``, each ``(T_q, D)``: candidate minus robust mean, over the scale."""
    scores, onsets, dimensions = [], [], []
    for residual in residuals:
        squares = residual**2
        excess = np.concatenate([[0.0], np.cumsum(squares.mean(axis=1) - CLEAN_SQUARE)])
        rises = excess - np.minimum.accumulate(excess)
        end = int(np.argmax(rises))
        start = int(np.argmin(excess[: end + 1]))
        scores.append(rises[end])
        onsets.append(start)
        stretch = squares[start : max(end, start + 1)].mean(axis=0)
        dimensions.append(tuple(int(d) for d in np.flatnonzero(stretch > DIMENSION_SHARE * stretch.max())))
    score = np.array(scores)
    flagged = score > FLAG_SCORE
    return Diagnosis(
        score,
        flagged,
        np.where(flagged, onsets, -1),
        tuple(d if flag else () for d, flag in zip(dimensions, flagged, strict=True)),
    )
