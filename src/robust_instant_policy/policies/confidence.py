"""The confidence of a plan: a calibrated probability that it is right.

    P(right) = min(1, agreement / GOOD_AGREEMENT) · sigmoid(b_0 + Σ_j b_j f_j),   f_j <= 0

The features f_j are made from `Evidence` and are 0 where nothing speaks against the plan; the coefficients were fitted
to plans for sound and for faulty scenes, all executed in simulated tasks (`benchmarks/confidence.py`, docs/trust.md). A
plan that breaks a check has confidence 0; where demonstrations cannot tell how well they predict a new scene it is at
most `UNKNOWN`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.sanity import Finding, errors

COEFFICIENTS = {"constant": 4.1, "keypoints": 0.93, "prediction": 0.53, "novelty": 0.85, "warnings": 0.66}
UNKNOWN = 0.5  # the most that is claimed where the demonstrations cannot tell

UNKNOWN_NOTE = (
    "unchecked: the demonstrations cannot tell how well they predict a new scene (fewer than three, or all of one "
    f"scene); the confidence is at most {UNKNOWN}"
)

RECOGNISED = 0.5  # confidence of keypoints from which on a scene counts as recognised; 0.7 to 0.8 is usual
GOOD_KEYPOINTS = 0.8  # above which more says nothing
GOOD_PREDICTION_M = 0.010  # below which demonstrations predict each other as well as keypoints are measured
GOOD_AGREEMENT = 0.4  # above which more says nothing: right plans of a small model have 0.4 to 0.9
LEAST = 1e-3  # of a ratio whose logarithm is taken
LEAST_SPREAD_M = 0.005  # demonstrations whose keypoints differ by less show one scene


@dataclass(frozen=True)
class Evidence:
    """What speaks for or against a plan.

    ``agreement`` in [0, 1] of the candidates (`RobustTrajectory.confidence`); ``keypoints`` in [0, 1], the lower
    quartile of their confidence; ``prediction`` in metres, the median over the demonstrations of the worst error with
    which the others predict one (`leave_one_out`); ``novelty``, how far the scene lies from the demonstrations (see
    `novelty`); ``warnings`` and ``errors``, how many findings of the checks there are. NaN is unknown.
    """

    agreement: float
    keypoints: float
    prediction: float
    novelty: float
    warnings: int
    errors: int

    @classmethod
    def of(
        cls,
        agreement: float,
        keypoint_confidence: FloatArray,
        prediction_errors: FloatArray,
        novelty: float,
        findings: Sequence[Finding],
    ) -> Evidence:
        """``keypoint_confidence (K,)``; ``prediction_errors (I, S)`` in metres, of S key steps."""
        return cls(
            agreement,
            float(np.quantile(keypoint_confidence, 0.25)),
            float(np.median(prediction_errors.max(axis=1))),
            novelty,
            sum(finding.severity == "warning" for finding in findings),
            len(errors(findings)),
        )

    @property
    def is_known(self) -> bool:
        """Whether the demonstrations tell how well they predict a new scene."""
        return bool(np.isfinite(self.prediction) and np.isfinite(self.novelty))

    def features(self) -> Mapping[str, float]:
        """f_j by name; 0 for what is not known."""
        known = self.is_known
        return {
            "keypoints": float(np.log(np.clip(self.keypoints / GOOD_KEYPOINTS, LEAST, 1.0))),
            "prediction": -float(np.log(max(self.prediction / GOOD_PREDICTION_M, 1.0))) if known else 0.0,
            "novelty": -float(np.log(max(self.novelty, 1.0))) if known else 0.0,
            "warnings": -float(self.warnings),
        }


def plan_confidence(evidence: Evidence) -> float:
    """Probability in [0, 1] that the plan is right; 0 where a check found an error."""
    if evidence.errors:
        return 0.0
    score = COEFFICIENTS["constant"] + sum(COEFFICIENTS[name] * value for name, value in evidence.features().items())
    probability = float(min(1.0, evidence.agreement / GOOD_AGREEMENT) / (1 + np.exp(-score)))
    return probability if evidence.is_known else min(probability, UNKNOWN)


def novelty(demonstrated: FloatArray, keypoints: FloatArray) -> float:
    """How far a scene lies from the demonstrations: distance to the nearest one, over their usual distance.

    ``demonstrated (I, K, 3)`` and ``keypoints (K, 3)`` in metres; distances are rms over keypoints. 1 is usual; NaN for
    one demonstration, or where all show one scene.
    """
    if len(demonstrated) < 2:
        return float("nan")
    apart = np.sqrt(((demonstrated[:, None] - demonstrated) ** 2).sum(axis=-1).mean(axis=-1))
    if np.median(apart[np.triu_indices(len(apart), 1)]) < LEAST_SPREAD_M:
        return float("nan")
    usual = float(np.median(np.where(np.eye(len(apart), dtype=bool), np.inf, apart).min(axis=1)))
    distance = float(np.sqrt(((demonstrated - keypoints) ** 2).sum(axis=-1).mean(axis=-1)).min())
    return distance / max(usual, LEAST_SPREAD_M)


def recognition(keypoint_confidence: FloatArray) -> float:
    """How far a scene was recognised, in [0, 1], from its keypoints' ``(K,)`` confidence.

    The lower quartile counts: one keypoint may be hidden, but an object that is missing has several.
    """
    return float(min(1.0, np.quantile(keypoint_confidence, 0.25) / RECOGNISED))
