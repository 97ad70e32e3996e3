"""Which network describes the images, and why it was taken."""

from __future__ import annotations

import os
from dataclasses import replace

from robust_instant_policy.errors import MissingExtraError
from robust_instant_policy.perception.descriptors import DescriptorNetwork
from robust_instant_policy.perception.settings import DescriptorSettings

WEIGHTS_VARIABLE = "RIP_DINO_WEIGHTS"  # a folder or safetensors file that holds the weights


def choose_network(features: str | DescriptorNetwork, settings: DescriptorSettings) -> tuple[DescriptorNetwork, str]:
    """The network that ``features`` names, and one line that says which was taken and why.

    ``"efficientnet"`` works offline. ``"dino"`` takes the model of the settings, from `WEIGHTS_VARIABLE`, the local
    cache or the hub. ``"auto"`` is DINO where its weights are on this machine, otherwise EfficientNet; it never
    asks the network. Any other text is a folder, a safetensors file or a name on the hub; a `DescriptorNetwork` is
    taken as it is.
    """
    if not isinstance(features, str):
        return features, f"features: {features.name}"
    local = os.environ.get(WEIGHTS_VARIABLE, "")
    if features == "efficientnet":
        return _efficientnet(settings), "features: efficientnet-lite0, which ships with a package"
    if features != "auto":
        source = (local or settings.model) if features == "dino" else features
        return _vit(source, settings), f"features: {source}"
    if local:
        return _vit(local, settings), f"features: the weights at {WEIGHTS_VARIABLE}={local}"
    if _is_cached(settings.model):
        return _vit(settings.model, settings), f"features: {settings.model}, found in the hub's local cache"
    return _efficientnet(settings), (
        f"features: efficientnet-lite0, which ships with a package, as the weights of {settings.model} are not on this "
        f"machine (fetch them with features='dino', or set {WEIGHTS_VARIABLE})"
    )


def resolve_features(features: str) -> str:
    """``features``, with the name of the network that `choose_network` takes in the place of ``"auto"``."""
    if features != "auto":
        return features
    model = DescriptorSettings.model
    return os.environ.get(WEIGHTS_VARIABLE) or (model if _is_cached(model) else "efficientnet")


def _is_cached(name: str) -> bool:
    from robust_instant_policy.perception.vit_checkpoint import cached_folder

    try:
        return cached_folder(name) is not None
    except MissingExtraError:
        return False


def _efficientnet(settings: DescriptorSettings) -> DescriptorNetwork:
    from robust_instant_policy.perception.efficientnet import EfficientNetDescriptors

    return EfficientNetDescriptors(settings)


def _vit(source: str, settings: DescriptorSettings) -> DescriptorNetwork:
    try:
        import torch  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("torch", "vision") from error
    from robust_instant_policy.perception.vit import VitDescriptors
    from robust_instant_policy.perception.vit_checkpoint import load_checkpoint

    return VitDescriptors(load_checkpoint(source), replace(settings, model=source))
