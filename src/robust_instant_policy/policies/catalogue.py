"""The methods by name, as the command line and the tables call them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from robust_instant_policy.checks import check_name
from robust_instant_policy.errors import MissingExtraError
from robust_instant_policy.llm import DEADLINE_S, LanguageModel
from robust_instant_policy.policies.gp import KeypointRegression
from robust_instant_policy.policies.instant import KeypointActionTokens
from robust_instant_policy.policies.neighbours import Neighbours
from robust_instant_policy.policies.policy import ClosedLoopPolicy, Policy
from robust_instant_policy.policies.rip import RobustInstantPolicy
from robust_instant_policy.policies.settings import Settings
from robust_instant_policy.policies.training import Training

if TYPE_CHECKING:
    from robust_instant_policy.policies.diffusion import ImageDiffusion, KeypointDiffusion

MAX_ADAPTIVE_QUERIES = 10  # limit of rip-adaptive, unless more are asked for

METHOD_NAMES = ("rip", "rip-gauss", "mean", "rip-adaptive", "kat", "dp", "kat-dp", "neighbours", "gp")
ASKING_METHODS = ("rip", "rip-gauss", "mean", "rip-adaptive", "kat")  # those that ask the language model
FRAME_METHODS = (*ASKING_METHODS, "gp")  # those that work with either kind of frames
REGRESSING_METHODS = ("rip", "rip-gauss", "rip-adaptive")  # those that have a ν
TRAINED_METHODS = ("dp", "kat-dp")  # those that take minutes or hours to fit
IMAGE_METHODS = ("dp",)  # those whose demonstrations need images of the whole episode


def make_policy(
    name: str,
    llm: LanguageModel,
    settings: Settings,
    training: Training | None = None,
    deadline_s: float = DEADLINE_S,
) -> Policy | ClosedLoopPolicy:
    """The method ``name``, not yet fitted; raises `UnknownNameError`.

    Those of `TRAINED_METHODS` train as ``training`` says, and raise `MissingExtraError` without their extra.
    """
    check_name("method", name, METHOD_NAMES)
    if name in TRAINED_METHODS:
        return make_trained_policy(name, settings, training or Training())
    if name == "neighbours":
        return Neighbours(settings)
    if name == "gp":
        return KeypointRegression(settings)
    if name == "kat":
        return KeypointActionTokens(llm, settings, deadline_s=deadline_s)
    if name == "rip-gauss":
        settings = replace(settings, dof=math.inf)
    elif name == "mean":
        settings = replace(settings, estimator="mean")
    elif name == "rip-adaptive":
        settings = replace(settings, adaptive=True, num_queries=max(settings.num_queries, MAX_ADAPTIVE_QUERIES))
    return RobustInstantPolicy(llm, settings, deadline_s=deadline_s)


def make_trained_policy(name: str, settings: Settings, training: Training) -> KeypointDiffusion | ImageDiffusion:
    """The one of `TRAINED_METHODS` called ``name``; raises `MissingExtraError` without PyTorch and diffusers."""
    try:
        from robust_instant_policy.policies.diffusion import ImageDiffusion, KeypointDiffusion
    except ModuleNotFoundError as error:
        if error.name and error.name.startswith("robust_instant_policy"):
            raise
        raise MissingExtraError(error.name or "diffusers", "train") from error
    return ImageDiffusion(training) if name == "dp" else KeypointDiffusion(settings, training)
