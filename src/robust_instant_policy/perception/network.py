"""Choice of the network that describes images."""

import os
from dataclasses import replace

from robust_instant_policy.perception.descriptors import DescriptorNetwork
from robust_instant_policy.perception.settings import DescriptorSettings

WEIGHTS_VARIABLE = "RIP_DINO_WEIGHTS"  # a folder or safetensors file with weights


def choose_network(features: str | DescriptorNetwork, settings: DescriptorSettings) -> tuple[DescriptorNetwork, str]:
    """The network that ``features`` names, and a note that says which was taken and why.

    ``"efficientnet"`` works offline. ``"dino"`` takes the model of the settings, from `WEIGHTS_VARIABLE`, the local
    cache or the hub. ``"auto"`` is DINO where its weights are on this machine, otherwise EfficientNet, without a
    request to the hub. Any other text is a folder, a safetensors file or a name on the hub; a `DescriptorNetwork` is
    taken as it is.
    """
    if not isinstance(features, str):
        return features, f"features: {features.name}"
    local = os.environ.get(WEIGHTS_VARIABLE)
    source = (local or settings.model) if features == "dino" else resolve_features(features, settings.model)
    note = f"features: {source}"
    if source == "efficientnet":
        from robust_instant_policy.perception.efficientnet import EfficientNetDescriptors

        note = "features: efficientnet-lite0, which ships with a package"
        if features == "auto":
            note += f", as the weights of {settings.model} are not on this machine "
            note += f"(fetch them with features='dino', or set {WEIGHTS_VARIABLE})"
        return EfficientNetDescriptors(settings), note
    if features == "auto":
        where = f"the weights at {WEIGHTS_VARIABLE}={local}" if local else f"{source}, found in the hub's local cache"
        note = f"features: {where}"
    from robust_instant_policy.perception.vit_checkpoint import load_checkpoint

    checkpoint = load_checkpoint(source)  # before the import of torch: says which extra is missing
    from robust_instant_policy.perception.vit import VitDescriptors

    return VitDescriptors(checkpoint, replace(settings, model=source)), note


def require_features(features: str) -> None:
    """Raises `ModelError` for a text that names no descriptors; to call before long work."""
    if features not in ("auto", "dino", "efficientnet"):
        from robust_instant_policy.perception.vit_checkpoint import require_source

        require_source(features)


def require_weights(features: str, model: str = DescriptorSettings.model) -> None:
    """Raises `ModelError` where `choose_network` would find no weights for ``features``; to call before long work.

    Fetches those that the hub has and that are not on this machine.
    """
    local = os.environ.get(WEIGHTS_VARIABLE)
    source = (local or model) if features == "dino" else features
    if source not in ("auto", "efficientnet"):
        from robust_instant_policy.perception.vit_checkpoint import obtain

        obtain(source)


def resolve_features(features: str, model: str = DescriptorSettings.model) -> str:
    """``features``, with ``"auto"`` replaced by what `choose_network` takes for it with the settings' ``model``."""
    if features != "auto":
        return features
    if local := os.environ.get(WEIGHTS_VARIABLE):
        return local
    from robust_instant_policy.perception.vit_checkpoint import cached_folder

    return model if cached_folder(model) else "efficientnet"
