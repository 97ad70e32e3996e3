"""Diffusion policies, trained for each task: the paper's baselines. Needs the extra ``train``."""

from robust_instant_policy.policies.diffusion.dp import ImageDiffusion
from robust_instant_policy.policies.diffusion.kat_dp import KeypointDiffusion

__all__ = ["ImageDiffusion", "KeypointDiffusion"]
