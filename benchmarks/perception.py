"""Accuracy, processor time and memory of the keypoints.

    python benchmarks/perception.py accuracy             # against the simulator's truth, all tasks
    python benchmarks/perception.py hard                 # the same in hard scenes, with the confidence; resumable
    python benchmarks/perception.py missing              # one demonstration does not show the object
    python benchmarks/perception.py real DIR --out OUT   # photographs with outlines, see perception_real.py
    python benchmarks/perception.py picture              # docs/images/keypoints.jpg
    python benchmarks/perception.py scene-speed          # seconds, 640×480 pixels with six things
    python benchmarks/perception.py speed                # ratios to one pass of the network
    python benchmarks/perception.py speed --reference CHECKOUT    # beside ShirAmir/dino-vit-features
    python benchmarks/perception.py speed --features dino --columns real      # one line of the table

Writes `docs/tables/perception_accuracy.md`, `perception_hard.md`, `perception_missing.md` and `perception_speed.md`;
keeps each scene of the second in `results/perception_hard.jsonl` and each line of the last in
`results/perception_speed.json`.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path

import numpy as np
import torch
from dino_reference import ReferenceTransformer, load_reference, random_checkpoint
from perception_hard import hard
from perception_missing import missing
from perception_real import real
from PIL import Image, ImageDraw

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.evaluation.paper import TABLE1_TASKS
from robust_instant_policy.evaluation.scenes import SPLITS, obtain_demonstrations, scene_seed
from robust_instant_policy.evaluation.suites import SIMULATION_TASKS
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.perception import (
    CORRESPONDENCES,
    PAPER_REAL,
    PAPER_SIMULATION,
    KeypointExtractor,
    measure,
)
from robust_instant_policy.perception.accuracy import Accuracy
from robust_instant_policy.perception.descriptors import DescriptorNetwork
from robust_instant_policy.perception.efficientnet import load_network
from robust_instant_policy.perception.matching import register_all
from robust_instant_policy.perception.settings import DescriptorSettings
from robust_instant_policy.perception.view import make_view
from robust_instant_policy.perception.vit import VitDescriptors
from robust_instant_policy.perception.vit_checkpoint import load_checkpoint
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.camera_noise import CameraNoise
from robust_instant_policy.tasks.scene_truth import SceneTruth

ROOT = Path(__file__).parent.parent
TABLES, KEPT_SPEED = ROOT / "docs" / "tables", ROOT / "results" / "perception_speed.json"
KEPT_SCENE_SPEED = ROOT / "results" / "perception_scene_speed.json"
DEMONSTRATIONS, NEW_SCENES = 10, 20
FIRST_NEW_SEED = 100_000  # demonstrations count from 0
ROUNDS = {"dino": 1, "efficientnet": 15}  # of each measurement; the shortest counts
TIMED_SCENES = 10
MAX_MEMORY_GIB = 2.0
PICTURE_PX = 360
Camera = Callable[[Observation, int], Observation]
CAMERAS: dict[str, Camera | None] = {"perfect": None, "noisy": CameraNoise().photograph}
COLUMNS = {"simulation": (PAPER_SIMULATION, (100, 100)), "real": (PAPER_REAL, (240, 320))}


@dataclass(frozen=True)
class KnownScenes:
    """Images of a simulated task with their truth: `DEMONSTRATIONS`, then `NEW_SCENES`."""

    images: list[Observation]
    truths: list[SceneTruth]
    workspace: FloatArray

    @classmethod
    def of(cls, name: str) -> KnownScenes:
        task = make_task(name)
        images, truths = [], []
        for seed in [*range(DEMONSTRATIONS), *range(FIRST_NEW_SEED, FIRST_NEW_SEED + NEW_SCENES)]:
            images.append(task.reset(seed))
            truths.append(task.scene_truth())
        task.close()
        return cls(images, truths, task.workspace)

    def accuracy(
        self, features: str | DescriptorNetwork, camera: Camera | None, correspondence: str = "registration"
    ) -> Accuracy:
        """Accuracy in the new scenes, with all images through ``camera``."""
        shown, new = slice(None, DEMONSTRATIONS), slice(DEMONSTRATIONS, None)
        images, truths = self.images, self.truths
        seen = images[shown] if camera is None else [camera(o, 1000 + i) for i, o in enumerate(images[shown])]
        extractor = KeypointExtractor(features=features, workspace=self.workspace, correspondence=correspondence)
        extractor.fit(seen)
        return measure(extractor, images[shown], truths[shown], images[new], truths[new], camera)


def accuracy(tasks: list[str]) -> None:
    rows = [
        "| task | camera | correspondence | keypoints on moving objects | median error | 90th percentile |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name in tasks:
        scenes = KnownScenes.of(name)
        for (label, camera), correspondence in product(CAMERAS.items(), CORRESPONDENCES):
            found = scenes.accuracy("efficientnet", camera, correspondence)
            row = f"| {name} | {label} | {correspondence} | {found.on_object} of {len(found.part_of)} "
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


def processor_time(work: Callable[[], object]) -> float:
    """Seconds of processor time: less dependent on other work on the machine than wall time."""
    gc.collect()
    start = time.process_time()
    work()
    return time.process_time() - start


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


@dataclass(frozen=True)
class Speed:
    """Seconds of processor time: ``bare``, one pass of the network; ``fit`` of ten demonstrations; ``locate`` in a new
    image, and its stages ``describe``, ``segment`` and ``register``. ``peak_gib``: memory of the whole process.
    """

    bare: float
    fit: float
    locate: float
    describe: float
    segment: float
    register: float
    peak_gib: float


def measure_speed(features: str, settings: DescriptorSettings, shape: tuple[int, int], weights: str) -> Speed:
    """All measurements on the same images in one process."""
    images = [tabletop(seed, shape) for seed in range(DEMONSTRATIONS + 1)]
    extractor = KeypointExtractor(features=weights if features == "dino" else features, settings=settings)
    if features == "dino":
        network = VitDescriptors(load_checkpoint(weights), settings)
        batch = network.prepare(images[0].rgb)

        def bare() -> None:
            network.features(batch)
    else:
        classifier = load_network()
        rows, cols = (round(edge * settings.load_size / min(shape) * 4 / settings.stride / 16) * 16 for edge in shape)
        zeros = torch.zeros(1, 3, rows, cols)

        def bare() -> None:  # the whole classifier, as its package runs it
            with torch.inference_mode():
                classifier(zeros)

    fit = processor_time(lambda: extractor.fit(images[:DEMONSTRATIONS]))  # includes loading the weights
    view = make_view(images[-1], extractor.network_)
    work: dict[str, Callable[[], object]] = {
        "bare": bare,
        "locate": lambda: extractor.locate(images[-1]),
        "describe": lambda: extractor.network_.describe(images[-1].rgb),
        "segment": lambda: make_view(images[-1], extractor.network_),
        "register": lambda: register_all([thing.model for thing in extractor.objects_], view),
    }
    if features == "efficientnet":
        work["fit"] = lambda: extractor.fit(images[:DEMONSTRATIONS])
    rounds = ROUNDS[features]
    times = {"fit": fit} | {name: min(processor_time(one) for _ in range(rounds)) for name, one in work.items()}
    times["segment"] -= times["describe"]
    return Speed(**times, peak_gib=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)


def speed_of_one(features: str, column: str, weights: str) -> None:
    """Measure in a process of its own, for its peak memory."""
    settings, shape = COLUMNS[column]
    print(json.dumps(asdict(measure_speed(features, settings, shape, weights))))


def reference_time(checkout: Path, settings: DescriptorSettings, shape: tuple[int, int], weights: str) -> float:
    """Processor time, in seconds, of the reference for one image: two passes and its loops over patches."""
    theirs = load_reference(checkout)
    checkpoint = load_checkpoint(weights)
    extractor = theirs.ViTExtractor("dino_vits8", settings.stride, ReferenceTransformer(checkpoint), "cpu")
    batch = VitDescriptors(checkpoint, settings).prepare(tabletop(0, shape).rgb)

    def describe() -> None:
        with torch.inference_mode():
            extractor.extract_descriptors(batch, settings.layer, settings.facet, settings.log_bins)
            extractor.extract_saliency_maps(batch)

    return processor_time(describe)


def speed(features: list[str], columns: list[str], checkout: Path | None) -> None:
    one_thread = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        weights = folder
        random_checkpoint(0).model.save_pretrained(weights)
        for column in columns:
            for name in features:
                command = [sys.executable, __file__, "one", name, column, weights]
                output = subprocess.run(command, check=True, capture_output=True, text=True, env=one_thread).stdout
                found = json.loads(output)
                if checkout is not None and name == "dino":
                    found["reference"] = reference_time(checkout, *COLUMNS[column], weights)
                kept = json.loads(KEPT_SPEED.read_text()) if KEPT_SPEED.exists() else {}
                KEPT_SPEED.write_text(json.dumps(kept | {f"{name}, {column}": found}, indent=1) + "\n")
                print(f"{name}, {column}: {found}", flush=True)
    write_speed()


def scene_speed(name: str, data: Path) -> None:
    """Time of a fit to ten hard demonstrations with their paths and of a new scene, kept in `KEPT_SCENE_SPEED`."""
    task = make_task(name, level="hard")
    shown = obtain_demonstrations(task, data / name, DEMONSTRATIONS)
    new = [task.reset(scene_seed(0, index)) for index in range(TIMED_SCENES)]
    task.close()
    extractor = KeypointExtractor(features="efficientnet", workspace=task.workspace)
    watch = time.monotonic(), time.process_time()
    extractor.fit([one.observation for one in shown], [one.trajectory for one in shown])
    fitted = time.monotonic(), time.process_time()
    for scene in new:
        extractor.locate(scene)
    located = time.monotonic(), time.process_time()
    height, width = new[0].depth.shape
    found = {
        "task": name,
        "pixels": f"{width}x{height}",
        "objects": len(extractor.objects_),
        "load of the machine": round(os.getloadavg()[0], 1),
        "cores": os.cpu_count(),
    }
    for at, kind in enumerate(("wall", "processor")):
        found[f"fit, s of {kind} time"] = round(fitted[at] - watch[at], 2)
        found[f"new scene, s of {kind} time"] = round((located[at] - fitted[at]) / len(new), 3)
    KEPT_SCENE_SPEED.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


def write_speed() -> None:
    """Write the table from the kept measurements; exit with an error if one needs more than `MAX_MEMORY_GIB`."""
    rows = [
        "| features | column | bare pass | 10 demonstrations / 10 passes | new observation / pass "
        "| describe, segment, register | peak memory | reference, one image |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    too_large = []
    for name, values in sorted(json.loads(KEPT_SPEED.read_text()).items()):
        features, column = name.split(", ")
        reference = values.pop("reference", None)
        found = Speed(**values)
        fit, locate = found.fit / DEMONSTRATIONS / found.bare, found.locate / found.bare
        stages = ", ".join(f"{seconds * 1e3:.0f}" for seconds in (found.describe, found.segment, found.register))
        rows.append(
            f"| {features} | {column} | {found.bare * 1e3:.0f} ms | {fit:.2f} | {locate:.2f} | {stages} ms "
            f"| {found.peak_gib:.2f} GiB | {'—' if reference is None else f'{reference:.1f} s'} |"
        )
        if found.peak_gib > MAX_MEMORY_GIB:
            too_large.append(f"{name} needs {found.peak_gib:.2f} GiB")
    (TABLES / "perception_speed.md").write_text("\n".join(rows) + "\n")
    print("\n".join(rows))
    if too_large:
        sys.exit(f"more than {MAX_MEMORY_GIB:g} GiB: {'; '.join(too_large)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("accuracy").add_argument("--tasks", nargs="*", default=list(SIMULATION_TASKS))
    harder = commands.add_parser("hard")
    harder.add_argument("--tasks", nargs="*", default=list(TABLE1_TASKS))
    harder.add_argument("--split", choices=list(SPLITS), default="test", help="tune thresholds on the other one")
    harder.add_argument("--correspondence", choices=CORRESPONDENCES, default=CORRESPONDENCES[0])
    harder.add_argument("--scenes", type=int, default=NEW_SCENES)
    harder.add_argument("--data", type=Path, default=ROOT / "data" / "hard", help="folder of the demonstrations")
    harder.add_argument("--rows", type=Path, default=ROOT / "results" / "perception_hard.jsonl")
    harder.add_argument("--table", type=Path, default=TABLES / "perception_hard.md")
    gone = commands.add_parser("missing")
    gone.add_argument("--scenes", type=int, default=5)
    gone.add_argument("--data", type=Path, default=ROOT / "data" / "hard", help="folder of the demonstrations")
    commands.add_parser("picture").add_argument("--task", default="open-drawer")
    photographs = commands.add_parser("real")
    photographs.add_argument("folder", type=Path)
    photographs.add_argument("--out", type=Path, help="folder of the pictures (default: a new temporary one)")
    photographs.add_argument("--features", default="auto")
    photographs.add_argument("--keypoints", type=int, default=10)
    photographs.add_argument("--correspondence", choices=CORRESPONDENCES, default=CORRESPONDENCES[0])
    photographs.add_argument("--tilt", type=float, default=0.0, help="degrees by which the camera's pose is wrong")
    quick = commands.add_parser("speed")
    quick.add_argument("--reference", type=Path)
    quick.add_argument("--features", nargs="+", choices=list(ROUNDS), default=list(ROUNDS))
    quick.add_argument("--columns", nargs="+", choices=list(COLUMNS), default=list(COLUMNS))
    timed = commands.add_parser("scene-speed")
    timed.add_argument("--task", default="aloha-pick-place")
    timed.add_argument("--data", type=Path, default=ROOT / "data" / "hard", help="folder of the demonstrations")
    one = commands.add_parser("one", help="(used by speed)")
    for name in ("features", "column", "weights"):
        one.add_argument(name)
    arguments = parser.parse_args()
    if arguments.command == "accuracy":
        accuracy([name for name in arguments.tasks if not name.startswith("aloha")])
    elif arguments.command == "hard":
        settings = arguments.tasks, arguments.split, arguments.correspondence, arguments.scenes
        hard(*settings, arguments.data, arguments.rows, arguments.table)
    elif arguments.command == "missing":
        missing(arguments.data, arguments.scenes, TABLES / "perception_missing.md")
    elif arguments.command == "real":
        if not (arguments.folder / "pair.json").exists():
            parser.error(f"{arguments.folder} holds no pair.json; perception_real.py describes the folder")
        out = arguments.out or Path(tempfile.mkdtemp(prefix="keypoints-"))
        real(arguments.folder, out, arguments.features, arguments.keypoints, arguments.tilt, arguments.correspondence)
    elif arguments.command == "picture":
        picture(arguments.task)
    elif arguments.command == "scene-speed":
        scene_speed(arguments.task, arguments.data)
    elif arguments.command == "speed":
        speed(arguments.features, arguments.columns, arguments.reference)
    else:
        speed_of_one(arguments.features, arguments.column, arguments.weights)


if __name__ == "__main__":
    main()
