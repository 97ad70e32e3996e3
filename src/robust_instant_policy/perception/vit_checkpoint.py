"""Vision transformers of `transformers`, from the hub, a folder or a safetensors file. Only tensors are read."""

import importlib.util
import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robust_instant_policy.errors import DatasetError, MissingExtraError, ModelError
from robust_instant_policy.files import excerpt, others_can_write, read_json, sha256
from robust_instant_policy.perception.settings import IMAGENET_DEVIATION, IMAGENET_MEAN

HUB_TIMEOUT_S = 3.0
WEIGHT_FILES = ("model.safetensors", "model.safetensors.index.json", "pytorch_model.bin")
HEAD_DIM = 64  # of every DINO and DINOv2 model; for weights without a config.json
SUPPORTED = ("vit", "dinov2", "dinov2_with_registers")
SHA256 = re.compile(r"[0-9a-f]{64}")
MAX_LISTED_TENSORS = 6  # in an error message


@dataclass(frozen=True, eq=False)
class VitCheckpoint:
    """A frozen ``model`` of `transformers`; ``mean`` and ``deviation (3,)`` of the colours it was trained on."""

    model: Any
    mean: tuple[float, ...] = IMAGENET_MEAN
    deviation: tuple[float, ...] = IMAGENET_DEVIATION


def load_checkpoint(source: str) -> VitCheckpoint:
    """The model at ``source``: a folder, a ``.safetensors`` file, or a name on the hub (``owner/model``).

    A name may end in ``@revision``, a commit of the hub's repository. The local cache goes before the hub; without a
    connection the error comes within seconds. What the hub sent is checked at every use (`_checked`). Raises
    `ModelError`, one line, and `MissingExtraError`.
    """
    path = obtain(source)
    return _from_file(path) if path.is_file() else _from_folder(path)


def obtain(source: str) -> Path:
    """The folder or file with the weights of ``source``, as for `load_checkpoint`; fetches what the hub has.

    Raises `ModelError`, one line, and `MissingExtraError`. Loads nothing.
    """
    for package in ("torch", "transformers", "safetensors"):
        if importlib.util.find_spec(package) is None:
            raise MissingExtraError(package, "vision")
    require_source(source)
    path = Path(source).expanduser()
    if path.is_dir() or path.is_file():
        return path
    return _checked(cached_folder(source) or _download(source))


def require_source(source: str) -> None:
    """Raises `ModelError` for a text that is no folder or file, and no name on the hub. Loads nothing."""
    path = Path(source).expanduser()
    named = path.suffix != ".safetensors" and source.count("/") == 1 and not source.startswith((".", "/", "~"))
    if not (path.exists() or named):
        raise ModelError(
            f"no image descriptors {source!r}: known are auto, dino and efficientnet, a folder or .safetensors file of "
            "a ViT, and a name on the hub (owner/model)"
        )


def cached_folder(name: str) -> Path | None:
    """The folder with the weights of ``name`` in the hub's local cache, without a request to the hub."""
    try:
        from huggingface_hub import try_to_load_from_cache
    except ImportError:
        return None
    repository, _, revision = name.partition("@")
    paths = (try_to_load_from_cache(repository, file, revision=revision or None) for file in WEIGHT_FILES)
    folders = (Path(path).parent for path in paths if isinstance(path, str))
    return next((folder for folder in folders if (folder / "config.json").exists()), None)


def _download(name: str) -> Path:
    from huggingface_hub import HfApi
    from huggingface_hub.errors import HfHubHTTPError

    repository, _, commit = name.partition("@")
    hub, revision = HfApi(), commit or None
    try:
        # This request has a short timeout; without a connection, a download would retry for half a minute.
        files = hub.model_info(repository, revision=revision, timeout=HUB_TIMEOUT_S).siblings or ()
        # DINO's own repositories hold only a .bin, of which transformers reads only tensors.
        tensors = any(file.rfilename.endswith(".safetensors") for file in files)
        wanted = ["*.json", "*.safetensors" if tensors else "pytorch_model.bin"]
        return Path(hub.snapshot_download(repository, revision=revision, allow_patterns=wanted))
    except HfHubHTTPError as error:
        raise ModelError(f"the hub refuses {name}: {excerpt(error)}") from error
    except Exception as error:  # whose type depends on the hub's client
        raise ModelError(
            f"the weights of {name} are not in the local cache and the hub cannot provide them ({excerpt(error)}); "
            "copy them here and pass the folder, or use features='efficientnet'"
        ) from error


def _checked(folder: Path) -> Path:
    """The ``folder`` of a snapshot in the hub's cache, where links name the content of large files by its SHA-256.

    A copy without links names none, and is not compared. Raises `ModelError` where the content is another, or where
    other users could exchange it.
    """
    model = folder.parents[1]
    for file in folder.iterdir():
        content = Path(os.path.realpath(file))
        if not content.is_file():  # a link that leads nowhere: what is needed is missed where it is loaded
            continue
        for path in {model, folder.parent, folder, content.parent, content}:
            if others_can_write(path, in_own_group=False):
                raise ModelError(
                    f"other users can write to {path}; run chmod -R go-w on {model} if it is yours, or name a folder "
                    "of your own in HF_HOME"
                )
        if SHA256.fullmatch(content.name) and sha256(content) != content.name:
            raise ModelError(f"{file} has another SHA-256 than the hub gave for it; remove {model}")
    return folder


def _from_folder(folder: Path) -> VitCheckpoint:
    if not any((folder / file).exists() for file in WEIGHT_FILES):
        raise ModelError(f"{folder} has none of {', '.join(WEIGHT_FILES)}")
    if not (folder / "config.json").exists() and (folder / WEIGHT_FILES[0]).exists():
        return _from_file(folder / WEIGHT_FILES[0])
    preprocessor = folder / "preprocessor_config.json"
    try:
        model_type = read_json(folder / "config.json").get("model_type")
        colours = read_json(preprocessor) if preprocessor.exists() else {}
    except DatasetError as error:
        raise ModelError(str(error)) from error
    if model_type not in SUPPORTED:
        raise ModelError(f"{folder} holds a {model_type!r} model; supported: {', '.join(SUPPORTED)}")
    return VitCheckpoint(
        _load(folder),
        tuple(colours.get("image_mean", IMAGENET_MEAN)),
        tuple(colours.get("image_std", IMAGENET_DEVIATION)),
    )


def _from_file(path: Path) -> VitCheckpoint:
    """A model whose configuration is derived from the names and shapes of its tensors."""
    if path.suffix != ".safetensors":
        raise ModelError(f"{path} is not a .safetensors file; give one, or a folder that transformers saved")
    import transformers
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        tensors = load_file(path)
    except (SafetensorError, OSError) as error:
        raise ModelError(f"{path} cannot be read as weights: {excerpt(error)}") from error
    # In a model saved with its classifier the transformer's tensors have a prefix.
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
    registers = tensors.get("embeddings.register_tokens")
    if registers is not None:
        config = transformers.Dinov2WithRegistersConfig(**sizes, num_register_tokens=registers.shape[1])
    elif "encoder.layer.0.layer_scale1.lambda1" in tensors:
        config = transformers.Dinov2Config(**sizes, use_swiglu_ffn="encoder.layer.0.mlp.weights_in.weight" in tensors)
    else:
        inner = tensors.get("encoder.layer.0.intermediate.dense.weight", projection.new_empty(4 * width)).shape[0]
        config = transformers.ViTConfig(**sizes, intermediate_size=inner)
    return VitCheckpoint(_load(path, config, tensors))


def _load(path: Path, config: Any = None, tensors: dict[str, Any] | None = None) -> Any:
    """The frozen model. Raises `ModelError` with the names of tensors that are missing or of another shape."""
    import torch
    import transformers

    level = transformers.logging.get_verbosity()
    transformers.logging.set_verbosity_error()  # what it would warn of is an error below
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
    except Exception as error:  # transformers raises many types for broken or incomplete files
        raise ModelError(
            f"{path} cannot be read as weights; is it whole? ({excerpt(error) or type(error).__name__})"
        ) from error
    finally:
        transformers.logging.set_verbosity(level)
        if bars:
            transformers.utils.logging.enable_progress_bar()
    wrong = [f"{name} is missing" for name in sorted(report["missing_keys"])]
    wrong += [  # names in transformers 4, with shapes in 5
        f"{key} has another shape"
        if isinstance(key, str)
        else f"{key[0]} is {tuple(key[1])} instead of {tuple(key[2])}"
        for key in report["mismatched_keys"]
    ]
    if wrong:
        more = f" and {len(wrong) - MAX_LISTED_TENSORS} more" if len(wrong) > MAX_LISTED_TENSORS else ""
        raise ModelError(f"the checkpoint {path} does not fit: {'; '.join(wrong[:MAX_LISTED_TENSORS])}{more}")
    return model.eval().requires_grad_(False)
