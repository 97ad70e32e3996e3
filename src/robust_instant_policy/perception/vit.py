"""Descriptors and saliency of a vision transformer (Amir et al. 2022, "Deep ViT Features as Dense Visual Descriptors").

Descriptors are a facet of one layer, saliency the attention of the class token to each patch in the last layer.
`transformers` runs the model; this file adds overlapping patches and DINO's interpolation of position encodings.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from PIL import Image

from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.perception.descriptors import DescriptorMap
from robust_instant_policy.perception.settings import FACETS, DescriptorSettings
from robust_instant_policy.perception.vit_checkpoint import VitCheckpoint

POSITION_OFFSET = 0.1  # patches that DINO adds to the grid before the interpolation, against rounding
DINO_SALIENT_HEADS = (0, 2, 4, 5)  # of ViT-S's six; the reference averages these (Amir et al. 2022)
PROJECTIONS = {"query": ("q_proj", "query"), "key": ("k_proj", "key"), "value": ("v_proj", "value")}


class VisionTransformer:
    """A frozen vision transformer whose patches may overlap.

    ``stride``, in pixels, must divide the patch size; position encodings are interpolated to the denser grid.
    """

    def __init__(self, model: Any, stride: int):
        self.config = model.config
        if stride < 1 or self.config.patch_size % stride:
            raise InvalidValueError(f"stride {stride} must divide the patch size {self.config.patch_size}")
        self._model, self._stride = model, stride
        self._layers = [
            module for name, module in model.named_modules() if name.split(".")[-2:-1] in (["layers"], ["layer"])
        ]

    @torch.inference_mode()
    def features(self, batch: torch.Tensor, layer: int, facet: str) -> tuple[torch.Tensor, torch.Tensor]:
        """Descriptors ``(rows, cols, D)``, a facet of a layer, and saliency ``(rows, cols)`` in [0, 1].

        ``batch (1, 3, H, W)`` is one normalised image. Raises `InvalidValueError` for unknown layers and facets.
        """
        if not 0 <= layer < len(self._layers):
            raise InvalidValueError(f"layer must be 0 to {len(self._layers) - 1}, got {layer}")
        if facet not in FACETS:
            raise InvalidValueError(f"facet must be one of {', '.join(FACETS)}, got {facet!r}")
        seen: dict[str, torch.Tensor] = {}

        def keep(name: str, module: torch.nn.Module) -> torch.utils.hooks.RemovableHandle:
            def hook(_module: Any, _inputs: Any, output: Any) -> None:
                seen[name] = output[0] if isinstance(output, tuple) else output

            return module.register_forward_hook(hook)

        chosen, last = self._layers[layer], self._layers[-1]
        hooks = [
            keep("wanted", chosen if facet == "token" else _projection(chosen, facet)),
            keep("query", _projection(last, "query")),
            keep("key", _projection(last, "key")),
        ]
        embeddings = self._model.embeddings
        convolution = embeddings.patch_embeddings.projection
        grid = tuple((edge - self.config.patch_size) // self._stride + 1 for edge in batch.shape[2:])
        before = convolution.stride, embeddings.interpolate_pos_encoding
        convolution.stride = (self._stride, self._stride)
        embeddings.interpolate_pos_encoding = lambda *_: self.positions(*grid)
        try:
            self._model(batch, **({"interpolate_pos_encoding": True} if self.config.model_type == "vit" else {}))
        finally:
            convolution.stride, embeddings.interpolate_pos_encoding = before
            for hook in hooks:
                hook.remove()
        special = 1 + getattr(self.config, "num_register_tokens", 0)
        heads = self.config.num_attention_heads
        query, key = (seen[name].unflatten(2, (heads, -1)).transpose(1, 2) for name in ("query", "key"))
        attention = torch.softmax(query[:, :, :1] @ key.transpose(2, 3) / math.sqrt(key.shape[3]), dim=3)
        salient = DINO_SALIENT_HEADS if heads == 6 else range(heads)
        saliency = attention[0, list(salient), 0, special:].mean(dim=0)
        saliency = (saliency - saliency.min()) / (saliency.max() - saliency.min()).clamp_min(1e-12)
        wanted = seen["wanted"]
        if facet != "token":
            wanted = wanted.unflatten(2, (heads, -1)).transpose(2, 3).flatten(2)  # heads innermost, as the reference
        return wanted[0, special:].reshape(*grid, -1), saliency.reshape(grid)

    def positions(self, rows: int, cols: int) -> torch.Tensor:
        """Position encodings ``(1, 1 + rows · cols, D)``, interpolated from the trained grid."""
        table = self._model.embeddings.position_embeddings
        side = math.isqrt(table.shape[1] - 1)
        if (rows, cols) == (side, side):
            return table
        square = table[:, 1:].reshape(1, side, side, -1).permute(0, 3, 1, 2)
        if self.config.model_type == "vit":
            # By scale factor, as in DINO: the offset shifts every sample, and the weights were trained with it.
            scale = ((rows + POSITION_OFFSET) / side, (cols + POSITION_OFFSET) / side)
            dense = F.interpolate(square, scale_factor=scale, mode="bicubic", recompute_scale_factor=False)
        else:
            antialias = self.config.model_type == "dinov2_with_registers"
            dense = F.interpolate(square, size=(rows, cols), mode="bicubic", antialias=antialias)
        return torch.cat([table[:, :1], dense.permute(0, 2, 3, 1).reshape(1, rows * cols, -1)], dim=1)


def _projection(layer: torch.nn.Module, facet: str) -> torch.nn.Module:
    """A linear layer of a layer's attention; its name differs between `transformers` 4 and 5."""
    return next(module for name, module in layer.named_modules() if name.split(".")[-1] in PROJECTIONS[facet])


class VitDescriptors:
    """The paper's descriptors: a facet of one layer over log bins, with saliency from the class token."""

    def __init__(self, checkpoint: VitCheckpoint, settings: DescriptorSettings):
        self.name = settings.model
        self.salient = settings.saliency_threshold
        self._settings = settings
        self._network = VisionTransformer(checkpoint.model, settings.stride)
        self._mean = np.array(checkpoint.mean, dtype=np.float32)
        self._deviation = np.array(checkpoint.deviation, dtype=np.float32)

    def prepare(self, rgb: NDArray[np.uint8]) -> torch.Tensor:
        """The normalised image ``(1, 3, h, w)``, its shorter edge `DescriptorSettings.load_size` (Lanczos)."""
        height, width = rgb.shape[:2]
        shorter, size = min(height, width), self._settings.load_size
        loaded = Image.fromarray(rgb).resize(
            (size * width // shorter, size * height // shorter), Image.Resampling.LANCZOS
        )
        pixels = (np.asarray(loaded, dtype=np.float32) / 255 - self._mean) / self._deviation
        return torch.from_numpy(pixels).permute(2, 0, 1)[None]

    def describe(self, rgb: NDArray[np.uint8]) -> DescriptorMap:
        settings, patch = self._settings, self._network.config.patch_size
        batch = self.prepare(rgb)
        features, saliency = self._network.features(batch, settings.layer, settings.facet)
        shrink = np.array([rgb.shape[1] / batch.shape[3], rgb.shape[0] / batch.shape[2]])
        return DescriptorMap(
            features.numpy(),
            saliency.numpy(),
            origin=patch / 2 * shrink - 0.5,
            step=settings.stride * shrink,
            log_bins=settings.log_bins,
        )
