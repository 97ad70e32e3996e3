"""Statistics for `lerobot`'s normalisation, for each feature of an episode and of a folder.

Conventions of ``src/lerobot/datasets/compute_stats.py`` of 0.4.4: images are scaled to [0, 1], channel first, and
sampled in frames and pixels; quantiles of a folder are those of its episodes, averaged with their number of frames.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robust_instant_policy.geometry import FloatArray

Statistics = Mapping[str, FloatArray]

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
MAX_FRAMES = 100  # of an episode, for image statistics
MAX_SIDE_PX = 150  # larger images are subsampled at every second, third, … pixel


def feature_statistics(values: ArrayLike) -> dict[str, FloatArray]:
    """Statistics over the first axis of ``values (T, D)``: each ``(D,)``, and ``count (1,)``."""
    values = np.asarray(values, dtype=np.float64)
    return {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0),
        "std": values.std(axis=0),
        "count": np.array([len(values)], dtype=np.float64),
        **{name: np.quantile(values, share, axis=0) for name, share in QUANTILES.items()},
    }


def image_statistics(images: NDArray[np.uint8]) -> dict[str, FloatArray]:
    """Statistics of each channel of ``images (T, H, W, 3)``: ``(3, 1, 1)`` in [0, 1], and ``count (1,)`` of frames."""
    frames = np.unique(np.linspace(0, len(images) - 1, MAX_FRAMES).astype(np.intp))
    stride = -(-max(images.shape[1:3]) // MAX_SIDE_PX)
    pixels = images[frames, ::stride, ::stride].reshape(-1, 3) / 255.0
    result = {name: value.reshape(3, 1, 1) for name, value in feature_statistics(pixels).items() if name != "count"}
    return {**result, "count": np.array([len(frames)], dtype=np.float64)}


def combine(parts: Sequence[Statistics]) -> dict[str, FloatArray]:
    """Statistics of all frames of ``parts``."""
    stacked = {name: np.stack([part[name] for part in parts]) for name in parts[0]}
    count = stacked.pop("count")
    share = count / count.sum()
    share = share.reshape(len(parts), *[1] * (stacked["mean"].ndim - 1))
    mean = (share * stacked["mean"]).sum(axis=0)
    variance = (share * (stacked["std"] ** 2 + (stacked["mean"] - mean) ** 2)).sum(axis=0)
    return {
        "min": stacked["min"].min(axis=0),
        "max": stacked["max"].max(axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": count.sum(axis=0),
        **{name: (share * stacked[name]).sum(axis=0) for name in QUANTILES},
    }


def extended(earlier: Mapping[str, Statistics], statistics: Mapping[str, Statistics]) -> dict[str, Statistics]:
    """Statistics of each feature with one more episode; one by one, so that a resumed folder gets equal numbers."""
    if not earlier:
        return dict(statistics)
    return {key: combine([earlier[key], statistics[key]]) for key in statistics}
