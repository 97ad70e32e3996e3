"""Draws the README's picture of a run: python scripts/readme_picture.py runs/push-cube-0 docs/images/push-cube.gif"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from robust_instant_policy import Observation, Plan
from robust_instant_policy.datasets.video import decode_video
from robust_instant_policy.geometry import project
from robust_instant_policy.reporting.charts import candidate_colour
from robust_instant_policy.reporting.pictures import keypoint_colour

HEIGHT = 360  # pixels
EVERY = 2  # of the video's frames
FRAME_MS = 145  # twice the frames' interval, because every second frame is used
COLOURS = 256


def seen_and_proposed(folder: Path) -> Image.Image:
    """The camera image with numbered keypoints, the proposals, and the robust trajectory in white."""
    observation, plan = Observation.load(folder / "observation.npz"), Plan.load(folder / "plan.json")
    zoom = HEIGHT / observation.rgb.shape[0]
    image = Image.fromarray(observation.rgb).resize((HEIGHT, HEIGHT), Image.Resampling.BICUBIC)
    draw = ImageDraw.Draw(image)

    def path(trajectory, colour, width):
        pixels = (project(trajectory.tool_points[:, 0], observation.intrinsics, observation.camera_pose) + 0.5) * zoom
        draw.line([tuple(pixel) for pixel in pixels], fill=colour, width=width, joint="curve")

    for index, candidate in enumerate(plan.candidates):
        path(candidate, candidate_colour(plan, index), 1)
    path(plan.trajectory, "white", 4)
    font = ImageFont.load_default(size=11)
    for index, pixel in enumerate((plan.pixels + 0.5) * zoom):
        u, v = pixel
        draw.ellipse((u - 7, v - 7, u + 7, v + 7), fill=keypoint_colour(index), outline="black")
        draw.text((u, v), str(index), fill="black", font=font, anchor="mm")
    return image


def main(folder: Path, out: Path) -> None:
    left = seen_and_proposed(folder)
    frames = []
    for index, frame in enumerate(decode_video(folder / "execution.mp4")):
        if index % EVERY == 0:
            right = Image.fromarray(frame)
            right = right.resize((round(right.width * HEIGHT / right.height), HEIGHT))
            frames.append(Image.fromarray(np.hstack([np.asarray(left), np.asarray(right)])))
    palette = frames[len(frames) // 2].quantize(COLOURS, Image.Quantize.MAXCOVERAGE)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    out.parent.mkdir(parents=True, exist_ok=True)
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0, optimize=True)
    print(f"{out}: {len(frames)} frames, {out.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
