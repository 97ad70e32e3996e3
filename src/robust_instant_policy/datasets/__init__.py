"""Demonstrations on disk: LeRobotDataset v3.0 folders with the start-of-episode depth and camera."""

import importlib
import warnings

from robust_instant_policy.datasets.reader import load_demonstrations, load_frames
from robust_instant_policy.datasets.video import VideoWriter
from robust_instant_policy.datasets.writer import DatasetWriter

__all__ = ["DatasetWriter", "VideoWriter", "load_demonstrations", "load_frames"]


def __getattr__(name: str) -> object:
    if name != "write_page":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # The old place of the name, for one version; by name, as no room imports one above it.
    message = "datasets.write_page has moved: use robust_instant_policy.reporting.demonstrations.write_page"
    warnings.warn(message, DeprecationWarning, stacklevel=2)
    return importlib.import_module("robust_instant_policy.reporting.demonstrations").write_page
