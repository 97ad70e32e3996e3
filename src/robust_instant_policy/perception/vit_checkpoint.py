"""Vision-transformer weights as `transformers` stores them: from the hub, a folder or a safetensors file.

Only tensors are read: safetensors, or a PyTorch file restricted to tensors, as the hub still keeps some (DINO's).
"""

from __future__ import annotations

import json
import os
import urllib.error
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robust_instant_policy.errors import MissingExtraError, ModelError

if TYPE_CHECKING:
    from torch import Tensor

HUB_TIMEOUT_S = 3.0
INDEX_FILE = "model.safetensors.index.json"  # of weights that are spread over several files
WEIGHT_FILES = ("model.safetensors", INDEX_FILE, "pytorch_model.bin")  # the first that is there is taken
HEAD_DIM = 64  # of every DINO and DINOv2 model; used where a lone safetensors file does not say
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_DEVIATION = (0.229, 0.224, 0.225)
SUPPORTED = ("vit", "dinov2", "dinov2_with_registers")
LISTED_TENSORS = 6  # in an error message


@dataclass(frozen=True)
class VitConfig:
    """The shape of a vision transformer, under `transformers`' names."""

    model_type: str
    hidden_size: int
    num_hidden_layers: int
    num_attention_heads: int
    patch_size: int
    num_positions: int
    num_register_tokens: int
    intermediate_size: int
    layer_norm_eps: float
    swiglu: bool
    qkv_bias: bool


@dataclass(frozen=True, eq=False)
class VitCheckpoint:
    """Weights that fit a configuration. Raises `ModelError`, naming the tensors, where they do not."""

    config: VitConfig
    tensors: Mapping[str, Tensor]
    mean: tuple[float, ...] = IMAGENET_MEAN
    deviation: tuple[float, ...] = IMAGENET_DEVIATION

    def __post_init__(self) -> None:
        wrong = []
        for name, shape in expected_tensors(self.config).items():
            if name not in self.tensors:
                wrong.append(f"{name} is missing")
            elif tuple(self.tensors[name].shape) != shape:
                wrong.append(f"{name} is {tuple(self.tensors[name].shape)} instead of {shape}")
        if wrong:
            more = f" and {len(wrong) - LISTED_TENSORS} more" if len(wrong) > LISTED_TENSORS else ""
            raise ModelError(f"the checkpoint does not fit: {'; '.join(wrong[:LISTED_TENSORS])}{more}")


def expected_tensors(config: VitConfig) -> dict[str, tuple[int, ...]]:
    """Names and shapes of all tensors that the descriptors need."""
    width, inner = config.hidden_size, config.intermediate_size
    shapes: dict[str, tuple[int, ...]] = {
        "embeddings.cls_token": (1, 1, width),
        "embeddings.position_embeddings": (1, config.num_positions, width),
        "embeddings.patch_embeddings.projection.weight": (width, 3, config.patch_size, config.patch_size),
        "embeddings.patch_embeddings.projection.bias": (width,),
    }
    if config.num_register_tokens:
        shapes["embeddings.register_tokens"] = (1, config.num_register_tokens, width)
    dinov2 = config.model_type != "vit"
    first, second = ("norm1", "norm2") if dinov2 else ("layernorm_before", "layernorm_after")
    for layer in range(config.num_hidden_layers):
        block = f"encoder.layer.{layer}."
        for norm in (first, second):
            shapes |= {f"{block}{norm}.weight": (width,), f"{block}{norm}.bias": (width,)}
        for facet in ("query", "key", "value"):
            shapes[f"{block}attention.attention.{facet}.weight"] = (width, width)
            if config.qkv_bias:
                shapes[f"{block}attention.attention.{facet}.bias"] = (width,)
        linear = {"attention.output.dense": (width, width)}
        if config.swiglu:
            linear |= {"mlp.weights_in": (2 * inner, width), "mlp.weights_out": (width, inner)}
        elif dinov2:
            linear |= {"mlp.fc1": (inner, width), "mlp.fc2": (width, inner)}
        else:
            linear |= {"intermediate.dense": (inner, width), "output.dense": (width, inner)}
        for name, shape in linear.items():
            shapes |= {f"{block}{name}.weight": shape, f"{block}{name}.bias": shape[:1]}
        if dinov2:
            shapes |= {f"{block}layer_scale1.lambda1": (width,), f"{block}layer_scale2.lambda1": (width,)}
    return shapes


def load_checkpoint(source: str) -> VitCheckpoint:
    """Weights from ``source``: a folder, a ``.safetensors`` file, or a model's name on the hub.

    The hub's local cache is asked first; without a connection the answer comes within seconds.
    Raises `ModelError`, one line.
    """
    path = Path(source).expanduser()
    if path.is_dir():
        return _from_folder(path)
    if path.is_file():
        return _from_file(path, {}, {})
    if path.suffix in (".safetensors", ".bin") or source.count("/") != 1 or source.startswith((".", "/", "~")):
        raise ModelError(f"there is no folder or file {source!r}, and it is not a name on the hub (owner/model)")
    return _from_folder(cached_folder(source) or _download(source))


def cached_folder(name: str) -> Path | None:
    """The folder in the hub's local cache that holds the weights of ``name``, without asking the network."""
    try:
        from huggingface_hub import try_to_load_from_cache
    except ImportError as error:
        raise MissingExtraError("transformers", "vision") from error
    for file in WEIGHT_FILES:
        found = try_to_load_from_cache(name, file)
        if isinstance(found, str) and try_to_load_from_cache(name, "config.json"):
            return Path(found).parent
    return None


def _download(name: str) -> Path:
    from huggingface_hub import constants, hf_hub_download
    from huggingface_hub.errors import EntryNotFoundError, HfHubHTTPError, LocalEntryNotFoundError

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
    try:
        hf_hub_download(name, "config.json", etag_timeout=HUB_TIMEOUT_S)
        for file in WEIGHT_FILES:
            try:
                found = Path(hf_hub_download(name, file, etag_timeout=HUB_TIMEOUT_S))
                for shard in _shards(found) if file == INDEX_FILE else ():
                    hf_hub_download(name, shard, etag_timeout=HUB_TIMEOUT_S)
                return found.parent
            except LocalEntryNotFoundError:
                raise
            except EntryNotFoundError:
                continue
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
    facts: dict[str, dict[str, Any]] = {}
    for name in ("config", "preprocessor_config"):
        path = folder / f"{name}.json"
        facts[name] = _json(path) if path.exists() else {}
    for file in WEIGHT_FILES:
        if (folder / file).exists():
            return _from_file(folder / file, facts["config"], facts["preprocessor_config"])
    raise ModelError(f"{folder} has none of {', '.join(WEIGHT_FILES)}")


def _json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except ValueError as error:
        raise ModelError(f"{path} is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise ModelError(f"{path} holds a list or a single value where names with values belong")
    return content


def _shards(index: Path) -> list[str]:
    """The files beside ``index`` over which the weights are spread."""
    files = _json(index).get("weight_map")
    if not isinstance(files, dict) or not all(isinstance(file, str) for file in files.values()):
        raise ModelError(f"{index} does not say which file holds which tensor (weight_map)")
    names = sorted(set(files.values()))
    if any(Path(name).name != name for name in names):
        raise ModelError(f"{index} names files outside its folder")
    return names


def _from_file(path: Path, config: Mapping[str, Any], preprocessing: Mapping[str, Any]) -> VitCheckpoint:
    if path.name == INDEX_FILE:
        tensors: dict[str, Any] = {}
        for shard in _shards(path):
            if not (path.parent / shard).exists():
                raise ModelError(f"{path} names {shard}, which is not there; copy all of the model's files")
            tensors |= _tensors(path.parent / shard)
    else:
        tensors = _tensors(path)
    # A model saved with its classifier keeps the transformer under a name of its own.
    bare = {name.removeprefix("vit.").removeprefix("dinov2."): tensor.float() for name, tensor in tensors.items()}
    return VitCheckpoint(
        _configuration(path, bare, config),
        bare,
        tuple(preprocessing.get("image_mean", IMAGENET_MEAN)),
        tuple(preprocessing.get("image_std", IMAGENET_DEVIATION)),
    )


def _tensors(path: Path) -> dict[str, Any]:
    try:
        import torch
        from safetensors import SafetensorError
        from safetensors.torch import load_file
    except ImportError as error:
        raise MissingExtraError(error.name or "safetensors", "vision") from error
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        tensors = torch.load(path, map_location="cpu", weights_only=True)
    except (SafetensorError, OSError, RuntimeError, ValueError, EOFError) as error:
        raise ModelError(f"{path} cannot be read as weights: {str(error).splitlines()[0]}") from error
    except Exception as error:  # torch's own for a file that is none, an unfinished download for instance
        raise ModelError(f"{path} cannot be read as weights; is it whole?") from error
    if not isinstance(tensors, dict) or not all(isinstance(value, torch.Tensor) for value in tensors.values()):
        raise ModelError(
            f"{path} holds other things than tensors by name, like a checkpoint of a training; export those"
        )
    return tensors


def _configuration(path: Path, tensors: Mapping[str, Tensor], told: Mapping[str, Any]) -> VitConfig:
    """What ``config.json`` says; what it leaves out, from the tensors' names and shapes."""
    projection = tensors.get("embeddings.patch_embeddings.projection.weight")
    position = tensors.get("embeddings.position_embeddings")
    if projection is None or position is None:
        raise ModelError(
            f"{path} is not a vision transformer in transformers' naming: it has no "
            "embeddings.patch_embeddings.projection.weight or no embeddings.position_embeddings"
        )
    layers = {int(name.split(".")[2]) for name in tensors if name.startswith("encoder.layer.")}
    registers = tensors.get("embeddings.register_tokens")
    dinov2 = any(".layer_scale1." in name for name in tensors)
    guess = ("dinov2_with_registers" if registers is not None else "dinov2") if dinov2 else "vit"
    model_type = str(told.get("model_type", guess))
    if model_type not in SUPPORTED:
        raise ModelError(f"{path} holds a {model_type!r} model; supported: {', '.join(SUPPORTED)}")
    if told.get("hidden_act", "gelu") != "gelu":
        raise ModelError(f"{path} wants the activation {told['hidden_act']!r}; supported: 'gelu'")
    width = int(told.get("hidden_size", projection.shape[0]))
    swiglu = "encoder.layer.0.mlp.weights_out.weight" in tensors
    inner_name = "mlp.weights_out" if swiglu else "mlp.fc2" if model_type != "vit" else "output.dense"
    inner = tensors.get(f"encoder.layer.0.{inner_name}.weight")
    patch_size = int(told.get("patch_size", projection.shape[-1]))
    return VitConfig(
        model_type=model_type,
        hidden_size=width,
        num_hidden_layers=int(told.get("num_hidden_layers", len(layers))),
        num_attention_heads=int(told.get("num_attention_heads", max(width // HEAD_DIM, 1))),
        patch_size=patch_size,
        num_positions=(told["image_size"] // patch_size) ** 2 + 1 if "image_size" in told else position.shape[1],
        num_register_tokens=int(told.get("num_register_tokens", 0 if registers is None else registers.shape[1])),
        intermediate_size=inner.shape[1] if inner is not None else 4 * width,
        layer_norm_eps=float(told.get("layer_norm_eps", 1e-6)),
        swiglu=swiglu,
        qkv_bias=bool(told.get("qkv_bias", True)),
    )
