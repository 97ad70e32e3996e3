"""`rip robot check`: is each device there, how fast does it answer, and what is wrong with it?"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from robust_instant_policy.errors import RipError, RobotError, UnreachableError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.guard import check_home
from robust_instant_policy.robots.calibration import check_camera
from robust_instant_policy.robots.camera import Frame
from robust_instant_policy.robots.cameras import make_camera
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.execution import MIN_DEPTH_SHARE
from robust_instant_policy.robots.station import START_RAD, Station

READINGS = 100
FRAMES = 3
JITTER_S = 5e-3  # largest accepted difference from the rate, of 95% of the readings


def check_cell(config: CellConfig, say: Callable[[str], object]) -> int:
    """Print one line for each device and finding; returns the exit status, 1 if something must be mended."""
    bad = 0
    for check in (_arms, _camera):
        try:
            for line, good in check(config):
                say(f"  {'ok   ' if good else 'WRONG'} {line}")
                bad += not good
        except RipError as error:
            say(f"  WRONG {error}")
            bad += 1
    say("no problem found" if not bad else f"{bad} problem{'s' * (bad > 1)} to solve")
    return int(bad > 0)


def _arms(config: CellConfig) -> list[tuple[str, bool]]:
    lines = []
    with Station(config) as station:
        try:
            check_home(station.arms, config.limits, config.rate_hz)
        except UnreachableError as error:
            lines.append((str(error), False))
        for arm, follower in zip(station.arms, station.followers, strict=True):
            seconds, clocks = [], []
            for _ in range(READINGS):
                start = time.monotonic()
                state = follower.state()
                seconds.append(time.monotonic() - start)
                clocks.append(state.clock)
                time.sleep(max(0.0, 1 / config.rate_hz - seconds[-1]))
            slow = float(np.percentile(seconds, 95))
            lines.append((_timing(arm.name, slow, config.rate_hz), slow + JITTER_S < 1 / config.rate_hz))
            lines.append((f"{arm.name}: its clock advances", len(set(clocks)) > READINGS // 2))
            lines += [(f"{arm.name}: {fault}", False) for fault in state.faults]
            lines.append(_at_park(arm.name, state.joints, arm.home))
    return lines


def _timing(name: str, slow: float, rate_hz: float) -> str:
    return f"{name}: 95% of the states within {1e3 * slow:.1f} ms, a control step has {1e3 / rate_hz:.0f} ms" + (
        "" if slow + JITTER_S < 1 / rate_hz else "; set the adapter's latency timer to 1 ms, or lower rate_hz"
    )


def _at_park(name: str, joints: FloatArray, home: FloatArray) -> tuple[str, bool]:
    away = joints - home
    worst = int(np.argmax(np.abs(away)))
    if abs(away[worst]) < START_RAD:
        return f"{name}: at its park pose", True
    return (
        f"{name}: joint {worst + 1} is {away[worst]:+.2f} rad away from the park pose; `rip run` moves it there first "
        f"(to park here instead: park = {joints.round(2).tolist()})",
        True,
    )


def _camera(config: CellConfig) -> list[tuple[str, bool]]:
    if config.camera is None:
        return [("camera: the cell's file has no table [camera]", False)]
    camera = make_camera(config.camera, config.path.parent)
    camera.connect()
    try:
        start = time.monotonic()
        frames = [camera.read() for _ in range(FRAMES)]
        rate = FRAMES / (time.monotonic() - start)
    finally:
        camera.disconnect()
    depth = frames[-1].depth
    share = float((np.isfinite(depth) & (depth > 0)).mean())
    height, width = depth.shape
    return [
        (f"camera {camera.name}: {width} x {height} at {rate:.0f} frames/s", True),
        (
            f"camera {camera.name}: {100 * share:.0f}% of the pixels have depth"
            + ("" if share >= MIN_DEPTH_SHARE else "; is its lens covered, or is it closer than its least distance?"),
            share >= MIN_DEPTH_SHARE,
        ),
        (f"camera {camera.name}: its clock advances", len({frame.timestamp for frame in frames}) == FRAMES),
        _calibration(config, camera.name, frames[-1]),
    ]


def _calibration(config: CellConfig, name: str, frame: Frame) -> tuple[str, bool]:
    if config.camera_calibration is None or config.camera_pose is None:
        return f"camera {name}: not calibrated; run: rip calibrate camera", False
    try:
        check_camera(config.camera_calibration, name, frame)
    except RobotError as error:
        return str(error), False
    return f"camera {name}: calibrated", True
