"""Keypoints in photographs: a folder with RGB-D images of one table whose objects were moved in between.

The folder holds ``pair.json``, and ``NAME-color.png`` and ``NAME-depth.png`` (16 bit) of each image. ``pair.json``:

    {"camera": {"fx", "fy", "cx", "cy", "depth_unit_m"}, "images": [NAME, ...],
     "objects": {OBJECT: {"outlines": [[[u, v], ...] of each image], "same_points": [[[u, v] in each image], ...]}}}

The camera's pose is not known; it is put so that the largest plane is horizontal.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.path import Path as Outline
from PIL import Image, ImageDraw

from robust_instant_policy.demonstration import Observation
from robust_instant_policy.geometry import FloatArray, lift, make_pose, rotations_about_vertical
from robust_instant_policy.perception import KeypointExtractor

OUTLINE_MARGIN_PX = 4.0  # by which outlines read off by eye may be too narrow
NEAR_PX = 5.0  # of a keypoint: same points this near have the greatest weight
RIGHT_PX = 30.0  # greatest error of a keypoint that is right
ON_PLANE_M = 0.008
PLANE_RANGE_M = (0.3, 1.4)
PLANE_SAMPLES = 500


@dataclass(frozen=True, eq=False)
class Photographs:
    """The ``observations`` of a folder; ``outlines`` of each object in each image and ``same_points (I, P, 2)`` of
    each object, pixels."""

    observations: tuple[Observation, ...]
    outlines: dict[str, list[Outline]]
    same_points: dict[str, FloatArray]

    @classmethod
    def load(cls, folder: Path, tilt_deg: float = 0.0) -> Photographs:
        described = json.loads((folder / "pair.json").read_text())
        observations = tuple(_observation(folder, name, described["camera"], tilt_deg) for name in described["images"])
        objects = described["objects"].items()
        return cls(
            observations,
            {name: [Outline(outline) for outline in one["outlines"]] for name, one in objects},
            {name: np.array(one["same_points"], dtype=np.float64).transpose(1, 0, 2) for name, one in objects},
        )

    def object_at(self, pixel: FloatArray, image: int) -> str:
        """Name of the object at ``pixel (2,)``, or nothing."""
        hit = (name for name, o in self.outlines.items() if o[image].contains_point(pixel, radius=OUTLINE_MARGIN_PX))
        return next(hit, "")

    def expected(self, pixel: FloatArray, name: str, image: int) -> FloatArray:
        """Where ``pixel (2,)`` of an object in the first image is in another: the similarity of the plane that maps
        the object's same points with the least squared error, near ones first.
        """
        source, target = self.same_points[name][0], self.same_points[name][image]
        weights = 1 / (NEAR_PX**2 + ((source - pixel) ** 2).sum(axis=1))
        weights /= weights.sum()
        from_mean, to_mean = weights @ source, weights @ target
        a, b = ((points - mean) @ (1, 1j) for points, mean in ((source, from_mean), (target, to_mean)))
        factor = (weights * a.conj() * b).sum() / max((weights * abs(a) ** 2).sum(), 1e-9) if len(source) > 1 else 1.0
        moved = factor * complex(*(pixel - from_mean))
        return to_mean + np.array([moved.real, moved.imag])


@dataclass(frozen=True, eq=False)
class Score:
    """``objects (I, K)`` names at the keypoints in each image; ``errors (I - 1, K)`` in pixels against the first image;
    ``pixels (I, K, 2)``.
    """

    objects: list[list[str]]
    errors: FloatArray
    pixels: FloatArray

    def lines(self) -> list[str]:
        """A line for each keypoint, and a summary."""
        first, others = self.objects[0], self.objects[1:]
        count = len(first)
        on = [all(image[k] for image in self.objects) for k in range(count)]
        same = [bool(first[k]) and all(image[k] == first[k] for image in others) for k in range(count)]
        right = [same[k] and self.errors[:, k].max() <= RIGHT_PX for k in range(count)]
        finite = self.errors[np.isfinite(self.errors)]
        median, worst = (np.median(finite), finite.max()) if len(finite) else (np.inf, np.inf)
        lines = [
            f"  {k}: {' -> '.join(image[k] or 'nothing' for image in self.objects)}, "
            f"{', '.join(f'{error:.0f}' for error in self.errors[:, k])} px"
            for k in range(count)
        ]
        covered = len({name for name, is_same in zip(first, same, strict=True) if is_same})
        return [
            *lines,
            f"  on an object {sum(on)} of {count}; same object {sum(same)}; right {sum(right)}; {covered} objects "
            f"covered; median {median:.1f} px, worst {worst:.0f} px",
        ]


def score(photographs: Photographs, pixels: FloatArray) -> Score:
    """Keypoints at ``pixels (I, K, 2)`` against what is known of the images."""
    objects = [[photographs.object_at(pixel, image) for pixel in row] for image, row in enumerate(pixels)]
    errors = np.full((len(pixels) - 1, pixels.shape[1]), np.inf)
    for image, k in np.ndindex(*errors.shape):
        if name := objects[0][k]:
            expected = photographs.expected(pixels[0, k], name, image + 1)
            errors[image, k] = np.linalg.norm(pixels[image + 1, k] - expected)
    return Score(objects, errors, pixels)


def real(folder: Path, out: Path, features: str, num_keypoints: int, tilt_deg: float, correspondence: str) -> None:
    """Score all images as demonstrations, then the first as the only one; write pictures to ``out``."""
    photographs = Photographs.load(folder, tilt_deg)
    images = photographs.observations
    start = time.process_time()
    extractor = KeypointExtractor(num_keypoints, features, correspondence=correspondence).fit(images)
    fitted = time.process_time()
    extractor.locate(images[-1])
    print(f"processor time: fit {fitted - start:.2f} s, new image {time.process_time() - fitted:.2f} s")
    alone = KeypointExtractor(num_keypoints, features, correspondence=correspondence).fit(images[:1])
    located = [alone.locate(image) for image in images[1:]]
    runs = {
        "all-demonstrations": extractor.pixels_,
        "one-demonstration": np.stack([alone.pixels_[0], *(one.pixels for one in located)]),
    }
    out.mkdir(parents=True, exist_ok=True)
    for name, pixels in runs.items():
        print(name, *score(photographs, pixels).lines(), sep="\n")
        sheet = np.concatenate([_marked(image, row) for image, row in zip(images, pixels, strict=True)], axis=1)
        Image.fromarray(sheet).save(out / f"{name}.png")
    print("confidence with one demonstration:", *(np.round(one.confidence, 2) for one in located))
    print(*extractor.notes_, f"pictures: {out}", sep="\n")


def _marked(image: Observation, pixels: FloatArray) -> np.ndarray:
    picture = Image.fromarray(image.rgb)
    pen = ImageDraw.Draw(picture)
    for k, (u, v) in enumerate(pixels):
        pen.ellipse((u - 5, v - 5, u + 5, v + 5), fill=f"hsv({360 * k // len(pixels)}, 90%, 100%)", outline="black")
        pen.text((u + 6, v - 12), str(k), fill="white", stroke_width=2, stroke_fill="black")
    return np.asarray(picture)


def _observation(folder: Path, name: str, camera: dict[str, float], tilt_deg: float) -> Observation:
    rgb = np.asarray(Image.open(folder / f"{name}-color.png").convert("RGB"))
    depth = np.asarray(Image.open(folder / f"{name}-depth.png")).astype(np.float32) * camera["depth_unit_m"]
    intrinsics = np.array([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1.0]])
    return Observation(rgb, depth, intrinsics, _pose_over_plane(depth, intrinsics, tilt_deg))


def _pose_over_plane(depth: np.ndarray, intrinsics: FloatArray, tilt_deg: float) -> FloatArray:
    """Camera pose whose world has its origin on the largest plane and z along its normal, tilted by ``tilt_deg``."""
    near, far = PLANE_RANGE_M
    pixels = np.argwhere((depth > near) & (depth < far))[::16, ::-1]
    points = lift(pixels, depth[pixels[:, 1], pixels[:, 0]], intrinsics, np.eye(4))
    corners = points[np.random.default_rng(0).integers(len(points), size=(PLANE_SAMPLES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    offsets = (normals * corners[:, 0]).sum(axis=1)
    on_plane = np.abs(points @ normals.T - offsets) < ON_PLANE_M
    best = on_plane.sum(axis=0).argmax()
    normal, centre = -normals[best] * np.sign(normals[best, 2]), points[on_plane[:, best]].mean(axis=0)
    x = np.array([1.0, 0, 0]) - normal * normal[0]
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(normal, x), normal])
    about_x = rotations_about_vertical(np.deg2rad(tilt_deg))[[2, 0, 1]][:, [2, 0, 1]]
    return make_pose(about_x @ rotation, -about_x @ rotation @ centre)
