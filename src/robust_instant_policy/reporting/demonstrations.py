"""A self-contained page that shows every episode of a demonstrations folder."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from robust_instant_policy.datasets import layout
from robust_instant_policy.datasets.folder import open_folder, read_json
from robust_instant_policy.datasets.reader import load_demonstrations
from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.files import write_whole
from robust_instant_policy.geometry import FloatArray, project

MAX_POINTS = 240  # of a path that are drawn
JPEG_QUALITY = 88
COORDINATE_DIGITS = 4  # 0.1 mm
GRID_STEPS_M = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
GRID_LINES = 8  # about so many across the widest side
STRIP_WIDTH, STRIP_HEIGHT = 1000, 76  # of the strip over time, in its own units
NO_READING_COLOUR = (214, 214, 208)
# Dark blue to yellow, even steps of lightness (the anchors of matplotlib's viridis, a published colour map).
DEPTH_COLOURS = np.array([(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], dtype=np.float64)


class _Page(Template):
    delimiter = "%%"  # the page's own script is full of dollar signs


def write_page(path: str | Path, out: str | Path) -> Path:
    """Write a page on the demonstrations in the folder ``path`` to ``out`` and return that.

    It needs no network and no other file: start image and depth, the gripper's way over the image and in 3-D,
    its state and height over time, and the video where images were recorded.
    Raises `DatasetError` as `load_demonstrations` does.
    """
    demonstrations = load_demonstrations(path)
    videos = _videos(Path(path), len(demonstrations))
    recorded = read_json(Path(path) / layout.RIP_PATH)
    paths = np.concatenate([demo.trajectory.triplets.reshape(-1, 3) for demo in demonstrations])
    low, high = paths.min(axis=0), paths.max(axis=0)
    grid = next((step for step in GRID_STEPS_M if (high - low).max() <= step * GRID_LINES), GRID_STEPS_M[-1])
    data = {
        "bounds": np.round([low, high], COORDINATE_DIGITS).tolist(),
        "grid": grid,
        "episodes": [_episode_data(demo) for demo in demonstrations],
    }
    task = recorded["task"]
    page = _Page((files(__package__) / "page.html").read_text(encoding="utf-8")).substitute(
        title=html.escape(f"{task}: demonstrations"),
        heading=html.escape(str(task)),
        subtitle=html.escape(str(recorded.get("description", ""))),
        facts=_facts(demonstrations, len(recorded.get("discarded_seeds", [])), any(videos)),
        grid=f"{100 * grid:g} cm",
        episodes="\n".join(
            _card(number, demo, video) for number, (demo, video) in enumerate(zip(demonstrations, videos, strict=True))
        ),
        data=json.dumps(data, separators=(",", ":")).replace("</", "<\\/"),
    )
    out = Path(out)
    write_whole(out, page.encode())
    return out


def _videos(root: Path, count: int) -> list[bytes | None]:
    if layout.VIDEO_KEY not in open_folder(root).video_keys:
        return [None] * count
    paths = [root / layout.episode_path(layout.VIDEO_PATTERN, episode) for episode in range(count)]
    try:
        return [path.read_bytes() for path in paths]
    except OSError as error:
        raise DatasetError(f"{error.filename} cannot be read: restore it, or record the folder again") from error


def _episode_data(demo: Demonstration) -> dict[str, object]:
    """What the page draws in 3-D: for each arm its way, its gripper along it, and where that was closed."""
    steps = np.unique(np.linspace(0, len(demo.trajectory) - 1, MAX_POINTS).astype(np.intp))
    triplets = demo.trajectory.triplets[steps]
    closed = demo.trajectory.gripper_state[steps] > 0.5
    return {
        "seconds": demo.seconds,
        "arms": [
            {
                "points": np.round(_tool_points(triplets[:, arm]), COORDINATE_DIGITS).tolist(),
                "grippers": np.round(triplets[:, arm], COORDINATE_DIGITS).tolist(),
                "closed": closed[:, arm].astype(int).tolist(),
            }
            for arm in range(demo.trajectory.num_arms)
        ],
    }


def _tool_points(triplets: FloatArray) -> FloatArray:
    """Midpoints ``(T, 3)`` of the fingertips."""
    return triplets[:, 1:].mean(axis=1)


def _facts(demonstrations: Sequence[Demonstration], discarded: int, with_images: bool) -> str:
    seconds = [demo.seconds for demo in demonstrations]
    steps = [len(demo.trajectory) for demo in demonstrations]
    facts = {
        "episodes": f"{len(demonstrations)}",
        "attempts thrown away": f"{discarded}",
        "seconds each, shortest to longest": f"{min(seconds):.1f} – {max(seconds):.1f}",
        "steps each": f"{min(steps)} – {max(steps)}",
        "recording rate": f"{demonstrations[0].rate_hz:g} Hz",
        "images along the way": "yes" if with_images else "no",
    }
    return "".join(f"<li><b>{value}</b>{name}</li>" for name, value in facts.items())


def _card(number: int, demo: Demonstration, video: bytes | None) -> str:
    observation = demo.observation
    height, width = observation.rgb.shape[:2]
    depth, caption = _depth_picture(observation.depth)
    facts = [f"{demo.seconds:.2f} s", f"{len(demo.trajectory)} steps"]
    facts += [] if demo.seed is None else [f"seed {demo.seed}"]
    facts += [f"{name}: {value}" for name, value in demo.info.items()]
    space = '<canvas aria-label="path in 3-D"></canvas>'
    views = [
        (
            f'<img alt="start image" src="{_data_uri(_jpeg(observation.rgb), "image/jpeg")}">'
            f'<svg viewBox="0 0 {width} {height}">{_path_over_image(demo)}</svg>',
            "start image, with the way of the fingertips",
        ),
        (f'<img alt="start depth" src="{_data_uri(depth, "image/png")}">', caption),
        (space, "path in 3-D, and the gripper at the moment below"),
    ]
    if video is not None:
        views.append((f'<video controls muted playsinline src="{_data_uri(video, "video/mp4")}"></video>', "video"))
    figures = "".join(
        f'<figure><div class="{"frame space" if view is space else "frame"}" style="aspect-ratio:{width}/{height}">'
        f"{view}</div><figcaption>{caption}</figcaption></figure>"
        for view, caption in views
    )
    return (
        f'<section class="panel episode"><div class="head"><h2>Episode {number}</h2>'
        f'<span class="soft">{html.escape(" · ".join(facts))}</span></div><div class="views">{figures}</div>'
        f'<figure class="time">{_strip(demo)}<figcaption><span>gripper closed (filled) and height of the fingertips '
        f'(line, {_height_range(demo)}) over time; drag</span><span class="now"></span></figcaption></figure></section>'
    )


def _path_over_image(demo: Demonstration) -> str:
    """The fingertips' way as the camera of the start sees it, closed parts in the other colour."""
    observation = demo.observation
    size = observation.rgb.shape[1] / 320  # strokes as wide in small images as in large ones
    parts = []
    for arm in range(demo.trajectory.num_arms):
        points = _tool_points(demo.trajectory.triplets[:, arm])
        pixels = project(points, observation.intrinsics, observation.camera_pose) + 0.5
        for start, stop, closed in _runs(demo.trajectory.gripper_state[:, arm] > 0.5):
            line = " ".join(f"{u:.1f},{v:.1f}" for u, v in pixels[start : stop + 1])
            # White below the colour, so that the way stands out from any table.
            for colour, stroke in (("#fff", 5.0), (f"var(--{'closed' if closed else 'open'})", 2.6)):
                parts.append(
                    f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="{stroke * size:.2f}" '
                    'stroke-linejoin="round" stroke-linecap="round"/>'
                )
        (u, v), radius = pixels[0], 4 * size
        parts.append(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="{radius:.1f}" fill="var(--open)" stroke="#fff"/>')
    return "".join(parts)


def _strip(demo: Demonstration) -> str:
    """Gripper state and height of each arm over time, as one drawing."""
    count, arms = len(demo.trajectory), demo.trajectory.num_arms
    across = np.linspace(0, STRIP_WIDTH, count)
    share = STRIP_HEIGHT / arms
    parts = []
    for arm in range(arms):
        top, bottom = arm * share + 4, (arm + 1) * share - 2
        parts.append(f'<rect x="0" y="{top:.1f}" width="{STRIP_WIDTH}" height="{bottom - top:.1f}" fill="#f1f1ee"/>')
        for start, stop, closed in _runs(demo.trajectory.gripper_state[:, arm] > 0.5):
            if closed:
                parts.append(
                    f'<rect x="{across[start]:.1f}" y="{top:.1f}" width="{across[stop] - across[start]:.1f}" '
                    f'height="{bottom - top:.1f}" fill="var(--closed)" opacity="0.3"/>'
                )
        height = _tool_points(demo.trajectory.triplets[:, arm])[:, 2]
        scaled = (height - height.min()) / max(np.ptp(height), 1e-9)
        down = bottom - 4 - scaled * (bottom - top - 8)
        steps = np.unique(np.linspace(0, count - 1, MAX_POINTS).astype(np.intp))
        line = " ".join(f"{across[step]:.1f},{down[step]:.1f}" for step in steps)
        parts.append(
            f'<polyline points="{line}" fill="none" stroke="#333" stroke-width="1.8" '
            'vector-effect="non-scaling-stroke" stroke-linejoin="round"/>'
        )
    parts.append(
        f'<g class="needle"><line y1="0" y2="{STRIP_HEIGHT}" stroke="#111" stroke-width="2" '
        'vector-effect="non-scaling-stroke"/></g>'
    )
    return f'<svg viewBox="0 0 {STRIP_WIDTH} {STRIP_HEIGHT}" preserveAspectRatio="none">{"".join(parts)}</svg>'


def _height_range(demo: Demonstration) -> str:
    heights = demo.trajectory.triplets[:, :, 1:, 2].mean(axis=2)
    return f"{100 * heights.min():.1f} to {100 * heights.max():.1f} cm"


def _runs(closed: NDArray[np.bool_]) -> list[tuple[int, int, bool]]:
    """Stretches ``(first, last, closed)`` of one gripper state, each reaching to the start of the next."""
    starts = [0, *(np.flatnonzero(np.diff(closed)) + 1).tolist()]
    stops = [*starts[1:], len(closed) - 1]
    return [(start, stop, bool(closed[start])) for start, stop in zip(starts, stops, strict=True)]


def _depth_picture(depth: NDArray[np.float32]) -> tuple[bytes, str]:
    """PNG of ``depth (H, W)``, near dark and far bright, and its caption."""
    seen = np.isfinite(depth) & (depth > 0)
    if not seen.any():
        return _png(np.full((*depth.shape, 3), NO_READING_COLOUR, dtype=np.uint8)), "start depth: no reading at all"
    near, far = float(depth[seen].min()), float(depth[seen].max())
    share = np.where(seen, (np.nan_to_num(depth) - near) / max(far - near, 1e-9), 0)
    anchors = np.linspace(0, 1, len(DEPTH_COLOURS))
    picture = np.stack([np.interp(share, anchors, DEPTH_COLOURS[:, channel]) for channel in range(3)], axis=-1)
    picture[~seen] = NO_READING_COLOUR
    gaps = "" if seen.all() else f", {100 * (1 - seen.mean()):.1f}% without reading (grey)"
    return _png(picture.astype(np.uint8)), f"start depth, {near:.2f} (dark) to {far:.2f} m (bright){gaps}"


def _jpeg(image: NDArray[np.uint8]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="jpeg", quality=JPEG_QUALITY)
    return buffer.getvalue()


def _png(image: NDArray[np.uint8]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).quantize(64).save(buffer, format="png", optimize=True)
    return buffer.getvalue()


def _data_uri(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
