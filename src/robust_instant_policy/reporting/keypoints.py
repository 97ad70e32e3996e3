"""A self-contained page that shows where the keypoints are: in every demonstration and in new scenes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import project
from robust_instant_policy.perception import Accuracy, KeypointExtractor
from robust_instant_policy.reporting.pages import render
from robust_instant_policy.reporting.pictures import Picture, keypoint_colour, keypoint_marks, picture


def keypoints_page(
    extractor: KeypointExtractor,
    demonstrations: Sequence[Observation],
    scenes: Sequence[Observation] = (),
    accuracy: Accuracy | None = None,
    title: str = "Keypoints",
) -> str:
    """HTML of a fitted ``extractor``: its ``demonstrations`` with the numbered keypoints of each, and new ``scenes``
    with what it locates there (circles: the true positions, where ``accuracy`` knows them).
    """
    pairs = zip(demonstrations, extractor.pixels_, strict=True)
    return render(
        "keypoints.html",
        title=title,
        notes=extractor.notes_,
        summary="" if accuracy is None else accuracy.summary(),
        demonstrations=[
            picture(observation.rgb, f"demonstration {index}", marks=keypoint_marks(pixels))
            for index, (observation, pixels) in enumerate(pairs)
        ],
        scenes=[_scene(extractor, observation, index, accuracy) for index, observation in enumerate(scenes)],
        errors=[] if accuracy is None else _errors(accuracy),
    )


def _scene(extractor: KeypointExtractor, observation: Observation, index: int, accuracy: Accuracy | None) -> Picture:
    located = extractor.locate(observation) if accuracy is None else accuracy.located[index]
    caption = f"scene {index}: confidence {located.confidence.min():.2f} to {located.confidence.max():.2f}"
    truth = None
    if accuracy is not None:
        truth = project(accuracy.truth[index], observation.intrinsics, observation.camera_pose)
        if np.isfinite(accuracy.errors[index]).any():
            caption += f", median error {1000 * np.nanmedian(accuracy.errors[index]):.1f} mm"
    caption = "; ".join((caption, *located.notes))
    return picture(observation.rgb, caption, marks=keypoint_marks(located.pixels, located.confidence, truth))


def _errors(accuracy: Accuracy) -> list[tuple[str, str, str, str]]:
    """Colour, part, median and 90th percentile of the error in mm of each keypoint."""
    rows = []
    for index, part in enumerate(accuracy.part_of):
        errors = 1000 * accuracy.errors[:, index]
        numbers = (f"{np.nanmedian(errors):.1f}", f"{np.nanpercentile(errors, 90):.1f}") if part else ("", "")
        rows.append((keypoint_colour(index), part or "background", *numbers))
    return rows
