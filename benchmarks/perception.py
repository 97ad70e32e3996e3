"""Perception in figures: how right, how fast, how much memory.

    python benchmarks/perception.py accuracy             # against the simulator's truth, all tasks
    python benchmarks/perception.py picture              # docs/images/keypoints.jpg
    python benchmarks/perception.py speed                # ratios to the bare network, in one run
    python benchmarks/perception.py speed --reference CHECKOUT    # beside ShirAmir/dino-vit-features

Writes `docs/tables/perception_accuracy.md` and `docs/tables/perception_speed.md`.
"""

from __future__ import annotations

import argparse
import gc
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from dino_reference import ReferenceTransformer, load_reference, random_checkpoint
from PIL import Image, ImageDraw
from safetensors.torch import save_file

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.perception import PAPER_REAL, PAPER_SIMULATION, KeypointExtractor, measure
from robust_instant_policy.perception.efficientnet import EfficientNetDescriptors
from robust_instant_policy.perception.settings import DescriptorSettings
from robust_instant_policy.perception.vit import VitDescriptors
from robust_instant_policy.perception.vit_checkpoint import load_checkpoint
from robust_instant_policy.tasks import TASK_NAMES, make_task
from robust_instant_policy.tasks.camera_noise import CameraNoise

TABLES = Path(__file__).parent.parent / "docs" / "tables"
DEMONSTRATIONS, NEW_SCENES = 10, 20
FIRST_NEW_SEED = 100_000  # demonstrations count from 0
REPETITIONS = 2
PICTURE_PX = 360
COLUMNS = {"simulation": (PAPER_SIMULATION, (100, 100)), "real": (PAPER_REAL, (240, 320))}


def accuracy(tasks: list[str]) -> None:
    rows = [
        "| task | camera | keypoints on moving objects | median error | 90th percentile |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name in tasks:
        task = make_task(name)
        images, truths = [], []
        for seed in [*range(DEMONSTRATIONS), *range(FIRST_NEW_SEED, FIRST_NEW_SEED + NEW_SCENES)]:
            images.append(task.reset(seed))
            truths.append(task.scene_truth())  # type: ignore[attr-defined]
        task.close()
        shown, new = slice(None, DEMONSTRATIONS), slice(DEMONSTRATIONS, None)
        for label, camera in (("perfect", None), ("noisy", CameraNoise().photograph)):
            seen = images[shown] if camera is None else [camera(o, 1000 + i) for i, o in enumerate(images[shown])]
            extractor = KeypointExtractor(features="efficientnet", workspace=task.workspace).fit(seen)
            found = measure(extractor, images[shown], truths[shown], images[new], truths[new], camera)
            row = f"| {name} | {label} | {found.on_object} of {len(found.part_of)} "
            rows.append(row + f"| {found.median * 1e3:.1f} mm | {found.worst_tenth * 1e3:.1f} mm |")
            print(rows[-1], flush=True)
    (TABLES / "perception_accuracy.md").write_text("\n".join(rows) + "\n")


def picture(name: str) -> None:
    """Keypoints of a task in two demonstrations (left) and two new scenes, `docs/images/keypoints.jpg`."""
    task = make_task(name)
    images = [task.reset(seed) for seed in [*range(DEMONSTRATIONS), FIRST_NEW_SEED, FIRST_NEW_SEED + 1]]
    task.close()
    extractor = KeypointExtractor(features="efficientnet", workspace=task.workspace).fit(images[:DEMONSTRATIONS])
    found = [*extractor.pixels_[:2], *(extractor.locate(image).pixels for image in images[DEMONSTRATIONS:])]
    sheet = Image.new("RGB", (len(found) * PICTURE_PX, PICTURE_PX))
    for column, (image, pixels) in enumerate(zip([*images[:2], *images[DEMONSTRATIONS:]], found, strict=True)):
        scale = PICTURE_PX / image.rgb.shape[1]
        tile = Image.fromarray(image.rgb).resize((PICTURE_PX, PICTURE_PX), Image.Resampling.LANCZOS)
        pen = ImageDraw.Draw(tile)
        for k, (u, v) in enumerate((pixels + 0.5) * scale):
            colour = f"hsv({360 * k // len(pixels)}, 80%, 100%)"
            pen.ellipse((u - 4, v - 4, u + 4, v + 4), fill=colour, outline="black")
            pen.text((u + 5, v - 12), str(k), fill="white", stroke_width=2, stroke_fill="black")
        sheet.paste(tile, (column * PICTURE_PX, 0))
    sheet.save(TABLES.parent / "images" / "keypoints.jpg", quality=85)


def best_time(work: Callable[[], object], repetitions: int = REPETITIONS) -> float:
    """Seconds of processor time, which other work on the machine hardly changes."""
    times = []
    for _ in range(repetitions):
        gc.collect()
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return min(times)


def tabletop(seed: int, shape: tuple[int, int]) -> Observation:
    """A raised block of two colours somewhere on a table, seen from 1 m above."""
    rng = np.random.default_rng(seed)
    height, width = shape
    rgb = np.full((height, width, 3), (150, 120, 95), dtype=np.uint8)
    depth = np.full(shape, 1.0, dtype=np.float32)
    row, col = (int(rng.integers(edge // 4, edge // 2)) for edge in shape)
    size = height // 5
    rgb[row : row + size, col : col + size] = (40, 90, 180)
    rgb[row : row + size // 2, col : col + size // 3] = (220, 200, 40)
    depth[row : row + size, col : col + size] = 0.95
    focal = height / 0.8
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    camera = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]])
    return Observation(rgb, depth, intrinsics, camera)


def measure_speed(
    features: str, settings: DescriptorSettings, shape: tuple[int, int], weights: str
) -> dict[str, float]:
    """Seconds of the bare network and of the whole work, on the same images in one process."""
    images = [tabletop(seed, shape) for seed in range(DEMONSTRATIONS + 1)]
    extractor = KeypointExtractor(features=weights if features == "dino" else features, settings=settings)
    if features == "dino":
        described = VitDescriptors(load_checkpoint(weights), settings)
        batch = described.prepare(images[0].rgb)
        tokens = described._network

        def bare() -> None:  # every block, whole
            with torch.inference_mode():
                state, _ = tokens._embed(batch)
                for index in range(tokens.config.num_hidden_layers):
                    state = tokens._block(index, state)
    else:
        network = EfficientNetDescriptors(settings)
        rows = cols = settings.load_size * 4 // settings.stride // 16 * 16
        cols = cols * shape[1] // shape[0] // 16 * 16
        batch = torch.zeros(1, 3, rows, cols)

        def bare() -> None:  # the classifier's whole network
            with torch.inference_mode():
                network._network(batch)

    one = best_time(bare)
    fit = best_time(lambda: extractor.fit(images[:DEMONSTRATIONS]), 1)
    locate = best_time(lambda: extractor.locate(images[-1]))
    return {"pass": one, "fit": fit, "locate": locate}


def speed_of_one(features: str, column: str, weights: str) -> None:
    """In a process of its own, so that its peak memory is its own."""
    settings, shape = COLUMNS[column]
    found = measure_speed(features, settings, shape, weights)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(found["pass"], found["fit"], found["locate"], peak)


def reference_time(checkout: Path, settings: DescriptorSettings, shape: tuple[int, int], weights: str) -> float:
    """Seconds in which the reference describes one image: two passes and its loops over patches."""
    theirs = load_reference(checkout)
    checkpoint = load_checkpoint(weights)
    extractor = theirs.ViTExtractor("dino_vits8", settings.stride, ReferenceTransformer(checkpoint), "cpu")
    batch = VitDescriptors(checkpoint, settings).prepare(tabletop(0, shape).rgb)

    def describe() -> None:
        with torch.inference_mode():
            extractor.extract_descriptors(batch, settings.layer, settings.facet, settings.log_bins)
            extractor.extract_saliency_maps(batch)

    return best_time(describe, 1)


def speed(checkout: Path | None) -> None:
    rows = [
        "| features | column | one pass | 10 demonstrations / 10 passes | new observation / one pass | peak memory "
        "| reference, one image |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    one_thread = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        weights = str(Path(folder) / "model.safetensors")
        save_file(dict(random_checkpoint(0).tensors), weights)
        for column, (settings, shape) in COLUMNS.items():
            for features in ("dino", "efficientnet"):
                command = [sys.executable, __file__, "one", features, column, weights]
                output = subprocess.run(command, check=True, capture_output=True, text=True, env=one_thread).stdout
                one, fit, locate, peak = map(float, output.split())
                beside = "—"
                if checkout is not None and features == "dino":
                    beside = f"{reference_time(checkout, settings, shape, weights):.1f} s"
                row = (
                    f"| {features} | {column} | {one:.3f} s | {fit / (DEMONSTRATIONS * one):.2f} | {locate / one:.2f} "
                )
                rows.append(row + f"| {peak:.2f} GiB | {beside} |")
                print(rows[-1], flush=True)
                (TABLES / "perception_speed.md").write_text("\n".join(rows) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("accuracy").add_argument("--tasks", nargs="*", default=list(TASK_NAMES))
    commands.add_parser("picture").add_argument("--task", default="open-drawer")
    commands.add_parser("speed").add_argument("--reference", type=Path)
    one = commands.add_parser("one", help="(used by speed)")
    for name in ("features", "column", "weights"):
        one.add_argument(name)
    arguments = parser.parse_args()
    if arguments.command == "accuracy":
        accuracy([name for name in arguments.tasks if not name.startswith("aloha")])
    elif arguments.command == "picture":
        picture(arguments.task)
    elif arguments.command == "speed":
        speed(arguments.reference)
    else:
        speed_of_one(arguments.features, arguments.column, arguments.weights)


if __name__ == "__main__":
    main()
