"""Parameters of the descriptors; the paper's two columns by name (Oh et al. 2025, Table II)."""

from dataclasses import dataclass

FACETS = ("key", "query", "value", "token")
IMAGENET_MEAN = (0.485, 0.456, 0.406)  # of the colour channels in [0, 1], and their standard deviation
IMAGENET_DEVIATION = (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class DescriptorSettings:
    """Parameters of an image's descriptors.

    ``load_size``: the shorter edge of the loaded image in pixels. ``stride``: pixels of the loaded image between
    neighbouring patches, a divisor of the patch size. ``layer``: the transformer block, counted from 0.
    ``facet``: one of `FACETS`. ``log_bins``: include a patch's surroundings in its descriptor (Amir et al. 2022).
    ``saliency_threshold``, in [0, 1]: patches below it are background.
    ``model``: a name on the hub, a folder or a safetensors file.
    """

    load_size: int
    stride: int
    layer: int = 9
    facet: str = "key"
    log_bins: bool = True
    saliency_threshold: float = 0.15
    model: str = "facebook/dino-vits8"


PAPER_SIMULATION = DescriptorSettings(load_size=100, stride=2)
PAPER_REAL = DescriptorSettings(load_size=240, stride=4)
REAL_EDGE_PX = 480  # shorter edge from which an image is a real camera's; simulated images are smaller


def paper_settings(height: int, width: int) -> DescriptorSettings:
    """The paper's column for images of ``height`` and ``width`` pixels."""
    return PAPER_REAL if min(height, width) >= REAL_EDGE_PX else PAPER_SIMULATION
