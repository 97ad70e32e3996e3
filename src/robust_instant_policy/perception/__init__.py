"""RGB-D images to 3-D keypoints that all demonstrations share."""

from robust_instant_policy.perception.accuracy import Accuracy, KnownScene, measure
from robust_instant_policy.perception.keypoints import CORRESPONDENCES, KeypointExtractor, Located
from robust_instant_policy.perception.settings import PAPER_REAL, PAPER_SIMULATION, DescriptorSettings
from robust_instant_policy.renamed import renamed

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

__getattr__ = renamed(__name__, {"keypoints_page": "robust_instant_policy.reporting.keypoints:keypoints_page"})
