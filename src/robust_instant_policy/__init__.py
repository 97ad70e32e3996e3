"""Robust Instant Policy: show a robot a task a few times; it does it at once, without training."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

__version__ = "0.1.0"

_HOMES = {
    "Observation": "demonstration",
    "Demonstration": "demonstration",
    "Trajectory": "trajectory",
    "GripperTriangle": "geometry",
    "RipError": "errors",
    "load_demonstrations": "datasets",
    "connect": "llm",
    "Plan": "policies",
    "RobustInstantPolicy": "policies",
    "KeypointActionTokens": "policies",
}

__all__ = ["__version__", *_HOMES]

if TYPE_CHECKING:
    from robust_instant_policy.datasets import load_demonstrations as load_demonstrations
    from robust_instant_policy.demonstration import Demonstration as Demonstration
    from robust_instant_policy.demonstration import Observation as Observation
    from robust_instant_policy.errors import RipError as RipError
    from robust_instant_policy.geometry import GripperTriangle as GripperTriangle
    from robust_instant_policy.llm import connect as connect
    from robust_instant_policy.policies import KeypointActionTokens as KeypointActionTokens
    from robust_instant_policy.policies import Plan as Plan
    from robust_instant_policy.policies import RobustInstantPolicy as RobustInstantPolicy
    from robust_instant_policy.trajectory import Trajectory as Trajectory


def __getattr__(name: str) -> object:
    # Names are fetched when first used, so that importing the package stays quick and needs no extra.
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
