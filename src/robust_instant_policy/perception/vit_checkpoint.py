"""Vision transformers by `transformers`: from the hub, a folder or a safetensors file. Only tensors are read."""

from __future__ import annotations

import json
import math
import os
import urllib.error
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robust_instant_policy.errors import MissingExtraError, ModelError

HUB_TIMEOUT_S = 3.0
WEIGHT_FILES = ("model.safetensors", "model.safetensors.index.json", "pytorch_model.bin")
HEAD_DIM = 64  # of every DINO and DINOv2 model; used where a file of weights comes without a config.json
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_DEVIATION = (0.229, 0.224, 0.225)
SUPPORTED = ("vit", "dinov2", "dinov2_with_registers")
LISTED_TENSORS = 6  # in an error message


@dataclass(frozen=True, eq=False)
class VitCheckpoint:
    """A frozen model of `transformers`, with the mean and deviation ``(3,)`` of the colours that it was trained on."""

    model: Any
    mean: tuple[float, ...] = IMAGENET_MEAN
    deviation: tuple[float, ...] = IMAGENET_DEVIATION


def load_checkpoint(source: str) -> VitCheckpoint:
    """The model at ``source``: a folder, a ``.safetensors`` file, or a name on the hub (``owner/model``).

    A name may end in ``@revision``, a commit of the hub's repository. The hub's local cache is asked first; without a
    connection the answer comes within seconds. Raises `ModelError`, one line.
    """
    path = Path(source).expanduser()
    if path.is_dir():
        return _from_folder(path)
    if path.is_file():
        return _from_file(path)
    if path.suffix == ".safetensors" or source.count("/") != 1 or source.startswith((".", "/", "~")):
        raise ModelError(f"there is no folder or file {source!r}, and it is not a name on the hub (owner/model)")
    return _from_folder(cached_folder(source) or _download(source))


def cached_folder(name: str) -> Path | None:
    """The folder in the hub's local cache that holds the weights of ``name``, without asking the network."""
    try:
        from huggingface_hub import try_to_load_from_cache
    except ImportError as error:
        raise MissingExtraError("transformers", "vision") from error
    repository, _, revision = name.partition("@")
    for file in WEIGHT_FILES:
        found = try_to_load_from_cache(repository, file, revision=revision or None)
        if isinstance(found, str) and (Path(found).parent / "config.json").exists():
            return Path(found).parent
    return None


def _download(name: str) -> Path:
    from huggingface_hub import constants, snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError

    if os.environ.get("HF_HUB_OFFLINE") == "1":
        raise ModelError(
            f"the weights of {name} are not in the local cache, and HF_HUB_OFFLINE=1 forbids fetching them"
        )
    unreachable = ModelError(
        f"the weights of {name} are not in the local cache and the hub cannot be reached; "
        "copy them here and pass the folder, or use features='efficientnet'"
    )
    if not _reachable(constants.ENDPOINT):  # the hub's own client would try for half a minute
        raise unreachable
    repository, _, revision = name.partition("@")
    try:
        # The safetensors alone where there are any; DINO's own repositories hold a .bin, which is read as tensors only.
        for patterns in (["*.json", "*.safetensors"], ["pytorch_model.bin"]):
            folder = Path(
                snapshot_download(
                    repository, revision=revision or None, allow_patterns=patterns, etag_timeout=HUB_TIMEOUT_S
                )
            )
            if any((folder / file).exists() for file in WEIGHT_FILES):
                return folder
    except LocalEntryNotFoundError as error:
        raise unreachable from error
    except HfHubHTTPError as error:
        raise ModelError(f"the hub refuses {name}: {str(error).splitlines()[0]}") from error
    raise ModelError(f"{name} on the hub has none of {', '.join(WEIGHT_FILES)}")


def _reachable(address: str) -> bool:
    try:
        urllib.request.urlopen(urllib.request.Request(address, method="HEAD"), timeout=HUB_TIMEOUT_S).close()
    except urllib.error.HTTPError:
        return True
    except (OSError, ValueError):
        return False
    return True


def _from_folder(folder: Path) -> VitCheckpoint:
    if not any((folder / file).exists() for file in WEIGHT_FILES):
        raise ModelError(f"{folder} has none of {', '.join(WEIGHT_FILES)}")
    if not (folder / "config.json").exists() and (folder / WEIGHT_FILES[0]).exists():
        return _from_file(folder / WEIGHT_FILES[0])
    model_type = _json(folder / "config.json").get("model_type")
    if model_type not in SUPPORTED:
        raise ModelError(f"{folder} holds a {model_type!r} model; supported: {', '.join(SUPPORTED)}")
    colours = folder / "preprocessor_config.json"
    told = _json(colours) if colours.exists() else {}
    return VitCheckpoint(
        _load(folder),
        tuple(told.get("image_mean", IMAGENET_MEAN)),
        tuple(told.get("image_std", IMAGENET_DEVIATION)),
    )


def _from_file(path: Path) -> VitCheckpoint:
    """A model from a lone file: its configuration is derived from the names and shapes of the tensors."""
    if path.suffix != ".safetensors":
        raise ModelError(f"{path} is not a .safetensors file; give one, or a folder that transformers saved")
    try:
        import transformers
        from safetensors import SafetensorError
        from safetensors.torch import load_file
    except ImportError as error:
        raise MissingExtraError(error.name or "transformers", "vision") from error
    try:
        tensors = load_file(path)
    except (SafetensorError, OSError) as error:
        raise ModelError(f"{path} cannot be read as weights: {str(error).splitlines()[0]}") from error
    # A model saved with its classifier keeps the transformer under a name of its own.
    tensors = {name.removeprefix("vit.").removeprefix("dinov2."): tensor for name, tensor in tensors.items()}
    try:
        projection = tensors["embeddings.patch_embeddings.projection.weight"]
        positions = tensors["embeddings.position_embeddings"]
    except KeyError as error:
        raise ModelError(f"{path} is not a vision transformer in transformers' naming: it has no {error}") from None
    width, patch = projection.shape[0], projection.shape[-1]
    sizes = {
        "hidden_size": width,
        "num_hidden_layers": len({name.split(".")[2] for name in tensors if name.startswith("encoder.layer.")}),
        "num_attention_heads": max(width // HEAD_DIM, 1),
        "patch_size": patch,
        "image_size": math.isqrt(positions.shape[1] - 1) * patch,
    }
    dinov2 = "encoder.layer.0.layer_scale1.lambda1" in tensors
    registers = tensors.get("embeddings.register_tokens")
    if registers is not None:
        config = transformers.Dinov2WithRegistersConfig(**sizes, num_register_tokens=registers.shape[1])
    elif dinov2:
        config = transformers.Dinov2Config(**sizes, use_swiglu_ffn="encoder.layer.0.mlp.weights_in.weight" in tensors)
    else:
        inner = tensors.get("encoder.layer.0.intermediate.dense.weight", projection.new_empty(4 * width)).shape[0]
        config = transformers.ViTConfig(**sizes, intermediate_size=inner)
    return VitCheckpoint(_load(path, config, tensors))


def _load(path: Path, config: Any = None, tensors: dict[str, Any] | None = None) -> Any:
    """The frozen model; raises `ModelError` naming the tensors that are missing or of another shape."""
    try:
        import torch
        import transformers
    except ImportError as error:
        raise MissingExtraError(error.name or "transformers", "vision") from error
    level = transformers.logging.get_verbosity()
    transformers.logging.set_verbosity_error()  # what does not fit is an error here, below
    bars = transformers.utils.logging.is_progress_bar_enabled()
    transformers.utils.logging.disable_progress_bar()
    config = transformers.AutoConfig.from_pretrained(path) if config is None else config
    kind = transformers.MODEL_MAPPING[type(config)]
    pooler = {"add_pooling_layer": False} if config.model_type == "vit" else {}
    try:
        model, report = kind.from_pretrained(
            None if tensors else path,
            config=config,
            state_dict=tensors,
            local_files_only=True,
            ignore_mismatched_sizes=True,
            output_loading_info=True,
            attn_implementation="sdpa",
            dtype=torch.float32,
            **pooler,
        )
    except Exception as error:  # of many kinds, for a file that is broken or unfinished
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise ModelError(f"{path} cannot be read as weights; is it whole? ({reason})") from error
    finally:
        transformers.logging.set_verbosity(level)
        if bars:
            transformers.utils.logging.enable_progress_bar()
    wrong = [f"{name} is missing" for name in sorted(report["missing_keys"])]
    for key in report["mismatched_keys"]:  # `transformers` 4 tells names, 5 the shapes as well
        if isinstance(key, str):
            wrong.append(f"{key} has another shape")
        else:
            wrong.append(f"{key[0]} is {tuple(key[1])} instead of {tuple(key[2])}")
    if wrong:
        more = f" and {len(wrong) - LISTED_TENSORS} more" if len(wrong) > LISTED_TENSORS else ""
        raise ModelError(f"the checkpoint {path} does not fit: {'; '.join(wrong[:LISTED_TENSORS])}{more}")
    return model.eval().requires_grad_(False)


def _json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ModelError(f"{path} is missing; copy all of the model's files") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ModelError(f"{path} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise ModelError(f"{path} holds no map of settings")
    return content
