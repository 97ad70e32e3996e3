"""The methods by name, as the command line and the tables call them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from robust_instant_policy.errors import MissingExtraError, UnknownNameError
from robust_instant_policy.policies.gp import KeypointRegression
from robust_instant_policy.policies.instant import InstantPolicy
from robust_instant_policy.policies.kat import KeypointActionTokens
from robust_instant_policy.policies.keypoint_context import KeypointContext
from robust_instant_policy.policies.neighbours import Neighbours
from robust_instant_policy.policies.policy import ClosedLoopPolicy, Policy
from robust_instant_policy.policies.rip import DOF, RobustInstantPolicy
from robust_instant_policy.policies.training import Training

if TYPE_CHECKING:
    from robust_instant_policy.policies.diffusion import ImageDiffusion, KeypointDiffusion

MOST_QUERIES = 10  # limit of the adaptive method, unless more are asked for

_METHODS: dict[str, Callable[[InstantPolicy, int, float, Training], Policy | ClosedLoopPolicy]] = {
    "rip": lambda instant, queries, dof, _: RobustInstantPolicy(instant, num_queries=queries, dof=dof),
    "rip-gauss": lambda instant, queries, *_: RobustInstantPolicy(instant, num_queries=queries, dof=math.inf),
    "rip-adaptive": lambda instant, queries, dof, _: RobustInstantPolicy(
        instant, num_queries=max(queries, MOST_QUERIES), dof=dof, adaptive=True
    ),
    "kat": lambda instant, queries, *_: KeypointActionTokens(instant, num_queries=queries),
    "dp": lambda instant, queries, dof, training: make_trained_policy("dp", instant.context, training),
    "kat-dp": lambda instant, queries, dof, training: make_trained_policy("kat-dp", instant.context, training, queries),
    "neighbours": lambda instant, queries, *_: Neighbours(instant.context, num_queries=queries),
    "gp": lambda instant, *_: KeypointRegression(instant.context),
}
METHOD_NAMES = tuple(_METHODS)
ASKING_METHODS = ("rip", "rip-gauss", "rip-adaptive", "kat")  # those that ask the language model
REGRESSING_METHODS = ("rip", "rip-gauss", "rip-adaptive")  # those that have a ν
TRAINED_METHODS = ("dp", "kat-dp")  # those that take minutes or hours to fit
IMAGE_METHODS = ("dp",)  # those whose demonstrations need images along the way


def make_policy(
    name: str, instant: InstantPolicy, num_queries: int = 5, dof: float = DOF, training: Training | None = None
) -> Policy | ClosedLoopPolicy:
    """The method ``name`` over ``instant``, which several methods may share; raises `UnknownNameError`.

    Call its ``fit(demonstrations)`` before anything else: what methods share is done only once, and what must be
    trained is trained as ``training`` says. Raises `MissingExtraError` where that needs what is not installed.
    """
    if name not in _METHODS:
        raise UnknownNameError("method", name, METHOD_NAMES)
    return _METHODS[name](instant, num_queries, dof, training or Training())


def make_trained_policy(
    name: str, context: KeypointContext, training: Training, num_queries: int = 5
) -> KeypointDiffusion | ImageDiffusion:
    """The one of `TRAINED_METHODS` called ``name``; raises `MissingExtraError` without PyTorch and diffusers."""
    try:
        from robust_instant_policy.policies.diffusion import ImageDiffusion, KeypointDiffusion
    except ModuleNotFoundError as error:
        if error.name and error.name.startswith("robust_instant_policy"):
            raise
        raise MissingExtraError(error.name or "diffusers", "train") from error
    return ImageDiffusion(training) if name == "dp" else KeypointDiffusion(context, num_queries, training)
