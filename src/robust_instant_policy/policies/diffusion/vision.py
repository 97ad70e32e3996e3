"""The image encoder of Diffusion Policy: a ResNet-18 from scratch with group norm and spatial softmax (Chi et al. 2023,
Sec. III-C; the spatial softmax is that of Levine et al. 2016)."""

import torch
from torch import Tensor, nn
from transformers import ResNetConfig, ResNetModel

CHANNELS_PER_GROUP = 16
POINTS = 32  # that the encoder follows through the image
STAGES = (64, 128, 256, 512)  # channels of ResNet-18


class ImageEncoder(nn.Module):
    """What is where in ``crops (B, 3, s, s)`` in [0, 1], as ``(B, 2·POINTS)`` places in [-1, 1].

    ``offsets (B, 2)`` say where the crops begin in images of ``size`` pixels, (row, column). Places are those in the
    whole image: otherwise random cropping would blur where things are.
    """

    features = 2 * POINTS

    def __init__(self, size: int):
        super().__init__()
        self.size = size
        config = ResNetConfig(hidden_sizes=list(STAGES), depths=[2, 2, 2, 2], layer_type="basic")
        self.network = _with_group_norm(ResNetModel(config))
        self.points = nn.Conv2d(STAGES[-1], POINTS, 1)

    def forward(self, crops: Tensor, offsets: Tensor) -> Tensor:
        maps = self.points(self.network(2 * crops - 1).last_hidden_state)
        attention = maps.flatten(2).float().softmax(dim=-1).unflatten(-1, maps.shape[2:])
        places = []
        for axis in range(2):
            count = maps.shape[2 + axis]
            middles = (torch.arange(count, device=crops.device) + 0.5) / count * crops.shape[2 + axis]  # pixels
            within = (attention.sum(dim=3 - axis) * middles).sum(dim=-1)
            places.append(2 * (within + offsets[:, axis, None]) / self.size - 1)
        return torch.cat(places, dim=-1)


def _with_group_norm(module: nn.Module) -> nn.Module:
    """``module`` with every batch norm replaced: its running statistics do not go with averaged weights."""
    for name, child in module.named_children():
        if isinstance(child, nn.BatchNorm2d):
            setattr(module, name, nn.GroupNorm(child.num_features // CHANNELS_PER_GROUP, child.num_features))
        else:
            _with_group_norm(child)
    return module
