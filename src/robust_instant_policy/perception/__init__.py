"""RGB-D images to 3-D keypoints that all demonstrations share."""

import importlib
import warnings

from robust_instant_policy.perception.accuracy import Accuracy, KnownScene, measure
from robust_instant_policy.perception.keypoints import CORRESPONDENCES, KeypointExtractor, Located
from robust_instant_policy.perception.settings import PAPER_REAL, PAPER_SIMULATION, DescriptorSettings

__all__ = [
    "CORRESPONDENCES",
    "PAPER_REAL",
    "PAPER_SIMULATION",
    "Accuracy",
    "DescriptorSettings",
    "KeypointExtractor",
    "KnownScene",
    "Located",
    "measure",
]


def __getattr__(name: str) -> object:
    if name != "keypoints_page":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # The old place of the name, for one version; by name, as no room imports one above it.
    message = "perception.keypoints_page has moved: use robust_instant_policy.reporting.keypoints.keypoints_page"
    warnings.warn(message, DeprecationWarning, stacklevel=2)
    return importlib.import_module("robust_instant_policy.reporting.keypoints").keypoints_page
