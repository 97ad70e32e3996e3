"""Descriptors and saliency of a vision transformer (Amir et al. 2022, "Deep ViT Features as Dense Visual Descriptors").

Descriptors are a facet of one layer, saliency the attention of the class token to each patch in the last layer.
`transformers` runs the model; this file adds overlapping patches and DINO's interpolation of position encodings.
"""

import math
from functools import partial
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


class VitDescriptors:
    """The paper's descriptors: a facet of one layer over log bins, with saliency from the class token.

    Raises `InvalidValueError` for ``settings`` with a stride, layer or facet that the model does not have.
    """

    def __init__(self, checkpoint: VitCheckpoint, settings: DescriptorSettings):
        self._model, self.config = checkpoint.model, checkpoint.model.config
        self._layers = [
            module for name, module in self._model.named_modules() if name.split(".")[-2:-1] in (["layers"], ["layer"])
        ]
        if settings.stride < 1 or self.config.patch_size % settings.stride:
            raise InvalidValueError(f"stride {settings.stride} must divide the patch size {self.config.patch_size}")
        if not 0 <= settings.layer < len(self._layers):
            raise InvalidValueError(f"layer must be 0 to {len(self._layers) - 1}, got {settings.layer}")
        if settings.facet not in FACETS:
            raise InvalidValueError(f"facet must be one of {', '.join(FACETS)}, got {settings.facet!r}")
        self.name = settings.model
        self.salient = settings.saliency_threshold
        self._settings = settings
        self._mean = np.array(checkpoint.mean, dtype=np.float32)
        self._deviation = np.array(checkpoint.deviation, dtype=np.float32)

    def describe(self, rgb: NDArray[np.uint8]) -> DescriptorMap:
        batch = self.prepare(rgb)
        features, saliency = self.features(batch)
        scale = np.array([rgb.shape[1] / batch.shape[3], rgb.shape[0] / batch.shape[2]])
        return DescriptorMap(
            features.numpy(),
            saliency.numpy(),
            origin=self.config.patch_size / 2 * scale - 0.5,
            step=self._settings.stride * scale,
            log_bins=self._settings.log_bins,
        )

    def prepare(self, rgb: NDArray[np.uint8]) -> torch.Tensor:
        """The normalised image ``(1, 3, h, w)``, its shorter edge `DescriptorSettings.load_size` (Lanczos)."""
        height, width = rgb.shape[:2]
        shorter, size = min(height, width), self._settings.load_size
        loaded = Image.fromarray(rgb).resize(
            (size * width // shorter, size * height // shorter), Image.Resampling.LANCZOS
        )
        pixels = (np.asarray(loaded, dtype=np.float32) / 255 - self._mean) / self._deviation
        return torch.from_numpy(pixels).permute(2, 0, 1)[None]

    @torch.inference_mode()
    def features(self, batch: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Descriptors ``(rows, cols, D)`` and saliency ``(rows, cols)`` in [0, 1] of one image, ``(1, 3, h, w)``."""
        stride, facet = self._settings.stride, self._settings.facet
        chosen, last = self._layers[self._settings.layer], self._layers[-1]
        wanted = {
            "descriptors": chosen if facet == "token" else _projection(chosen, facet),
            "query": _projection(last, "query"),
            "key": _projection(last, "key"),
        }
        seen: dict[str, torch.Tensor] = {}

        def keep(name: str, _module: Any, _inputs: Any, output: Any) -> None:
            seen[name] = output[0] if isinstance(output, tuple) else output

        hooks = [module.register_forward_hook(partial(keep, name)) for name, module in wanted.items()]
        embeddings = self._model.embeddings
        convolution = embeddings.patch_embeddings.projection
        grid = tuple((edge - self.config.patch_size) // stride + 1 for edge in batch.shape[2:])
        before = convolution.stride, embeddings.interpolate_pos_encoding
        convolution.stride = (stride, stride)
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
        # Only the class token's row of the attention.
        attention = torch.softmax(query[:, :, :1] @ key.transpose(2, 3) / math.sqrt(key.shape[3]), dim=3)
        salient = DINO_SALIENT_HEADS if heads == 6 else range(heads)
        saliency = attention[0, list(salient), 0, special:].mean(dim=0)
        saliency = (saliency - saliency.min()) / (saliency.max() - saliency.min()).clamp_min(1e-12)
        descriptors = seen["descriptors"]
        if facet != "token":
            # The reference's order: heads innermost.
            descriptors = descriptors.unflatten(2, (heads, -1)).transpose(2, 3).flatten(2)
        return descriptors[0, special:].reshape(*grid, -1), saliency.reshape(grid)

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
