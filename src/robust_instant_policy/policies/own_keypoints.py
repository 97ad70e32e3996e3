"""Keypoints of one's own: from a tracker, fiducial markers or a pose estimator."""

import reprlib
from collections.abc import Callable, Sequence
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import InvalidValueError, KeypointError, RipError, UsageError
from robust_instant_policy.geometry import FloatArray, as_numbers, project
from robust_instant_policy.perception import Located
from robust_instant_policy.plugins import load_class

Points = ArrayLike | tuple[ArrayLike, ArrayLike]  # keypoints, or keypoints and their confidence


@runtime_checkable
class KeypointSource(Protocol):
    """K points in metres, world frame, in a fixed order: point k is the same material point in every scene.

    `locate` returns ``(K, 3)``, or that and a confidence ``(K,)`` in [0, 1]. A point that is not seen is NaN; its
    scene cannot be planned for. A source that must first choose its points or learn from all demonstrations together
    also has ``fit(demonstrations) -> (N, K, 3)``, or that and a confidence ``(N, K)``; otherwise `locate` is called
    for the observation of each demonstration.
    """

    def locate(self, observation: Observation) -> Points: ...


class OwnKeypoints:
    """A `KeypointSource` in the place of `perception.KeypointExtractor`, with the same results of `fit` and `locate`.

    Raises `UsageError` for a source without `locate`; whatever the source itself raises is a `KeypointError`.
    """

    def __init__(self, source: str | KeypointSource):
        self.source: KeypointSource = load_class("keypoints", source)() if isinstance(source, str) else source
        self.name = source if isinstance(source, str) else type(source).__name__
        if not isinstance(self.source, KeypointSource):
            raise UsageError(f"the keypoints {self.name} have no locate(observation) (docs/own-tasks.md#keypoints)")

    def fit(self, demonstrations: Sequence[Demonstration]) -> Self:
        """Find the keypoints of ``demonstrations``. Raises `InvalidValueError` for results of another shape and
        `KeypointError` where one is missing."""
        scenes = [one.observation for one in demonstrations]
        if callable(fit := getattr(self.source, "fit", None)):
            keypoints, confidence = _separated(self._asked(fit, demonstrations), 3)
        else:
            found = [_separated(self._asked(self.source.locate, scene), 2) for scene in scenes]
            if len({points.shape for points, _ in found}) > 1:
                raise InvalidValueError(
                    f"the keypoints {self.name} give another number of points in each demonstration"
                )
            keypoints, confidence = (np.stack(parts) for parts in zip(*found, strict=True))
        if len(keypoints) != len(scenes):
            raise InvalidValueError(f"fit returned the keypoints of {len(keypoints)} of {len(scenes)} demonstrations")
        self.keypoints_, self.confidence_ = keypoints, confidence
        for index, points in enumerate(self.keypoints_):
            self._require_all(points, f"demonstration {index}")
        self.pixels_ = np.stack([_pixels(points, scene) for points, scene in zip(keypoints, scenes, strict=True)])
        self.left_out_: NDArray[np.bool_] = np.zeros(len(scenes), dtype=bool)
        self.object_of_: NDArray[np.intp] = np.full(keypoints.shape[1], -1)  # not told
        self.notes_ = (f"keypoints: {self.name}, {self.keypoints_.shape[1]} points",)
        return self

    def locate(self, observation: Observation) -> Located:
        """See `KeypointExtractor.locate`."""
        keypoints, confidence = _separated(self._asked(self.source.locate, observation), 2)
        if len(keypoints) != self.keypoints_.shape[1]:
            raise InvalidValueError(f"locate returned {len(keypoints)} keypoints, fit {self.keypoints_.shape[1]}")
        self._require_all(keypoints, "the scene")
        return Located(keypoints, _pixels(keypoints, observation), confidence)

    def _asked(self, call: Callable[..., Points], given: object) -> Points:
        try:
            return call(given)
        except RipError:
            raise
        except Exception as error:  # of the user's code, or of the camera behind it
            raise KeypointError(f"the keypoints {self.name} raise {type(error).__name__}: {error}") from error

    def _require_all(self, keypoints: FloatArray, where: str) -> None:
        if not len(keypoints):
            raise KeypointError(f"the keypoints {self.name} give no point in {where}")
        missing = np.flatnonzero(~np.isfinite(keypoints).all(axis=1))
        if len(missing):
            raise KeypointError(f"the keypoints {self.name} do not find {missing.tolist()} in {where}")


def _separated(found: Points, ndim: int) -> tuple[FloatArray, FloatArray]:
    """Keypoints ``(..., K, 3)`` and their confidence ``(..., K)``, 1 where none was given."""
    given, confidence = found if isinstance(found, tuple) and len(found) == 2 else (found, None)
    keypoints = as_numbers("keypoints", given)
    if keypoints.ndim != ndim or keypoints.shape[-1] != 3:
        raise InvalidValueError(f"keypoints must be {'(N, K, 3)' if ndim == 3 else '(K, 3)'}, got {keypoints.shape}")
    if confidence is None:
        return keypoints, np.ones(keypoints.shape[:-1])
    chance = as_numbers("confidence", confidence)
    if chance.shape != keypoints.shape[:-1]:
        raise InvalidValueError(f"the confidence of keypoints must be {keypoints.shape[:-1]}, got {chance.shape}")
    if not ((chance >= 0) & (chance <= 1)).all():
        raise InvalidValueError(f"the confidence of keypoints must lie in [0, 1], got {reprlib.repr(chance.tolist())}")
    return keypoints, chance


def _pixels(keypoints: FloatArray, observation: Observation) -> FloatArray:
    return project(keypoints, observation.intrinsics, observation.camera_pose)
