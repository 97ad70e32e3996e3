"""Keypoints where one demonstration does not show what the task is about: it is missing, hidden, or of another colour.

Demonstrations and new scenes are those of `perception_hard.py` (its scenes for tuning). In the image of one
demonstration the pixels of the object are replaced: by the table around it, by a plate 15 cm above it, or by its own in
other colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from perception_hard import DEMONSTRATIONS, RIGHT_M, SYMMETRIES
from scipy.ndimage import binary_dilation

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import KeypointError
from robust_instant_policy.evaluation.scenes import obtain_demonstrations, scene_seed
from robust_instant_policy.perception import KeypointExtractor, measure
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.scene_truth import SceneTruth

OBJECTS = {"pick-banana": "banana", "push-cube": "cube", "aloha-cup-upright": "cup"}
TABLES = ("mat", "table-top", "table-workspace")
KINDS = ("missing", "hidden", "recoloured")
CHANGED = (4, 0)  # the second one is the image that objects are usually taken from
PLATE_M = 0.15  # above the object
AROUND_PX = 25


def missing(data: Path, scenes: int, table: Path) -> None:
    """Measure in so many ``scenes`` of each of `OBJECTS`, and write the ``table``."""
    lines = [
        "| task | object is | in demonstration | left out | keypoints on it | within 20 mm | median error |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, part in OBJECTS.items():
        task = make_task(name, level="hard")
        shown = obtain_demonstrations(task, data / name, DEMONSTRATIONS)
        images, truths = zip(*(_known(task, one.seed) for one in shown), strict=True)
        new = [(task.reset(seed), *_known(task, seed)) for seed in (scene_seed(0, i) for i in range(scenes))]
        task.close()
        for index in CHANGED:
            for kind in KINDS:
                seen = [one.observation for one in shown]
                seen[index] = changed(seen[index], truths[index], part, kind)
                extractor = KeypointExtractor(features="efficientnet", workspace=task.workspace)
                try:
                    extractor.fit(seen, [one.trajectory for one in shown])
                except KeypointError as error:
                    lines.append(f"| {name} | {kind} | {index} | {error} | 0 of 10 | — | — |")
                    continue
                left_out = ", ".join(map(str, np.flatnonzero(extractor.left_out_))) or "none"
                extractor.left_out_[index] = True  # its image is not that of its truth any more
                observed, photographs, real = zip(*new, strict=True)
                camera = partial(_observed, observed)
                found = measure(extractor, images, truths, photographs, real, camera, SYMMETRIES)
                on = np.array([own == part for own in found.part_of])
                errors = found.errors[:, on]
                result = f"{(errors < RIGHT_M).mean():.0%} | {np.median(errors) * 1e3:.1f} mm" if on.any() else "— | —"
                lines.append(f"| {name} | {kind} | {index} | {left_out} | {on.sum()} of {len(on)} | {result} |")
                print(lines[-1], flush=True)
    table.write_text("\n".join(lines) + "\n")


def _observed(scenes: Sequence[Observation], _: Observation, number: int) -> Observation:
    """The noisy image of a scene."""
    return scenes[number]


def _known(task, seed: int) -> tuple[Observation, SceneTruth]:
    """What the perfect camera sees in the scene of ``seed``, and the truth."""
    task.reset(seed)
    return task.cell.photograph(), task.scene_truth()


def changed(seen: Observation, truth: SceneTruth, part: str, kind: str) -> Observation:
    """``seen`` with a ``part`` that is missing, hidden or recoloured."""
    own = truth.parts == truth.names.index(part)
    rgb, depth = seen.rgb.copy(), seen.depth.copy()
    if kind == "recoloured":
        rgb[own] = rgb[own][:, [2, 0, 1]]
        return replace(seen, rgb=rgb)
    own = binary_dilation(own, iterations=2)
    numbers = [-1, *(truth.names.index(name) for name in TABLES if name in truth.names)]
    beside = np.isin(truth.parts, numbers) & (depth > 0) & binary_dilation(own, iterations=AROUND_PX) & ~own
    plane = _inverse_depth_plane(beside, depth)
    rows, cols = np.nonzero(own)
    if kind == "missing":
        pick = np.random.default_rng(0).integers(0, beside.sum(), len(rows))
        rgb[own] = rgb[beside][pick]
        depth[own] = 1 / (np.stack([rows, cols, np.ones(len(rows))], axis=1) @ plane)
    else:
        rgb[own] = (120, 125, 130)
        depth[own] = np.nanmin(seen.depth[own & (seen.depth > 0)]) - PLATE_M
    return replace(seen, rgb=rgb, depth=depth)


def _inverse_depth_plane(where: NDArray[np.bool_], depth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Coefficients ``(3,)`` of row, column and 1 for the inverse depth of a plane through most of ``where``."""
    rows, cols = np.nonzero(where)
    terms, inverse = np.stack([rows, cols, np.ones(len(rows))], axis=1), 1 / depth[where]
    plane = np.linalg.lstsq(terms, inverse)[0]
    for _ in range(5):
        residual = np.abs(terms @ plane - inverse)
        near = residual <= np.quantile(residual, 0.8)
        plane = np.linalg.lstsq(terms[near], inverse[near])[0]
    return plane
