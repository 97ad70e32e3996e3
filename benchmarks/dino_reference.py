"""Compares the descriptors with those of the public reference implementation.

    git clone https://github.com/ShirAmir/dino-vit-features
    python benchmarks/dino_reference.py dino-vit-features

Loads one random ViT-S/8 into both, describes one image with both for each column of the paper's Table II, and
writes the largest differences to the terminal and to `docs/tables/dino_reference.md`. The reference needs timm and
torchvision only to download weights and read files, so empty modules replace them where they are not installed.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import types
from pathlib import Path

import numpy as np
import torch
import transformers
from torch import nn

from robust_instant_policy.perception.settings import PAPER_REAL, PAPER_SIMULATION, DescriptorSettings
from robust_instant_policy.perception.vit import VitDescriptors
from robust_instant_policy.perception.vit_checkpoint import VitCheckpoint

TABLE = Path(__file__).parent.parent / "docs" / "tables" / "dino_reference.md"
MIN_COSINE = 0.9999
MAX_SALIENCY_DIFFERENCE = 1e-4
COLUMNS = {"simulation": (PAPER_SIMULATION, (100, 100)), "real": (PAPER_REAL, (240, 320))}
VIT_S8 = transformers.ViTConfig(
    hidden_size=384, num_hidden_layers=12, num_attention_heads=6, intermediate_size=1536, patch_size=8, image_size=224
)


def random_checkpoint(seed: int, config: transformers.ViTConfig = VIT_S8) -> VitCheckpoint:
    """Weights large enough that attention is far from uniform and descriptors differ between patches."""
    generator = torch.Generator().manual_seed(seed)
    model = transformers.ViTModel(config, add_pooling_layer=False).eval().requires_grad_(False)
    for name, tensor in model.named_parameters():
        noise = torch.randn(tensor.shape, generator=generator)
        tensor.copy_(1 + 0.1 * noise if "norm" in name and name.endswith("weight") else 0.06 * noise)
    return VitCheckpoint(model)


class ReferenceAttention(nn.Module):
    """Attention with the module names that the reference hooks."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.num_heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.attn_drop = nn.Identity()
        self.proj = nn.Linear(width, width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        query, key, value = self.qkv(x).unflatten(2, (3, self.num_heads, -1)).permute(2, 0, 3, 1, 4)
        weights = self.attn_drop((query @ key.transpose(2, 3) / query.shape[3] ** 0.5).softmax(dim=3))
        return self.proj((weights @ value).transpose(1, 2).flatten(2))


class ReferenceBlock(nn.Module):
    def __init__(self, config: transformers.ViTConfig):
        super().__init__()
        width = config.hidden_size
        self.norm1, self.norm2 = (nn.LayerNorm(width, eps=config.layer_norm_eps) for _ in range(2))
        self.attn = ReferenceAttention(width, config.num_attention_heads)
        self.mlp = nn.Sequential(
            nn.Linear(width, config.intermediate_size), nn.GELU(), nn.Linear(config.intermediate_size, width)
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = x + self.attn(self.norm1(x))
        return x + self.mlp(self.norm2(x))


class ReferenceTransformer(nn.Module):
    """A plain ViT in DINO's naming, which the reference's extractor patches for its stride."""

    def __init__(self, checkpoint: VitCheckpoint):
        super().__init__()
        config, tensors = checkpoint.model.config, checkpoint.model.state_dict()
        self.patch_embed = nn.Module()
        self.patch_embed.patch_size = config.patch_size
        self.patch_embed.proj = nn.Conv2d(3, config.hidden_size, config.patch_size, config.patch_size)
        self.blocks = nn.ModuleList(ReferenceBlock(config) for _ in range(config.num_hidden_layers))
        renamed = {}
        for kind in ("weight", "bias"):
            renamed[f"patch_embed.proj.{kind}"] = tensors[f"embeddings.patch_embeddings.projection.{kind}"]
            for i in range(config.num_hidden_layers):
                theirs, ours = f"blocks.{i}.", f"layers.{i}."
                renamed[f"{theirs}attn.qkv.{kind}"] = torch.cat(
                    [tensors[f"{ours}attention.{facet}_proj.{kind}"] for facet in "qkv"]
                )
                renamed[f"{theirs}attn.proj.{kind}"] = tensors[f"{ours}attention.o_proj.{kind}"]
                renamed[f"{theirs}norm1.{kind}"] = tensors[f"{ours}layernorm_before.{kind}"]
                renamed[f"{theirs}norm2.{kind}"] = tensors[f"{ours}layernorm_after.{kind}"]
                renamed[f"{theirs}mlp.0.{kind}"] = tensors[f"{ours}mlp.fc1.{kind}"]
                renamed[f"{theirs}mlp.2.{kind}"] = tensors[f"{ours}mlp.fc2.{kind}"]
        self.load_state_dict(renamed)
        self.pos_embed = tensors["embeddings.position_embeddings"]
        self.cls_token = tensors["embeddings.cls_token"]

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        height, width = image.shape[2:]
        patches = self.patch_embed.proj(image).flatten(2).transpose(1, 2)
        tokens = torch.cat([self.cls_token, patches], dim=1)
        tokens = tokens + self.interpolate_pos_encoding(tokens, height, width)
        for block in self.blocks:
            tokens = block(tokens)
        return tokens[:, 0]


def load_reference(checkout: Path) -> types.ModuleType:
    """The reference's ``extractor`` module, from a checkout."""
    source = checkout / "extractor.py"
    if not source.exists():
        raise SystemExit(f"{source} does not exist; pass a checkout of ShirAmir/dino-vit-features")
    if "timm" not in sys.modules and importlib.util.find_spec("timm") is None:
        sys.modules["timm"] = types.ModuleType("timm")
    if "torchvision" not in sys.modules and importlib.util.find_spec("torchvision") is None:
        stand_in, transforms = types.ModuleType("torchvision"), types.ModuleType("torchvision.transforms")
        stand_in.transforms = transforms  # type: ignore[attr-defined]
        sys.modules |= {"torchvision": stand_in, "torchvision.transforms": transforms}
    spec = importlib.util.spec_from_file_location("reference_extractor", source)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_image(height: int, width: int) -> np.ndarray:
    """Smooth colours with edges in them ``(height, width, 3)`` uint8."""
    rows, cols = np.indices((height, width))
    waves = np.stack([np.sin(rows / 9 + cols / 31), np.cos(cols / 7), np.sin((rows + cols) / 23)], axis=2)
    waves[(rows - height / 2) ** 2 + (cols - width / 2) ** 2 < (height / 4) ** 2] *= -1
    return (127.5 + 127.5 * waves).astype(np.uint8)


def compare(reference: types.ModuleType, settings: DescriptorSettings, shape: tuple[int, int], seed: int) -> dict:
    """Worst cosine, largest differences, over every patch of one image."""
    checkpoint = random_checkpoint(seed)
    image = test_image(*shape)
    ours = VitDescriptors(checkpoint, settings)
    described = ours.describe(image)
    theirs = reference.ViTExtractor("dino_vits8", settings.stride, ReferenceTransformer(checkpoint), "cpu")
    batch = ours.prepare(image)
    with torch.inference_mode():
        expected = theirs.extract_descriptors(batch, settings.layer, settings.facet, settings.log_bins)[0, 0].numpy()
        saliency = theirs.extract_saliency_maps(batch)[0].numpy()
    vectors = described.vectors(np.arange(len(expected))).astype(np.float64)
    expected = expected.astype(np.float64)  # or rounding alone costs 2e-6 of the cosine
    lengths = np.linalg.norm(vectors, axis=1) * np.linalg.norm(expected, axis=1)
    return {
        "patches": len(expected),
        "dimensions": expected.shape[1],
        "worst cosine": float(((vectors * expected).sum(axis=1) / lengths).min()),
        "descriptor difference": float(np.abs(vectors - expected).max() / np.abs(expected).max()),
        "saliency difference": float(np.abs(described.saliency.reshape(-1) - saliency).max()),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path, help="a checkout of ShirAmir/dino-vit-features")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    reference = load_reference(arguments.checkout)
    held = True
    rows = [
        "| column | patches | dimensions | worst cosine | largest saliency difference |",
        "| --- | --- | --- | --- | --- |",
    ]
    for column, (settings, shape) in COLUMNS.items():
        result = compare(reference, settings, shape, arguments.seed)
        print(f"{column}: " + ", ".join(f"{name} {value:.8g}" for name, value in result.items()), flush=True)
        rows.append(
            f"| {column} | {result['patches']} | {result['dimensions']} | {result['worst cosine']:.6f} "
            f"| {result['saliency difference']:.1e} |"
        )
        held &= result["worst cosine"] >= MIN_COSINE and result["saliency difference"] <= MAX_SALIENCY_DIFFERENCE
    TABLE.write_text("\n".join(rows) + "\n")
    print(f"cosine >= {MIN_COSINE} and saliency within {MAX_SALIENCY_DIFFERENCE}: {'yes' if held else 'NO'}")
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
