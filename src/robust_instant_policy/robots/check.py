"""`rip robot check`: is each device there, how fast does it answer, and what is wrong with it?"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

import numpy as np

from robust_instant_policy.errors import RipError, RobotError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.arm import Arm
from robust_instant_policy.motion.guard import check_home
from robust_instant_policy.motion.state import ArmState
from robust_instant_policy.robots.calibration import check_camera
from robust_instant_policy.robots.camera import Frame
from robust_instant_policy.robots.cameras import make_camera
from robust_instant_policy.robots.cell import ArmConfig, CellConfig
from robust_instant_policy.robots.device import connected
from robust_instant_policy.robots.execution import MIN_DEPTH_SHARE
from robust_instant_policy.robots.follower import Follower
from robust_instant_policy.robots.leaders import make_leader
from robust_instant_policy.robots.priority import CONTROL, real_time
from robust_instant_policy.robots.station import START_RAD, Station

T = TypeVar("T")
READINGS = 100
FRAMES = 3
JITTER_S = 5e-3  # largest accepted difference from the rate, of 95% of the readings


def check_cell(config: CellConfig, say: Callable[[str], object]) -> int:
    """Print one line for each device and finding; returns the exit status, 1 if something must be mended."""
    station = Station(config)
    checks: list[Callable[[], list[tuple[str, bool]]]] = [partial(_park_poses, station)]
    for one, arm, follower in zip(config.arms, station.arms, station.followers, strict=True):
        checks.append(partial(_arm, arm, follower, config.rate_hz))
        if one.leader is not None:
            checks.append(partial(_leader, one, arm, config))
    checks.append(partial(_camera, config))
    bad = 0
    for check in checks:
        try:
            for line, good in check():
                say(f"  {'ok   ' if good else 'WRONG'} {line}")
                bad += not good
        except RipError as error:
            say(f"  WRONG {error}")
            bad += 1
    say("no problem found" if not bad else f"{bad} problem{'s' * (bad > 1)} to solve")
    return int(bad > 0)


def _park_poses(station: Station) -> list[tuple[str, bool]]:
    check_home(station.arms, station.config.limits, station.rate_hz)
    return []


def _arm(arm: Arm, follower: Follower, rate_hz: float) -> list[tuple[str, bool]]:
    with connected(follower):
        states, at, seconds = _readings(follower.state, rate_hz)
    clocks = [state.clock for state in states]
    return [
        _timing(f"{arm.name}: 95% of the states", seconds, rate_hz),
        (
            f"{arm.name}: its clock advances by {(clocks[-1] - clocks[0]) / (at[-1] - at[0]):.2f} s a second",
            len(set(clocks)) > READINGS // 2,
        ),
        *((f"{arm.name}: {fault}", False) for fault in states[-1].faults),
        _at_park(arm.name, states[-1].joints, arm.home),
    ]


def _leader(config: ArmConfig, arm: Arm, cell: CellConfig) -> list[tuple[str, bool]]:
    leader = make_leader(config, arm, cell.rate_hz, cell.path.parent, lambda keys: "")
    parked = ArmState(arm.home, np.zeros_like(arm.home), arm.finger_travel, 0.0, 0.0)
    with connected(leader):
        leader.start()
        _, _, seconds = _readings(lambda: leader.read(parked), cell.rate_hz)
    return [_timing(f"{leader.name}: 95% of the readings", seconds, cell.rate_hz)]


def _readings(read: Callable[[], T], rate_hz: float) -> tuple[list[T], list[float], list[float]]:
    """What a device measures at a rate, when, and how long each reading took, seconds."""
    values, starts, seconds = [], [], []
    with real_time(CONTROL):  # as the control loop has
        for _ in range(READINGS):
            starts.append(time.monotonic())
            values.append(read())
            seconds.append(time.monotonic() - starts[-1])
            time.sleep(max(0.0, 1 / rate_hz - seconds[-1]))
    return values, starts, seconds


def _timing(what: str, seconds: Sequence[float], rate_hz: float) -> tuple[str, bool]:
    slow = float(np.percentile(seconds, 95))
    in_time = slow + JITTER_S < 1 / rate_hz
    advice = "" if in_time else "; set the adapter's latency timer to 1 ms, close other programs, or lower rate_hz"
    return f"{what} within {1e3 * slow:.1f} ms, a control step has {1e3 / rate_hz:.0f} ms{advice}", in_time


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
    with connected(make_camera(config.camera, config.path.parent)) as camera:
        start = time.monotonic()
        frames = [camera.read() for _ in range(FRAMES)]
        rate = FRAMES / (time.monotonic() - start)
    share = frames[-1].depth_share
    height, width = frames[-1].depth.shape
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
