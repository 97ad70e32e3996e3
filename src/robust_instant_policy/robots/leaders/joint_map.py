"""How a leader's readings become its follower's joints, and the guided calibration that finds it.

q = sign · (reading - offset), for each joint, from the channel that belongs to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robust_instant_policy.errors import CalibrationError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.robots.calibration.toml import now, save_calibration
from robust_instant_policy.robots.cell import read_section

CLEAR_SHARE = 0.5  # of a shown turn that a channel must follow, and that no other one may reach
MIN_GRIP_RAD = 0.1  # between the readings of an open and a closed trigger

HEADER = """# Calibration of a leader, written by `rip calibrate leader`. Readings and offsets in radians.
# joint[i] = signs[i] * (reading[channels[i]] - offsets[i]); the gripper's readings are of gripper_channel.
"""


@dataclass(frozen=True, eq=False)
class JointMap:
    """For each of J joints its channel ``(J,)``, sign ``(J,)`` and offset ``(J,)`` rad; for the gripper its channel and
    its readings open and closed, rad."""

    channels: NDArray[np.intp]
    signs: FloatArray
    offsets: FloatArray
    gripper_channel: int
    gripper_open: float
    gripper_closed: float

    def joints(self, readings: FloatArray) -> FloatArray:
        """Joints ``(J,)`` rad of ``readings (S,)``, up to whole turns."""
        return self.signs * (readings[self.channels] - self.offsets)

    def opening(self, readings: FloatArray) -> float:
        """How far the trigger is open: 0 closed, 1 open."""
        span = self.gripper_open - self.gripper_closed
        return float(np.clip((readings[self.gripper_channel] - self.gripper_closed) / span, 0.0, 1.0))

    def save(self, path: Path) -> None:
        """Write the TOML file that `load` reads."""
        facts = {
            "date": now(),
            "channels": self.channels.tolist(),
            "signs": self.signs.tolist(),
            "offsets": np.round(self.offsets, 5).tolist(),
            "gripper_channel": self.gripper_channel,
            "gripper_open": round(self.gripper_open, 5),
            "gripper_closed": round(self.gripper_closed, 5),
        }
        save_calibration(path, HEADER, facts)

    @classmethod
    def load(cls, path: Path) -> JointMap:
        """Raises `CellError` that names a missing or wrong key."""
        section = read_section(path)
        channels = section.array("channels", (None,)).astype(np.intp)
        joints = cls(
            channels,
            section.array("signs", (len(channels),)),
            section.array("offsets", (len(channels),)),
            section.whole("gripper_channel"),
            section.number("gripper_open"),
            section.number("gripper_closed"),
        )
        used = [*channels.tolist(), joints.gripper_channel]
        if min(used) < 0 or len(set(used)) < len(used):
            raise section.error("channels", "must be different numbers from 0, and none of them gripper_channel")
        if not np.isin(joints.signs, (-1.0, 1.0)).all():
            raise section.error("signs", "must be 1 or -1 for each joint")
        if joints.gripper_open == joints.gripper_closed:
            raise section.error("gripper_open", "must not be gripper_closed")
        return joints


def calibrate_joints(joints: FloatArray, readings: FloatArray, opened: FloatArray, closed: FloatArray) -> JointMap:
    """The map from ``readings (J + 1, S)`` of a leader that copied ``joints (J + 1, J)`` of its follower, rad.

    Row 0 is the rest pose; in row k + 1 joint k alone was turned. ``opened (S,)`` and ``closed (S,)`` are readings with
    the trigger open and closed. Raises `CalibrationError` for a turn that was not copied.
    """
    changes = _wrapped(readings[1:] - readings[0])
    turned = np.diagonal(joints[1:] - joints[0])
    channels = np.abs(changes).argmax(axis=1)
    for joint, (row, turn, channel) in enumerate(zip(changes, turned, channels, strict=True)):
        share = np.sort(np.abs(row))[::-1] / abs(turn)
        if share[0] < CLEAR_SHARE or share[0] > 1 / CLEAR_SHARE:
            raise CalibrationError(
                f"joint {joint + 1}: the follower turned by {np.degrees(turn):.0f} degrees, the leader by "
                f"{np.degrees(row[channel]):.0f}; begin again, and copy each turn"
            )
        if share[1] > CLEAR_SHARE:
            raise CalibrationError(f"joint {joint + 1}: more than one joint of the leader was turned; begin again")
    if len(set(channels.tolist())) < len(channels):
        raise CalibrationError("two turns of the follower were copied with the same joint of the leader; begin again")
    signs = np.sign(changes[np.arange(len(channels)), channels] * turned)
    grip = _wrapped(opened - closed)
    grip[channels] = 0.0
    gripper = int(np.abs(grip).argmax())
    if abs(grip[gripper]) < MIN_GRIP_RAD:
        raise CalibrationError("the trigger reads the same open and closed; begin again, and press it when told")
    offsets = readings[0][channels] - signs * joints[0]
    return JointMap(channels, signs, offsets, gripper, float(closed[gripper] + grip[gripper]), float(closed[gripper]))


def _wrapped(angles: FloatArray) -> FloatArray:
    """Angles in [-π, π)."""
    return (angles + np.pi) % (2 * np.pi) - np.pi
