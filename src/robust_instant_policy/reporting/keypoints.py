"""A self-contained page that shows where the keypoints are: in every demonstration and in new scenes."""

import colorsys
from collections.abc import Sequence

import numpy as np

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import project
from robust_instant_policy.perception import Accuracy, KeypointExtractor
from robust_instant_policy.perception.pieces import REASONS, TABLE
from robust_instant_policy.reporting.pages import render
from robust_instant_policy.reporting.pictures import Mark, Picture, keypoint_colour, keypoint_marks, picture

TINT = 0.45  # share of an object's colour
DARKENED = 0.35  # brightness of what was left out
MIN_TOLD_SHARE = 0.001  # of an image
GOLDEN = 0.618  # of the circle of hues, between objects: neighbours differ most


def keypoints_page(
    extractor: KeypointExtractor,
    demonstrations: Sequence[Observation],
    scenes: Sequence[Observation] = (),
    accuracy: Accuracy | None = None,
    title: str = "Keypoints",
) -> str:
    """HTML of a fitted ``extractor``: ``demonstrations`` with numbered keypoints, tinted objects, and the share of
    pixels that were left out and why; and ``scenes`` with the located keypoints (circles: true positions, if
    ``accuracy`` is given).
    """
    pairs = zip(demonstrations, extractor.pixels_, strict=True)
    return render(
        "keypoints.html",
        title=title,
        notes=extractor.notes_,
        summary="" if accuracy is None else accuracy.summary(),
        demonstrations=[
            _demonstration(extractor, observation, index, keypoint_marks(pixels))
            for index, (observation, pixels) in enumerate(pairs)
        ],
        objects=[
            (_colour(number), number, ", ".join(map(str, np.flatnonzero(extractor.object_of_ == number))) or "none")
            for number in range(len(extractor.objects_))
        ],
        scenes=[_scene(extractor, observation, index, accuracy) for index, observation in enumerate(scenes)],
        errors=[] if accuracy is None else _errors(accuracy),
    )


def _demonstration(extractor: KeypointExtractor, observation: Observation, index: int, marks: list[Mark]) -> Picture:
    """The image, its objects tinted, what was left out darkened; the caption says why."""
    caption = f"demonstration {index}"
    if not extractor.segmentations_:
        return picture(observation.rgb, caption, marks=marks)
    labels = extractor.segmentations_[index]
    tinted = observation.rgb.astype(np.float64)
    for number in range(len(extractor.objects_)):
        colour = [int(_colour(number)[at : at + 2], 16) for at in (1, 3, 5)]
        tinted[labels == number] = (1 - TINT) * tinted[labels == number] + TINT * np.array(colour)
    left_out = [(float((labels == reason).mean()), text) for reason, text in REASONS.items() if reason != TABLE]
    tinted[labels < TABLE] *= DARKENED
    told = [f"{share:.1%} {text}" for share, text in sorted(left_out, reverse=True) if share >= MIN_TOLD_SHARE]
    if told:
        caption += f"; left out: {', '.join(told)}"
    return picture(tinted.astype(np.uint8), caption, marks=marks)


def _colour(number: int) -> str:
    """Colour of an object; other than those of keypoints."""
    red, green, blue = colorsys.hsv_to_rgb((number * GOLDEN) % 1, 0.9, 1.0)
    return f"#{round(255 * red):02x}{round(255 * green):02x}{round(255 * blue):02x}"


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
