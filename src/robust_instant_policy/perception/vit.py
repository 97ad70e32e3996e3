"""Descriptors and saliency of a vision transformer (Amir et al. 2022, "Deep ViT Features as Dense Visual Descriptors").

One pass through the network gives both: keys of one layer as descriptors, and the attention that the class token pays
to each patch in the last layer as saliency. Only that one row of the last layer's attention is ever computed, and
the other layers' attention is never stored, so memory stays linear in the number of patches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from PIL import Image

from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.perception.descriptors import DescriptorMap
from robust_instant_policy.perception.settings import FACETS, DescriptorSettings
from robust_instant_policy.perception.vit_checkpoint import VitCheckpoint

POSITION_OFFSET = 0.1  # DINO adds it to the grid before interpolating positions, against rounding
DINO_SALIENT_HEADS = (0, 2, 4, 5)  # of ViT-S's six; the reference averages these (Amir et al. 2022)


@dataclass(frozen=True, eq=False)
class VitFeatures:
    """``descriptors (rows, cols, D)`` of one facet, before binning; ``saliency (rows, cols)`` scaled to [0, 1]."""

    descriptors: torch.Tensor
    saliency: torch.Tensor


class VisionTransformer:
    """A frozen vision transformer whose patches may overlap.

    ``stride`` divides the patch size; position encodings are interpolated onto the denser grid.
    """

    def __init__(self, checkpoint: VitCheckpoint, stride: int):
        config = checkpoint.config
        if stride < 1 or config.patch_size % stride:
            raise InvalidValueError(f"stride {stride} must divide the patch size {config.patch_size}")
        self.config = config
        self.stride = stride
        self._tensors = checkpoint.tensors

    @torch.inference_mode()
    def features(self, batch: torch.Tensor, layer: int, facet: str) -> VitFeatures:
        """Descriptors and saliency of one normalised image, ``batch (1, 3, H, W)``."""
        config = self.config
        if not 0 <= layer < config.num_hidden_layers:
            raise InvalidValueError(f"layer must be 0 to {config.num_hidden_layers - 1}, got {layer}")
        if facet not in FACETS:
            raise InvalidValueError(f"facet must be one of {', '.join(FACETS)}, got {facet!r}")
        tokens, grid = self._embed(batch)
        last = config.num_hidden_layers - 1
        wanted: torch.Tensor | None = None
        for index in range(last):
            if index == layer and facet != "token":
                wanted = self._heads(index, tokens, facet)
            tokens = self._block(index, tokens)
            if index == layer and facet == "token":
                wanted = tokens
        query, key = self._heads(last, tokens[:, :1], "query"), self._heads(last, tokens, "key")
        attention = torch.softmax(query @ key.transpose(2, 3) / math.sqrt(query.shape[3]), dim=3)
        if wanted is None:
            wanted = self._block(last, tokens) if facet == "token" else self._heads(last, tokens, facet)
        if facet != "token":
            wanted = wanted.permute(0, 2, 3, 1).flatten(2)  # the reference's order: heads innermost
        special = 1 + config.num_register_tokens
        heads = DINO_SALIENT_HEADS if config.num_attention_heads == 6 else range(config.num_attention_heads)
        saliency = attention[0, list(heads), 0, special:].mean(dim=0)
        saliency = (saliency - saliency.min()) / (saliency.max() - saliency.min()).clamp_min(1e-12)
        return VitFeatures(wanted[0, special:].reshape(*grid, -1), saliency.reshape(grid))

    def _embed(self, batch: torch.Tensor) -> tuple[torch.Tensor, tuple[int, int]]:
        weights = self._tensors
        patches = F.conv2d(
            batch,
            weights["embeddings.patch_embeddings.projection.weight"],
            weights["embeddings.patch_embeddings.projection.bias"],
            stride=self.stride,
        )
        rows, cols = patches.shape[2:]
        positions = self._positions(rows, cols)
        tokens = torch.cat([weights["embeddings.cls_token"], patches.flatten(2).transpose(1, 2)], dim=1) + positions
        if self.config.num_register_tokens:
            tokens = torch.cat([tokens[:, :1], weights["embeddings.register_tokens"], tokens[:, 1:]], dim=1)
        return tokens, (rows, cols)

    def _positions(self, rows: int, cols: int) -> torch.Tensor:
        """Position encodings ``(1, 1 + rows · cols, D)`` for a denser or larger grid than the trained one."""
        table = self._tensors["embeddings.position_embeddings"]
        side = math.isqrt(table.shape[1] - 1)
        if (rows, cols) == (side, side):
            return table
        square = table[:, 1:].reshape(1, side, side, -1).permute(0, 3, 1, 2)
        if self.config.model_type == "vit":
            # By scale factor, as DINO does it: the offset shifts every sample a little, and the weights expect that.
            scale = ((rows + POSITION_OFFSET) / side, (cols + POSITION_OFFSET) / side)
            dense = F.interpolate(square, scale_factor=scale, mode="bicubic", recompute_scale_factor=False)
        else:
            antialias = self.config.model_type == "dinov2_with_registers"
            dense = F.interpolate(square, size=(rows, cols), mode="bicubic", antialias=antialias)
        return torch.cat([table[:, :1], dense.permute(0, 2, 3, 1).reshape(1, rows * cols, -1)], dim=1)

    def _linear(self, name: str, x: torch.Tensor) -> torch.Tensor:
        return F.linear(x, self._tensors[f"{name}.weight"], self._tensors.get(f"{name}.bias"))

    def _norm(self, name: str, x: torch.Tensor) -> torch.Tensor:
        weight, bias = self._tensors[f"{name}.weight"], self._tensors[f"{name}.bias"]
        return F.layer_norm(x, weight.shape, weight, bias, self.config.layer_norm_eps)

    def _heads(self, index: int, tokens: torch.Tensor, facet: str) -> torch.Tensor:
        """Queries, keys or values ``(1, heads, tokens, D / heads)`` of a block."""
        before = "layernorm_before" if self.config.model_type == "vit" else "norm1"
        block = f"encoder.layer.{index}"
        projected = self._linear(f"{block}.attention.attention.{facet}", self._norm(f"{block}.{before}", tokens))
        return projected.unflatten(2, (self.config.num_attention_heads, -1)).transpose(1, 2)

    def _block(self, index: int, tokens: torch.Tensor) -> torch.Tensor:
        """Output of a block ``(1, tokens, D)``."""
        block = f"encoder.layer.{index}"
        query, key, value = (self._heads(index, tokens, facet) for facet in ("query", "key", "value"))
        mixed = F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
        mixed = self._linear(f"{block}.attention.output.dense", mixed)
        if self.config.model_type == "vit":
            tokens = tokens + mixed
            inner = F.gelu(self._linear(f"{block}.intermediate.dense", self._norm(f"{block}.layernorm_after", tokens)))
            return tokens + self._linear(f"{block}.output.dense", inner)
        tokens = tokens + mixed * self._tensors[f"{block}.layer_scale1.lambda1"]
        normed = self._norm(f"{block}.norm2", tokens)
        if self.config.swiglu:
            gate, inner = self._linear(f"{block}.mlp.weights_in", normed).chunk(2, dim=-1)
            out = self._linear(f"{block}.mlp.weights_out", F.silu(gate) * inner)
        else:
            out = self._linear(f"{block}.mlp.fc2", F.gelu(self._linear(f"{block}.mlp.fc1", normed)))
        return tokens + out * self._tensors[f"{block}.layer_scale2.lambda1"]


class VitDescriptors:
    """The paper's descriptors: a facet of one layer, gathered over log bins, with saliency from the class token."""

    def __init__(self, checkpoint: VitCheckpoint, settings: DescriptorSettings):
        self.name = settings.model
        self.salient = settings.saliency_threshold
        self._settings = settings
        self._network = VisionTransformer(checkpoint, settings.stride)
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
        features = self._network.features(batch, settings.layer, settings.facet)
        shrink = np.array([rgb.shape[1] / batch.shape[3], rgb.shape[0] / batch.shape[2]])
        return DescriptorMap(
            features.descriptors.numpy(),
            features.saliency.numpy(),
            origin=patch / 2 * shrink - 0.5,
            step=settings.stride * shrink,
            log_bins=settings.log_bins,
        )
