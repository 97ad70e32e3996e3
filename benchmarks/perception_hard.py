"""Keypoints and their confidence in the hard scenes of the simulated tasks, against the simulator's truth.

Demonstrations and scenes are those of `rip eval --level hard`; a scene is measured once and kept as a row, so a run
that was stopped goes on. Delete the rows to measure anew.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from confidence import auroc

from robust_instant_policy.errors import KeypointError
from robust_instant_policy.evaluation.scenes import obtain_demonstrations, scene_seed
from robust_instant_policy.perception import CORRESPONDENCES, KeypointExtractor, measure
from robust_instant_policy.tasks import UNSEEN_TASKS, make_task
from robust_instant_policy.tasks.simulated_task import SimulatedTask

SYMMETRIES = {
    "goal": 72,
    "cube": 4,
    "bowl": 72,
}  # parts of which the image does not show by which of these turns they are turned
DEMONSTRATIONS = 10
RIGHT_M = 0.02  # greatest error of a keypoint that is right
Row = dict[str, Any]


def hard(tasks: list[str], split: str, correspondence: str, scenes: int, data: Path, rows: Path, table: Path) -> None:
    """Measure what ``rows`` lacks of ``tasks`` in so many ``scenes`` of a ``split``, and write the ``table`` of all its
    rows of these, of every correspondence.
    """
    seeds = [scene_seed(0, index, split) for index in range(scenes)]
    for name in tasks:
        own = {"split": split, "correspondence": correspondence, "task": name}
        known = {row["seed"] for row in _read(rows) if own.items() <= row.items()}
        for row in _measure(name, correspondence, [seed for seed in seeds if seed not in known], data):
            rows.parent.mkdir(parents=True, exist_ok=True)
            with rows.open("a") as file:
                file.write(json.dumps(own | row) + "\n")
    found = [row for row in _read(rows) if row["task"] in tasks and row["split"] == split]
    text = "\n".join(_table(found, tasks)) + "\n"
    table.write_text(text)
    print(text)


def _measure(name: str, correspondence: str, seeds: list[int], data: Path) -> Iterator[Row]:
    """A row for each of ``seeds``: names of the keypoints' moving parts, errors in metres, and confidence."""
    if not seeds:
        return
    task = make_task(name, level="hard")
    assert isinstance(task, SimulatedTask)
    demonstrations = obtain_demonstrations(task, data / name, DEMONSTRATIONS)
    images, truths = [], []
    for demonstration in demonstrations:
        assert demonstration.seed is not None
        task.reset(demonstration.seed)
        images.append(task.cell.photograph())
        truths.append(task.scene_truth())
    options = {"workspace": task.workspace, "correspondence": correspondence}
    extractor = KeypointExtractor(features="efficientnet", **options)
    extractor.fit([one.observation for one in demonstrations], [one.trajectory for one in demonstrations])
    task.close()
    task = make_task(name, objects="unseen" if name in UNSEEN_TASKS else "seen", level="hard")
    assert isinstance(task, SimulatedTask)
    for seed in seeds:
        seen = task.reset(seed)
        row: Row = {"seed": seed, "parts": [], "errors": [], "confidence": []}
        shown = [task.cell.photograph()], [task.scene_truth()]
        try:
            found = measure(extractor, images, truths, *shown, lambda _, __, seen=seen: seen, SYMMETRIES)
            row["parts"] = list(found.part_of)
            row["errors"] = [round(float(error), 5) for error in found.errors[0]]
            row["confidence"] = [round(float(one), 4) for one in found.located[0].confidence]
        except KeypointError as error:
            print(f"{name}, seed {seed}: {error}")
        yield row
    task.close()


def _read(rows: Path) -> list[Row]:
    return [json.loads(line) for line in rows.read_text().splitlines()] if rows.exists() else []


def _table(rows: list[Row], tasks: list[str]) -> list[str]:
    lines = [
        "| task | correspondence | scenes | keypoints on moving objects | within 20 mm | median error "
        "| 90th percentile | AUROC |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for (name, which), way in product([*((task, [task]) for task in tasks), ("all", tasks)], CORRESPONDENCES):
        chosen = [row for row in rows if row["task"] in which and row["correspondence"] == way and row["parts"]]
        if not any(row["parts"] and any(row["parts"]) for row in chosen):
            continue
        on = np.concatenate([[bool(part) for part in row["parts"]] for row in chosen])
        errors = np.concatenate([row["errors"] for row in chosen])[on]
        confidence = np.concatenate([row["confidence"] for row in chosen])[on]
        told = auroc(confidence, errors < RIGHT_M)
        count, right = f"{len(errors) / len(chosen):.1f} of {len(on) / len(chosen):.0f}", (errors < RIGHT_M).mean()
        lines.append(
            f"| {name} | {way} | {len(chosen)} | {count} | {right:.0%} "
            f"| {np.median(errors) * 1e3:.1f} mm | {np.percentile(errors, 90) * 1e3:.1f} mm "
            f"| {'—' if np.isnan(told) else f'{told:.2f}'} |"
        )
    return lines
