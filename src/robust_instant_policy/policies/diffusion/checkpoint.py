"""Weights and the state of a training on disk: safetensors, written whole or not at all."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialize
from torch import Tensor

from robust_instant_policy.errors import ModelError
from robust_instant_policy.files import write_whole

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

FINGERPRINT_DIGITS = 12


def fingerprint(settings: DataclassInstance, arrays: Iterable[np.ndarray]) -> str:
    """A name for what was trained how: the same only for equal ``settings`` and equal ``arrays``."""
    digest = hashlib.sha256(json.dumps(asdict(settings), sort_keys=True).encode())
    for array in arrays:
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:FINGERPRINT_DIGITS]


def save(path: Path, tensors: Mapping[str, Tensor], facts: Mapping[str, float]) -> None:
    """Write ``tensors`` and ``facts`` about them; on disk when this returns. Raises `DatasetError` where it cannot."""
    own = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    write_whole(path, serialize(own, metadata={name: json.dumps(fact) for name, fact in facts.items()}))


def load(path: Path) -> tuple[dict[str, Tensor], dict[str, float]]:
    """What `save` wrote; raises `ModelError` for a damaged file."""
    try:
        with safe_open(path, framework="pt") as file:
            facts = {name: json.loads(fact) for name, fact in (file.metadata() or {}).items()}
            return {name: file.get_tensor(name) for name in file.keys()}, facts  # noqa: SIM118
    except (OSError, ValueError, SafetensorError) as error:
        raise ModelError(f"{path} cannot be read ({error}); remove it to train again") from None
