"""Policies: methods that know no task.

A method over keypoints is a walk through pure stages: `build_context`, `locate`, `sample`, `propose`, `aggregate`.
"""

from robust_instant_policy.policies.aggregation import aggregate
from robust_instant_policy.policies.catalogue import (
    ASKING_METHODS,
    FRAME_METHODS,
    IMAGE_METHODS,
    METHOD_NAMES,
    REGRESSING_METHODS,
    TRAINED_METHODS,
    make_policy,
    make_trained_policy,
)
from robust_instant_policy.policies.context import (
    Context,
    LocatedScene,
    build_context,
    context_of_keypoints,
    locate,
    scene_of_keypoints,
)
from robust_instant_policy.policies.gp import KeypointRegression
from robust_instant_policy.policies.instant import KeypointActionTokens
from robust_instant_policy.policies.keypoint_policy import KeypointPolicy
from robust_instant_policy.policies.neighbours import Neighbours
from robust_instant_policy.policies.own_keypoints import KeypointSource
from robust_instant_policy.policies.policy import ClosedLoopPolicy, Plan, Policy, Progress, Stage, Usage
from robust_instant_policy.policies.replanning import Replanning
from robust_instant_policy.policies.rip import RobustInstantPolicy
from robust_instant_policy.policies.sampling import Proposal, Samples, propose, sample
from robust_instant_policy.policies.settings import CONFIGS, Settings
from robust_instant_policy.policies.training import Training
from robust_instant_policy.renamed import renamed

__all__ = [
    "ASKING_METHODS",
    "CONFIGS",
    "FRAME_METHODS",
    "IMAGE_METHODS",
    "METHOD_NAMES",
    "REGRESSING_METHODS",
    "TRAINED_METHODS",
    "ClosedLoopPolicy",
    "Context",
    "KeypointActionTokens",
    "KeypointPolicy",
    "KeypointRegression",
    "KeypointSource",
    "LocatedScene",
    "Neighbours",
    "Plan",
    "Policy",
    "Progress",
    "Proposal",
    "Replanning",
    "RobustInstantPolicy",
    "Samples",
    "Settings",
    "Stage",
    "Training",
    "Usage",
    "aggregate",
    "build_context",
    "context_of_keypoints",
    "locate",
    "make_policy",
    "make_trained_policy",
    "propose",
    "sample",
    "scene_of_keypoints",
]

__getattr__ = renamed(
    __name__,
    {"KeypointContext": f"{__name__}:Settings", "InstantPolicy": f"{__name__}:KeypointActionTokens"},
)
