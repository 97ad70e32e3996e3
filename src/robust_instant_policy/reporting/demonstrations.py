"""A self-contained page that shows every episode of a demonstrations folder."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.datasets import layout
from robust_instant_policy.datasets.folder import open_folder, read_json
from robust_instant_policy.datasets.reader import load_demonstrations
from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.errors import DatasetError
from robust_instant_policy.files import read_regular, write_whole
from robust_instant_policy.reporting.pages import data_uri, png, render
from robust_instant_policy.reporting.pictures import REFERENCE_WIDTH, Line, Picture, picture, svg_points

MAX_POINTS = 240  # of a path that are drawn
COORDINATE_DIGITS = 4  # 0.1 mm
GRID_STEPS_M = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
GRID_LINES = 8  # about so many across the widest side
STRIP_WIDTH, STRIP_HEIGHT = 1000, 76  # of the strip over time, in its own units
NO_READING_COLOUR = (214, 214, 208)


@dataclass(frozen=True)
class StripArm:
    """One arm in the strip over time: its box, the stretches ``(start, width)`` in which it was closed, its height."""

    top: float
    height: float
    closed: tuple[tuple[float, float], ...]
    line: str


@dataclass(frozen=True)
class EpisodeCard:
    """An episode on the page; ``video`` is empty if no images were recorded."""

    facts: tuple[str, ...]
    image: Picture
    depth: str
    depth_caption: str
    video: str
    strip: tuple[StripArm, ...]
    heights: str


def write_page(path: str | Path, out: str | Path) -> Path:
    """Write a page on the demonstrations in the folder ``path`` to ``out`` and return that.

    It needs no network and no other file: start image and depth, the gripper's path over the image and in 3-D,
    its state and height over time, and the video where images were recorded.
    Raises `DatasetError` as `load_demonstrations` does.
    """
    demonstrations = load_demonstrations(path)
    videos = _videos(Path(path), len(demonstrations))
    recorded = read_json(Path(path) / layout.RIP_PATH)
    points = np.concatenate([demo.trajectory.triplets.reshape(-1, 3) for demo in demonstrations])
    low, high = points.min(axis=0), points.max(axis=0)
    grid = next((step for step in GRID_STEPS_M if (high - low).max() <= step * GRID_LINES), GRID_STEPS_M[-1])
    page = render(
        "demonstrations.html",
        title=f"{recorded['task']}: demonstrations",
        task=recorded["task"],
        description=recorded.get("description", ""),
        facts=_facts(demonstrations, len(recorded.get("discarded_seeds", [])), any(videos)),
        grid=f"{100 * grid:g} cm",
        episodes=[_card(demo, video) for demo, video in zip(demonstrations, videos, strict=True)],
        strip_width=STRIP_WIDTH,
        strip_height=STRIP_HEIGHT,
        data={
            "bounds": np.round([low, high], COORDINATE_DIGITS).tolist(),
            "grid": grid,
            "episodes": [_paths(demo) for demo in demonstrations],
        },
    )
    write_whole(Path(out), page.encode())
    return Path(out)


def _videos(root: Path, count: int) -> list[str]:
    if layout.VIDEO_KEY not in open_folder(root).video_keys:
        return [""] * count
    paths = [root / layout.episode_path(layout.VIDEO_PATTERN, episode) for episode in range(count)]
    try:
        return [data_uri(read_regular(path), "video/mp4") for path in paths]
    except OSError as error:
        raise DatasetError(f"{error.filename} cannot be read: restore it, or record the folder again") from error


def _facts(demonstrations: Sequence[Demonstration], discarded: int, with_images: bool) -> dict[str, str]:
    seconds = [demo.seconds for demo in demonstrations]
    steps = [len(demo.trajectory) for demo in demonstrations]
    return {
        "episodes": f"{len(demonstrations)}",
        "attempts discarded": f"{discarded}",
        "seconds each, shortest to longest": f"{min(seconds):.1f} – {max(seconds):.1f}",
        "steps each": f"{min(steps)} – {max(steps)}",
        "recording rate": f"{demonstrations[0].rate_hz:g} Hz",
        "video of each episode": "yes" if with_images else "no",
    }


def _paths(demo: Demonstration) -> dict[str, object]:
    """Data of the 3-D drawing: for each arm its path, the gripper along it, and the gripper state."""
    steps = _drawn_steps(len(demo.trajectory))
    triplets = demo.trajectory.triplets[steps]
    closed = demo.trajectory.gripper_state[steps] > 0.5
    return {
        "seconds": demo.seconds,
        "arms": [
            {
                "points": np.round(demo.trajectory.tool_points[steps, arm], COORDINATE_DIGITS).tolist(),
                "grippers": np.round(triplets[:, arm], COORDINATE_DIGITS).tolist(),
                "closed": closed[:, arm].astype(int).tolist(),
            }
            for arm in range(demo.trajectory.num_arms)
        ],
    }


def _card(demo: Demonstration, video: str) -> EpisodeCard:
    depth, caption = _depth_picture(demo.observation.depth)
    heights = demo.trajectory.tool_points[..., 2]
    seed = () if demo.seed is None else (f"seed {demo.seed}",)
    return EpisodeCard(
        facts=(
            f"{demo.seconds:.2f} s",
            f"{len(demo.trajectory)} steps",
            *seed,
            *(f"{name}: {value}" for name, value in demo.info.items()),
        ),
        image=picture(demo.observation.rgb, "start image with the path of the fingertips", _path_over_image(demo)),
        depth=depth,
        depth_caption=caption,
        video=video,
        strip=tuple(_strip_arm(demo, arm) for arm in range(demo.trajectory.num_arms)),
        heights=f"{100 * heights.min():.1f} to {100 * heights.max():.1f} cm",
    )


def _path_over_image(demo: Demonstration) -> list[Line]:
    """The fingertips' path as the camera of the start sees it, closed parts in the other colour."""
    unit = demo.observation.rgb.shape[1] / REFERENCE_WIDTH
    lines = []
    for arm in range(demo.trajectory.num_arms):
        points = demo.trajectory.tool_points[:, arm]
        for start, stop, closed in _stretches(demo.trajectory.gripper_state[:, arm] > 0.5):
            line = svg_points(points[start : stop + 1], demo.observation)
            # White below the colour, so that the path stands out from any table.
            lines.append(Line(line, "#fff", 4 * unit))
            lines.append(Line(line, "var(--closed)" if closed else "var(--open)", 2 * unit))
    return lines


def _strip_arm(demo: Demonstration, arm: int) -> StripArm:
    count, share = len(demo.trajectory), STRIP_HEIGHT / demo.trajectory.num_arms
    across = np.linspace(0, STRIP_WIDTH, count)
    top, bottom = arm * share + 4, (arm + 1) * share - 2
    height = demo.trajectory.tool_points[:, arm, 2]
    scaled = (height - height.min()) / max(np.ptp(height), 1e-9)
    down = bottom - 4 - scaled * (bottom - top - 8)
    return StripArm(
        round(top, 1),
        round(bottom - top, 1),
        tuple(
            (round(across[start], 1), round(across[stop] - across[start], 1))
            for start, stop, closed in _stretches(demo.trajectory.gripper_state[:, arm] > 0.5)
            if closed
        ),
        " ".join(f"{across[step]:.1f},{down[step]:.1f}" for step in _drawn_steps(count)),
    )


def _drawn_steps(count: int) -> NDArray[np.intp]:
    return np.unique(np.linspace(0, count - 1, MAX_POINTS).astype(np.intp))


def _stretches(closed: NDArray[np.bool_]) -> list[tuple[int, int, bool]]:
    """Stretches ``(first, last, closed)`` of one gripper state, each reaching to the start of the next."""
    starts = [0, *(np.flatnonzero(np.diff(closed)) + 1).tolist()]
    stops = [*starts[1:], len(closed) - 1]
    return [(start, stop, bool(closed[start])) for start, stop in zip(starts, stops, strict=True)]


def _depth_picture(depth: NDArray[np.float32]) -> tuple[str, str]:
    """Data URL of ``depth (H, W)``, near dark and far bright, and its caption."""
    known = np.isfinite(depth) & (depth > 0)
    if not known.any():
        return png(np.full((*depth.shape, 3), NO_READING_COLOUR, dtype=np.uint8)), "start depth: no reading at all"
    near, far = float(depth[known].min()), float(depth[known].max())
    share = np.where(known, (np.nan_to_num(depth) - near) / max(far - near, 1e-9), 0)
    image = matplotlib.colormaps["viridis"](share, bytes=True)[..., :3]
    image[~known] = NO_READING_COLOUR
    gaps = "" if known.all() else f", {100 * (1 - known.mean()):.1f}% without reading (grey)"
    return png(image), f"start depth, {near:.2f} m (dark) to {far:.2f} m (bright){gaps}"
