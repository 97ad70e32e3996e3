"""The confidence of a plan: a calibrated probability that it is right.

    P(right) = min(1, agreement / GOOD_AGREEMENT) · sigmoid(b_0 + Σ_j b_j f_j),   f_j <= 0

The features f_j are made from `Evidence` and are 0 where nothing speaks against the plan; the coefficients were fitted
to plans for sound and for faulty scenes, all executed in simulated tasks (`benchmarks/confidence.py`, docs/trust.md). A
plan that breaks a check has confidence 0; where demonstrations cannot tell how well they predict a new scene it is at
most `UNKNOWN`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from robust_instant_policy.geometry import FloatArray

COEFFICIENTS = {"constant": 4.1, "keypoints": 0.93, "prediction": 0.53, "novelty": 0.85, "warnings": 0.66}
UNKNOWN = 0.5  # the most that is claimed where the demonstrations cannot tell

UNKNOWN_NOTE = (
    "unchecked: the demonstrations cannot tell how well they predict a new scene (fewer than three, or all of one "
    f"scene); the confidence is at most {UNKNOWN}"
)

RECOGNISED = 0.5  # confidence of keypoints from which on a scene counts as recognised; 0.7 to 0.8 is usual
GOOD_KEYPOINTS = 0.8  # above which more says nothing
GOOD_PREDICTION_M = 0.010  # below which demonstrations predict each other as well as keypoints are measured
GOOD_PRECISION_M = 0.010  # below which the gripper's place repeats as well as images are measured
GOOD_AGREEMENT = 0.4  # above which more says nothing: right plans of a small model have 0.4 to 0.9
LEAST = 1e-3  # of a ratio whose logarithm is taken
LEAST_SPREAD_M = 0.005  # demonstrations whose keypoints differ by less show one scene
NOISE_M = 0.02  # variation of a coordinate below which it says nothing about a scene
RIGID_M = 0.010  # variation of the distance of two keypoints below which they belong to one rigid thing
DISTANCE_M = 0.003  # with which a distance between keypoints is measured
MIN_SCENES = 3  # below which nothing is known of their variation


@dataclass(frozen=True)
class Evidence:
    """What speaks for or against a plan. NaN is unknown.

    ``agreement`` in [0, 1] of the candidates (`RobustTrajectory.confidence`); ``keypoints`` in [0, 1], the lower
    quartile of their confidence; ``distortion`` of the distances between them (see `distortion`); ``prediction`` in
    metres, the median over the demonstrations of the worst error with which the others predict one (`leave_one_out`);
    ``novelty``, how far the scene lies from the demonstrations (see `novelty`); ``displacement``, metres, of the plan
    against what lies around the gripper, and ``precision``, that of the demonstrations (`Surroundings`); ``warnings``
    and ``errors``, how many findings of the checks there are.
    """

    agreement: float
    keypoints: float
    distortion: float
    prediction: float
    novelty: float
    displacement: float
    precision: float
    warnings: int
    errors: int

    @property
    def is_known(self) -> bool:
        """Whether the demonstrations tell how well they predict a new scene."""
        return bool(np.isfinite(self.prediction) and np.isfinite(self.novelty))

    def features(self) -> Mapping[str, float]:
        """f_j by name; 0 for what is not known."""
        found = {
            "keypoints": GOOD_KEYPOINTS / max(self.keypoints, LEAST),
            "distortion": self.distortion,
            "prediction": self.prediction / GOOD_PREDICTION_M,
            "novelty": self.novelty,
            "displacement": self.displacement / max(2 * self.precision, GOOD_PRECISION_M),
            "precision": self.precision / GOOD_PRECISION_M,
        }
        return {
            **{name: -float(np.log(max(ratio, 1.0))) if np.isfinite(ratio) else 0.0 for name, ratio in found.items()},
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
    """How far a scene lies from the demonstrations: its squared Mahalanobis distance, over the largest among them.

    ``demonstrated (I, K, 3)`` and ``keypoints (K, 3)`` in metres. Distances are from the mean of the demonstrations, of
    a demonstration from the mean of the others; `NOISE_M` is added to each coordinate's variation. Above 1 a scene lies
    outside; NaN for fewer than `MIN_SCENES`, or where all show one scene.
    """
    count = len(demonstrated)
    if count < MIN_SCENES:
        return float("nan")
    apart = np.sqrt(((demonstrated[:, None] - demonstrated) ** 2).sum(axis=-1).mean(axis=-1))
    if np.median(apart[np.triu_indices(count, 1)]) < LEAST_SPREAD_M:
        return float("nan")
    rows = demonstrated.reshape(count, -1)
    others = [np.delete(rows, index, axis=0) for index in range(count)]
    largest = max(_squared_distance(own, row) for own, row in zip(others, rows, strict=True))
    return _squared_distance(rows, keypoints.ravel()) / largest


def _squared_distance(rows: FloatArray, row: FloatArray) -> float:
    """Squared Mahalanobis distance of ``row (D,)`` from ``rows (I, D)``, with `NOISE_M` in every coordinate."""
    x, new = rows - rows.mean(axis=0), row - rows.mean(axis=0)
    # (X'X/I + n²·1)⁻¹ by the I x I matrix of scalar products, which is the smaller one
    inner = x @ x.T / len(x) + NOISE_M**2 * np.eye(len(x))
    return float((new @ new - (x @ new) @ np.linalg.solve(inner, x @ new) / len(x)) / NOISE_M**2)


def distortion(demonstrated: FloatArray, keypoints: FloatArray) -> float:
    """How far distances between keypoints differ from the demonstrations', where these preserve them.

    The upper quartile of the differences from the median, over their variation, and over the demonstrations' own: above
    1 they differ by more than usual. ``demonstrated (I, K, 3)`` and ``keypoints (K, 3)`` in metres; NaN for fewer than
    `MIN_SCENES`, or where no distance is preserved.
    """
    if len(demonstrated) < MIN_SCENES:
        return float("nan")
    pairs = np.triu_indices(len(keypoints), 1)
    shown, new = (np.linalg.norm((p[..., :, None, :] - p[..., None, :, :]), axis=-1) for p in (demonstrated, keypoints))
    shown, new = shown[:, *pairs], new[pairs]

    def differences(distances: FloatArray, others: FloatArray) -> FloatArray:
        middle = np.median(others, axis=0)
        variation = 1.4826 * np.median(np.abs(others - middle), axis=0)
        off = np.abs(distances - middle) / np.maximum(variation, DISTANCE_M)
        return off[variation < RIGID_M]

    own = [differences(row, np.delete(shown, index, axis=0)) for index, row in enumerate(shown)]
    found = differences(new, shown)
    if not len(found):
        return float("nan")
    usual = np.median([np.quantile(off, 0.75) for off in own if len(off)])
    return float(np.quantile(found, 0.75) / max(float(usual), 1.0))


def recognition(keypoint_confidence: FloatArray) -> float:
    """How far a scene was recognised, in [0, 1], from its keypoints' ``(K,)`` confidence.

    The lower quartile counts: one keypoint may be hidden, but an object that is missing has several.
    """
    return float(min(1.0, np.quantile(keypoint_confidence, 0.25) / RECOGNISED))
