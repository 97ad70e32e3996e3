"""`rip record --robot`: record demonstrations with the leaders of a real or emulated cell."""

import argparse
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from itertools import count

from robust_instant_policy.commands.console import StageConsole
from robust_instant_policy.commands.live_camera import LiveCamera
from robust_instant_policy.datasets import DatasetWriter
from robust_instant_policy.errors import CellError, UsageError
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.device import connected
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
        folder = config.path.parent
        camera = LiveCamera(config.camera, folder, options.out, config.limits.workspace)

        def say(line: str) -> None:
            screen.say(line)
            camera.say(line)

        stop = stack.enter_context(stop_on_signals())
        terminal = stack.enter_context(Terminal(stop, say))
        station = Station(config)
        leaders = [
            make_leader(one, arm, config.rate_hz, folder, terminal.pressed)
            for one, arm in zip(config.arms, station.arms, strict=True)
        ]
        writer = stack.enter_context(DatasetWriter(options.out, options.task, options.description, config.rate_hz))
        last = writer.last_seed
        next_scene = (
            None if emulation is None else partial(_next_scene, emulation, count(0 if last is None else last + 1))
        )
        with stop.ends_waiting():
            stack.enter_context(station)
            for leader in leaders:
                stack.enter_context(connected(leader))
            stack.callback(camera.disconnect)
            camera.connect()
        screen.say(f"live picture and keypoints: {camera.url}")
        Session(station, leaders, camera, writer, terminal, camera.show, next_scene).record(options.episodes)
    screen.say(f"{options.out}: {writer.num_episodes} demonstrations of {options.task}, {writer.discarded} discarded")
    return 0


def _next_scene(emulation: Emulation, seeds: Iterator[int]) -> int:
    seed = next(seeds)
    emulation.scene(seed)
    return seed
