"""`rip record --robot`: record demonstrations with the leaders of a real or emulated cell."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from itertools import count
from pathlib import Path

from robust_instant_policy.commands.console import StageConsole
from robust_instant_policy.commands.options import beside
from robust_instant_policy.datasets import DatasetWriter, load_demonstrations
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import CellError, RipError, UsageError
from robust_instant_policy.files import write_whole
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.perception import KeypointExtractor
from robust_instant_policy.reporting.keypoints import keypoints_page
from robust_instant_policy.robots.cameras import make_camera
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.emulation.client import Emulation, devices_of
from robust_instant_policy.robots.leaders import make_leader
from robust_instant_policy.robots.operator import Terminal
from robust_instant_policy.robots.session import Session
from robust_instant_policy.robots.signals import stop_on_signals
from robust_instant_policy.robots.station import Station


def record_cell(options: argparse.Namespace) -> int:
    """Record with a cell's leaders; the person at the terminal leads."""
    if options.images or options.every != 1:
        raise UsageError("--images and --every are for simulated tasks; a cell records each step, without images")
    screen = StageConsole()
    with ExitStack() as stack:
        config = CellConfig.load(options.robot)
        if config.camera is None or config.camera_pose is None:
            raise CellError(f"{options.robot}: the camera is not calibrated; run: rip calibrate camera")
        config, emulation = stack.enter_context(devices_of(config))
        assert config.camera is not None
        terminal = stack.enter_context(Terminal(stack.enter_context(stop_on_signals()), screen.say))
        station = Station(config)
        folder = config.path.parent
        leaders = [
            make_leader(one, arm, config.rate_hz, folder, terminal.pressed)
            for one, arm in zip(config.arms, station.arms, strict=True)
        ]
        camera = make_camera(config.camera, folder)
        writer = stack.enter_context(DatasetWriter(options.out, options.task, options.description, config.rate_hz))
        last = writer.last_seed
        next_scene = (
            None if emulation is None else partial(_next_scene, emulation, count(0 if last is None else last + 1))
        )
        stack.enter_context(station)
        for leader in leaders:
            leader.connect()
            stack.callback(leader.disconnect)
        camera.connect()
        stack.callback(camera.disconnect)
        preview = partial(_preview, options.out, screen, config.limits.workspace)
        Session(station, leaders, camera, writer, terminal, preview, next_scene).record(options.episodes)
    screen.say(f"{options.out}: {writer.num_episodes} demonstrations of {options.task}, {writer.discarded} discarded")
    return 0


def _next_scene(emulation: Emulation, seeds: Iterator[int]) -> int:
    seed = next(seeds)
    emulation.scene(seed)
    return seed


def _preview(demos: Path, screen: StageConsole, workspace: FloatArray, seen: Observation) -> None:
    """Write a page with the keypoints of the demonstrations so far and those found in a start image."""
    try:
        recorded = load_demonstrations(demos)
        extractor = KeypointExtractor(workspace=workspace)
        extractor.fit([one.observation for one in recorded], [one.trajectory for one in recorded])
        page = keypoints_page(extractor, [one.observation for one in recorded], [seen], None, "Keypoints")
    except RipError as error:  # too few demonstrations so far, too little in common, or a missing package
        screen.say(f"  no keypoints yet: {error}")
        return
    out = beside(demos, "-preview.html")
    write_whole(out, page.encode())
    screen.say(f"  page: {out}")
