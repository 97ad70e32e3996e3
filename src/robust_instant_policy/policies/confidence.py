"""The confidence of a plan: a calibrated probability that it is right.

    P(right) = min(1, agreement / GOOD_AGREEMENT) · min(1, recognition / GOOD_RECOGNITION) · (1 + vote) / 2 · 2^-doubled
               · `CARRIED`^carried · sigmoid(b_0 + Σ_j b_j f_j)

The features f_j are made from `Evidence`, f_j <= 0, and are 0 where nothing speaks against the plan; the coefficients
were fitted to plans for sound and for faulty scenes, all executed in simulated tasks (`benchmarks/confidence.py`,
docs/trust.md). A plan that breaks a check has confidence 0; where demonstrations cannot tell how well they predict a
new scene, it is multiplied by `UNKNOWN`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.special import expit

from robust_instant_policy.geometry import FloatArray, robust_std
from robust_instant_policy.sanity import Finding

COEFFICIENTS = {
    "constant": 2.84, "distortion": 1.82, "frames": 1.59, "novelty": 0.99, "displacement": 1.14, "doubts": 2.59,
}  # fmt: skip
CARRIED = 0.75  # factor for a plan beyond what was demonstrated: keeps it below a gate of 0.9, though most are right
UNKNOWN = 0.5  # factor, and so the most that is claimed, where the demonstrations cannot tell
UNKNOWN_NOTE = (
    "unchecked: the demonstrations cannot tell how well they predict a new scene (fewer than three, or all of one "
    f"scene); the confidence is at most {UNKNOWN}"
)
WORDS = {
    "distortion": "the keypoints of a thing lie {distortion:.1f} times farther from its demonstrated shape than usual",
    "frames": "where it matters most the demonstrations predict each other to {frames_mm:.0f} mm",
    "novelty": "the squared distance of the keypoints from the demonstrations is {novelty:.1f} times their largest",
    "displacement": "around the planned gripper the image shows what lies {displacement_mm:.0f} mm beside it in the "
    "demonstrations (theirs differ by {precision_mm:.0f} mm)",
    "doubts": "gripper states, grasps or rotations seem to be recorded wrongly",
    "agreement": "the candidates agree to within 15 mm with a probability of {agreement:.2f} only",
    "recognition": "the keypoints have {recognition:.2f} of the confidence that counts as recognised",
}
"""What each feature says, and the agreement and the recognition."""

RECOGNISED = 0.7  # of the least confidence in demonstrations, from which on a scene counts as recognised
GOOD_AGREEMENT = 0.4  # above which more says nothing: right plans of a small model have 0.4 to 0.9
GOOD_RECOGNITION = 0.8  # sound scenes have 1; a thing of other colours and size, taken for the one that is meant, 0.4
# Up to these values evidence says nothing: sound scenes have them.
GOOD_DISTORTION = 2.0
GOOD_FRAMES_M, GOOD_PREDICTION_M = 0.010, 0.015
GOOD_DISPLACEMENT_M, GOOD_DISPLACEMENT = 0.015, 1.5  # or that many times the demonstrations' own
LEAST_SPREAD_M = 0.005  # demonstrations whose keypoints differ by less show one scene
NOISE_M = 0.02  # variation of a coordinate below which it says nothing about a scene
RIGID_M = 0.010  # variation of the distance of two keypoints below which they belong to one rigid thing
DISTANCE_M = 0.003  # with which a distance between keypoints is measured
RECORDING = {"gripper state", "grasp", "rotation"}  # kinds of findings that doubt the recording
MIN_SCENES = 3  # below which nothing is known of their variation


@dataclass(frozen=True)
class Evidence:
    """What speaks for or against a plan. NaN is unknown.

    ``agreement`` in [0, 1] of the candidates (`RobustTrajectory.confidence`); ``vote`` in [0, 1] for the way to act
    that was followed, 0 where either of two may be meant (`Prompt.decide`); how many objects with keypoints are
    ``doubled``: of two alike, it is not known which is meant; whether (1, else 0) the plan is ``carried`` beyond what
    was demonstrated: the demonstrations, carried over into the scene, are so, too; ``recognition`` in [0, 1] of the
    scene (see `recognition`); ``distortion`` of the distances between keypoints (see `distortion`); ``frames``, metres,
    the error with which frames that are fitted to the other demonstrations predict one at the gripper change at which
    they do so worst (`StepFrames.error`), and ``prediction``, that of the demonstrations at the key step at which they
    predict each other best, which stands in for it without gripper changes; ``novelty``, how far the scene lies from
    the demonstrations (see `novelty`); ``displacement``, metres, of the plan against what lies around the gripper, and
    ``precision``, that of the demonstrations (`Surroundings`); how many findings are ``doubts`` about the recording
    (`doubts`), and ``errors``.
    """

    agreement: float
    vote: float
    doubled: int
    carried: int
    recognition: float
    distortion: float
    frames: float
    prediction: float
    novelty: float
    displacement: float
    precision: float
    doubts: int
    errors: int

    @property
    def is_known(self) -> bool:
        """Whether demonstrations tell how well they predict a new scene."""
        return bool(np.isfinite(self.prediction) and np.isfinite(self.novelty))

    @property
    def notes(self) -> tuple[str, ...]:
        """What lowers the confidence, for the user."""
        values = {
            **vars(self),
            "frames_mm": 1e3 * (self.prediction if np.isnan(self.frames) else self.frames),
            "displacement_mm": 1e3 * self.displacement,
            "precision_mm": 1e3 * self.precision,
        }
        lowering = [name for name, value in self.features().items() if value < 0]
        lowering += ["agreement"] if self.agreement < GOOD_AGREEMENT else []
        lowering += ["recognition"] if self.recognition < GOOD_RECOGNITION else []
        told = "; ".join(WORDS[name].format(**values) for name in lowering)
        lowered = (f"warning: the confidence is lowered: {told}",) if told else ()
        return (*lowered, *(() if self.is_known else (UNKNOWN_NOTE,)))

    def features(self) -> Mapping[str, float]:
        """f_j by name; 0 for what is not known."""
        usual = max(GOOD_DISPLACEMENT_M, GOOD_DISPLACEMENT * float(np.nan_to_num(self.precision)))
        ratios = {
            "distortion": self.distortion / GOOD_DISTORTION,
            "frames": self.prediction / GOOD_PREDICTION_M if np.isnan(self.frames) else self.frames / GOOD_FRAMES_M,
            "novelty": self.novelty,
            "displacement": self.displacement / usual,
        }
        return {name: -float(np.log(np.fmax(ratio, 1.0))) for name, ratio in ratios.items()} | {
            "doubts": -float(self.doubts)
        }


def plan_confidence(evidence: Evidence, coefficients: Mapping[str, float] = COEFFICIENTS) -> float:
    """Probability in [0, 1] that the plan is right; 0 where a check found an error."""
    if evidence.errors:
        return 0.0
    score = coefficients["constant"] + sum(coefficients[name] * value for name, value in evidence.features().items())
    agreement, vote = np.nan_to_num(evidence.agreement), np.nan_to_num(evidence.vote, nan=1.0)
    likely = min(1.0, agreement / GOOD_AGREEMENT) * (1 + vote) / 2 * 0.5 ** np.nan_to_num(evidence.doubled)
    likely *= CARRIED ** np.nan_to_num(evidence.carried)
    likely *= min(1.0, np.nan_to_num(evidence.recognition, nan=1.0) / GOOD_RECOGNITION)
    return float(likely * expit(score) * (1.0 if evidence.is_known else UNKNOWN))


def doubts(findings: Sequence[Finding]) -> int:
    """How many ``findings`` are warnings that gripper states, grasps or rotations were recorded wrongly."""
    return sum(f.severity == "warning" and f.kind in RECORDING and bool(f.cause) for f in findings)


def prediction(errors: FloatArray) -> float:
    """Metres, from the errors ``(I, S)`` of `leave_one_out`: the median over the demonstrations at the best key step.

    It tells how precise demonstrators are where the gripper meets a thing; elsewhere they vary more, within limits. The
    first and the last step count only where there are no others.
    """
    return float(np.median(errors[:, 1:-1] if errors.shape[1] > 2 else errors, axis=0).min())


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
    """How far distances between keypoints of one thing differ from the demonstrations', of the worst thing.

    A thing is what preserved distances join (`RIGID_M`), and for each keypoint that to which it varies least. For each
    thing: the upper quartile of the differences from the median of these distances, over their variation, and over the
    demonstrations' own quartile; above 1 they differ by more than usual. ``demonstrated (I, K, 3)`` and ``keypoints (K,
    3)`` in metres; NaN for fewer than `MIN_SCENES`, or for a single keypoint.
    """
    count = len(keypoints)
    if len(demonstrated) < MIN_SCENES or count < 2:
        return float("nan")
    pairs = np.triu_indices(count, 1)
    shown, new = (np.linalg.norm((p[..., :, None, :] - p[..., None, :, :]), axis=-1) for p in (demonstrated, keypoints))
    variation = robust_std(shown) + np.diag(np.full(count, np.inf))
    joined = variation < RIGID_M
    joined[np.arange(count), variation.argmin(axis=1)] = True
    _, thing = connected_components(coo_array(joined), directed=False)
    compared = (joined | joined.T)[pairs]
    shown, new, of_thing = shown[:, *pairs][:, compared], new[pairs][compared], thing[pairs[0]][compared]

    def quartiles(distances: FloatArray, others: FloatArray) -> FloatArray:
        off = np.abs(distances - np.median(others, axis=0)) / np.maximum(robust_std(others), DISTANCE_M)
        return np.array([np.quantile(off[of_thing == one], 0.75) for one in range(thing.max() + 1)])

    usual = np.median([quartiles(row, np.delete(shown, index, axis=0)) for index, row in enumerate(shown)], axis=0)
    return float((quartiles(new, shown) / np.maximum(usual, 1.0)).max())


def recognition(demonstrated: FloatArray, keypoint_confidence: FloatArray, object_of: NDArray[np.intp]) -> float:
    """How far a scene was recognised, in [0, 1], from the confidence ``(K,)`` of its keypoints, and the number of the
    object of each, ``object_of (K,)``.

    Each is compared with the least that it has in the demonstrations, ``demonstrated (I, K)``, of which the first is
    the reference that the others are recognised by; with fewer than two there is nothing to compare, and it is 1. The
    lower quartile counts, of all keypoints and of those of each object that has several; the least of these decides.
    One keypoint may be hidden, but not an object.
    """
    if len(demonstrated) < 2:
        return 1.0
    least = RECOGNISED * demonstrated[1:].min(axis=0)
    ratio = np.divide(keypoint_confidence, least, out=np.ones_like(keypoint_confidence), where=least > 0)
    numbers, counts = np.unique(object_of, return_counts=True)
    parts = [ratio, *(ratio[object_of == number] for number in numbers[counts > 1])]
    return float(np.clip(min(np.quantile(np.nan_to_num(part), 0.25, method="higher") for part in parts), 0.0, 1.0))
