"""Policies: methods that know no task."""

from robust_instant_policy.policies.catalogue import (
    ASKING_METHODS,
    IMAGE_METHODS,
    METHOD_NAMES,
    REGRESSING_METHODS,
    TRAINED_METHODS,
    make_policy,
    make_trained_policy,
)
from robust_instant_policy.policies.gp import KeypointRegression
from robust_instant_policy.policies.instant import InstantPolicy, Proposal
from robust_instant_policy.policies.kat import KeypointActionTokens
from robust_instant_policy.policies.keypoint_context import KeypointContext
from robust_instant_policy.policies.neighbours import Neighbours
from robust_instant_policy.policies.policy import ClosedLoopPolicy, Plan, Policy, Progress, Stage, Usage
from robust_instant_policy.policies.rip import DOF, RobustInstantPolicy
from robust_instant_policy.policies.training import Training

__all__ = [
    "ASKING_METHODS",
    "DOF",
    "IMAGE_METHODS",
    "METHOD_NAMES",
    "REGRESSING_METHODS",
    "TRAINED_METHODS",
    "ClosedLoopPolicy",
    "InstantPolicy",
    "KeypointActionTokens",
    "KeypointContext",
    "KeypointRegression",
    "Neighbours",
    "Plan",
    "Policy",
    "Progress",
    "Proposal",
    "RobustInstantPolicy",
    "Stage",
    "Training",
    "Usage",
    "make_policy",
    "make_trained_policy",
]
