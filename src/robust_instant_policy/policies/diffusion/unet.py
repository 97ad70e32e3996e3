"""The denoising network of Diffusion Policy, CNN version (Chi et al. 2023, Sec. III-B).

A 1-D U-Net over time. Every block gets the diffusion step and the observation by feature-wise modulation (Perez et al.
2018).
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from diffusers.models.embeddings import TimestepEmbedding, Timesteps
from diffusers.models.resnet import Downsample1D
from diffusers.models.upsampling import Upsample1D
from torch import Tensor, nn

KERNEL = 5
GROUPS = 8
STEP_CHANNELS = 128


class ConditionalUnet1D(nn.Module):
    """Predicts the clean version of ``noisy (B, T, channels)`` at diffusion ``steps (B,)``, given ``condition (B, C)``.

    ``widths`` are the channels at each resolution; T must be a multiple of `length_multiple`.
    """

    def __init__(self, channels: int, condition: int, widths: Sequence[int]):
        super().__init__()
        self.length_multiple = 2 ** (len(widths) - 1)
        self.embed_step = nn.Sequential(
            Timesteps(STEP_CHANNELS, flip_sin_to_cos=True, downscale_freq_shift=0),
            TimestepEmbedding(STEP_CHANNELS, 4 * STEP_CHANNELS, act_fn="mish", out_dim=STEP_CHANNELS),
        )
        known = STEP_CHANNELS + condition
        self.down = nn.ModuleList(_Level(before, after, known) for before, after in pairwise([channels, *widths]))
        self.shrink = nn.ModuleList(Downsample1D(width, use_conv=True) for width in widths[:-1])
        self.middle = _Level(widths[-1], widths[-1], known)
        self.grow = nn.ModuleList(Upsample1D(width, use_conv_transpose=True) for width in widths[:0:-1])
        self.up = nn.ModuleList(_Level(wide + thin, thin, known) for wide, thin in pairwise(widths[::-1]))
        self.out = nn.Sequential(_convolution(widths[0], widths[0]), nn.Conv1d(widths[0], channels, 1))

    def forward(self, noisy: Tensor, steps: Tensor, condition: Tensor) -> Tensor:
        known = torch.cat([self.embed_step(steps), condition], dim=-1)
        x = noisy.transpose(1, 2)
        skipped = []
        for level, shrink in zip(self.down[:-1], self.shrink, strict=True):
            x = level(x, known)
            skipped.append(x)
            x = shrink(x)
        x = self.middle(self.down[-1](x, known), known)
        for grow, level in zip(self.grow, self.up, strict=True):
            x = level(torch.cat([grow(x), skipped.pop()], dim=1), known)
        return self.out(x).transpose(1, 2)


class _Level(nn.Module):
    """Two residual blocks at one resolution."""

    def __init__(self, before: int, after: int, known: int):
        super().__init__()
        self.first, self.second = _Block(before, after, known), _Block(after, after, known)

    def forward(self, x: Tensor, known: Tensor) -> Tensor:
        return self.second(self.first(x, known), known)


class _Block(nn.Module):
    """Two convolutions with a residual connection; ``known (B, N)`` scales and shifts what is between them."""

    def __init__(self, before: int, after: int, known: int):
        super().__init__()
        self.enter, self.leave = _convolution(before, after), _convolution(after, after)
        self.modulate = nn.Sequential(nn.Mish(), nn.Linear(known, 2 * after))
        self.residual = nn.Conv1d(before, after, 1) if before != after else nn.Identity()

    def forward(self, x: Tensor, known: Tensor) -> Tensor:
        scale, shift = self.modulate(known)[..., None].chunk(2, dim=1)
        return self.leave(self.enter(x) * (1 + scale) + shift) + self.residual(x)


def _convolution(before: int, after: int) -> nn.Module:
    return nn.Sequential(nn.Conv1d(before, after, KERNEL, padding=KERNEL // 2), nn.GroupNorm(GROUPS, after), nn.Mish())
