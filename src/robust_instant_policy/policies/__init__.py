"""Policies: methods that know no task."""

from robust_instant_policy.policies.catalogue import ASKING_METHODS, METHOD_NAMES, REGRESSING_METHODS, make_policy
from robust_instant_policy.policies.instant import InstantPolicy, Proposal
from robust_instant_policy.policies.kat import KeypointActionTokens
from robust_instant_policy.policies.keypoint_context import KeypointContext
from robust_instant_policy.policies.neighbours import Neighbours
from robust_instant_policy.policies.policy import ClosedLoopPolicy, Plan, Policy, Progress, Stage, Usage
from robust_instant_policy.policies.rip import DOF, RobustInstantPolicy

__all__ = [
    "ASKING_METHODS",
    "DOF",
    "METHOD_NAMES",
    "REGRESSING_METHODS",
    "ClosedLoopPolicy",
    "InstantPolicy",
    "KeypointActionTokens",
    "KeypointContext",
    "Neighbours",
    "Plan",
    "Policy",
    "Progress",
    "Proposal",
    "RobustInstantPolicy",
    "Stage",
    "Usage",
    "make_policy",
]
