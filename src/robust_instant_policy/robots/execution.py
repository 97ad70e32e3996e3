"""Checks between a camera image, a plan and a motion of real arms, and the motions before a plan."""

from collections.abc import Sequence
from itertools import count

import numpy as np

from robust_instant_policy.checks import is_trusted
from robust_instant_policy.demonstration import Observation
from robust_instant_policy.errors import CellError, RobotError, StoppedError
from robust_instant_policy.motion.guard import park_motion
from robust_instant_policy.motion.state import ArmState, Command, is_open
from robust_instant_policy.robots.calibration import check_camera
from robust_instant_policy.robots.camera import Camera
from robust_instant_policy.robots.cell import CellConfig
from robust_instant_policy.robots.signals import StopRequest
from robust_instant_policy.robots.station import START_RAD, Played, Station

OPENING_S, OPENING_MARGIN = 1.0, 1.3  # to open a gripper: at least, and over the time its fingers need
MIN_DEPTH_SHARE = 0.2  # of the pixels of an image; fewer, and the camera is covered or too close


def observe(config: CellConfig, camera: Camera) -> Observation:
    """The start image with the cell's calibration.

    Raises `RobotError` for a camera that repeats its image, has no depth, or is not the calibrated one, `CellError`
    without a calibration.
    """
    if config.camera_pose is None:
        raise CellError(
            f"{config.path}: the camera is not calibrated; run: rip calibrate camera, see docs/calibration.md"
        )
    before, frame = camera.read(), camera.read()
    if frame.timestamp == before.timestamp:
        raise RobotError(f"camera {camera.name} repeats its image: it is frozen; unplug it, plug it in, and run again")
    if config.camera_calibration is not None:
        check_camera(config.camera_calibration, camera.name, frame)
    if frame.depth_share < MIN_DEPTH_SHARE:
        raise RobotError(
            f"camera {camera.name}: {100 * frame.depth_share:.0f}% of the pixels have depth, at least "
            f"{100 * MIN_DEPTH_SHARE:.0f}% are needed; uncover it, or move it farther away"
        )
    return Observation(frame.rgb, frame.depth, frame.intrinsics, config.camera_pose)


def require_trust(config: CellConfig, confidence: float | None, cell: str) -> None:
    """Raises `StoppedError` for a plan with too low a ``confidence``, or one that was made for another ``cell``."""
    if cell != config.digest:
        raise StoppedError(
            "the plan was made for another calibration, gripper or cell"
            + ("" if cell else " (it names none)")
            + f"; this one is {config.digest}: plan again here"
        )
    if not is_trusted(confidence, config.min_confidence):
        value = "none" if confidence is None else f"{confidence:.2f}"
        limit = f"{config.min_confidence:.2f}" if config.min_confidence else "above 0"
        raise StoppedError(
            f"the plan's confidence is {value}, the limit is {limit} (min_confidence in the cell's "
            "file, docs/trust.md); record more demonstrations, or look at the page for the reason"
        )


def is_parked(station: Station) -> bool:
    """Whether all arms are at their park poses, where a plan begins."""
    states = station.states()
    away = [np.abs(state.joints - arm.home).max() for state, arm in zip(states, station.arms, strict=True)]
    return max(away) <= START_RAD


def has_open_grippers(station: Station) -> bool:
    """Whether all grippers are open, as plans and demonstrations begin."""
    return all(is_open(state, arm.finger_travel) for state, arm in zip(station.states(), station.arms, strict=True))


def open_grippers(station: Station, stop: StopRequest) -> None:
    """Open all grippers, also those that hold something; joints do not move."""
    steps = count(1)
    seconds = max(OPENING_S, *(OPENING_MARGIN * arm.finger_travel / arm.finger_speed for arm in station.arms))

    def opening(_: Sequence[ArmState]) -> list[Command] | None:
        if next(steps) > seconds * station.rate_hz or stop.reason:
            return None
        pairs = zip(station.gate.last, station.arms, strict=True)
        return [Command(told.joints, arm.finger_travel) for told, arm in pairs]

    station.lead(opening)


def park(station: Station, stop: StopRequest, speed: float) -> Played:
    """Move all arms to their park poses, grippers as they are.

    Raises `UnreachableError` where the way is refused, `StoppedError` where an arm is not ready.
    """
    states = station.states()
    station.gate.start(states)
    joints = np.stack([state.joints for state in states])
    fingers = np.array([command.finger_travel for command in station.gate.last])
    fingers = fingers.clip(0.0, [arm.finger_travel for arm in station.arms])
    return station.play(park_motion(joints, fingers, station.arms, station.config.limits, station.rate_hz, speed), stop)
