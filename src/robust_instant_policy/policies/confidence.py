"""The confidence of a plan, from everything that speaks for or against it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robust_instant_policy.geometry import FloatArray

RECOGNISED = 0.5  # confidence of keypoints from which on a scene counts as recognised; 0.7 to 0.8 is usual


@dataclass(frozen=True, eq=False)
class Evidence:
    """``agreement`` in [0, 1] is `RobustTrajectory.confidence`; ``keypoint_confidence (K,)`` in [0, 1] that of the
    keypoints that were located."""

    agreement: float
    keypoint_confidence: FloatArray


def plan_confidence(evidence: Evidence) -> float:
    """In [0, 1]: the candidates' agreement, less where the scene was hardly recognised.

    Candidates may well agree on what to do with an object that is not there.
    """
    return evidence.agreement * recognition(evidence.keypoint_confidence)


def recognition(keypoint_confidence: FloatArray) -> float:
    """How far a scene was recognised, in [0, 1], from its keypoints' ``(K,)`` confidence.

    The lower quartile counts: one keypoint may be hidden, but an object that is missing has several.
    """
    return float(min(1.0, np.quantile(keypoint_confidence, 0.25) / RECOGNISED))
