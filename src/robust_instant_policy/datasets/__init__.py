"""Demonstrations on disk: LeRobotDataset v3.0 folders with the start-of-episode depth and camera."""

from robust_instant_policy.datasets.reader import load_demonstrations, load_frames
from robust_instant_policy.datasets.video import VideoWriter
from robust_instant_policy.datasets.writer import DatasetWriter
from robust_instant_policy.renamed import renamed

__all__ = ["DatasetWriter", "VideoWriter", "load_demonstrations", "load_frames"]

__getattr__ = renamed(__name__, {"write_page": "robust_instant_policy.reporting.demonstrations:write_page"})
