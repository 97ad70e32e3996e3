"""Space that a motion will sweep; commanded and measured paths; detection of empty grasps from width and force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robust_instant_policy.files import load_arrays, npz, write_whole
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.motion.arm import Arm, Motion
from robust_instant_policy.motion.capsules import ArmShape

EMPTY_TRAVEL_M = 1.5e-3  # of each finger: less than this is left between closed fingers that hold nothing
EMPTY_LOAD = 0.5  # share of the force limit; fingers that press on something thin use more
CLOSING_S = 0.4  # of a closed command before the width is judged
CLOSED_M = 1e-6

SWEPT_MOMENTS = 24  # of a motion, at which its arms are drawn

ADVICE = "execute the plan again"
ARRAYS = ("rate_hz", "commanded", "measured", "commanded_tools", "measured_tools", "loads", "seconds")


@dataclass(frozen=True, eq=False)
class Sweep:
    """Space that a motion sweeps, metres, world: points between the fingertips ``tools (N, A, 3)`` at each step, and at
    some ``seconds (S,)`` the axes ``links (S, C, 2, 3)`` of the capsules around the arms' links."""

    tools: FloatArray
    links: FloatArray
    seconds: FloatArray

    @classmethod
    def of(cls, motion: Motion, arms: Sequence[Arm], rate_hz: float) -> Sweep:
        rows = np.unique(np.linspace(0, len(motion.joints) - 1, SWEPT_MOMENTS).astype(int))
        capsules = [ArmShape(arm.kinematics).at(motion.joints[rows, index]) for index, arm in enumerate(arms)]
        links = [np.stack([links.start, links.stop], axis=2) for links in capsules]
        return cls(tool_points(motion.joints, arms), np.concatenate(links, axis=1), rows / rate_hz)

    def save(self, path: Path) -> None:
        write_whole(path, npz(vars(self)))

    @classmethod
    def load(cls, path: Path) -> Sweep:
        """Raises `DatasetError` for a file that is not the sweep of a motion."""
        arrays = load_arrays(path, ("tools", "links", "seconds"), ADVICE)
        return cls(arrays["tools"], arrays["links"], arrays["seconds"])


def tool_points(joints: FloatArray, arms: Sequence[Arm]) -> FloatArray:
    """Points between the fingertips ``(N, A, 3)``, metres in the world, at ``joints (N, A, J)``."""
    points = [[arm.kinematics.tool_pose(row[i])[:3, 3] for i, arm in enumerate(arms)] for row in joints]
    return np.array(points).reshape(len(joints), len(arms), 3)


@dataclass(frozen=True, eq=False)
class MeasuredPath:
    """A run at ``rate_hz``: ``commanded`` and ``measured (N, A, J + 1)`` joints, rad, and finger travel, metres;
    ``commanded_tools`` and ``measured_tools (N, A, 3)``, the points between the fingertips, metres in the world;
    ``loads (N, A)`` of the grippers, 0 to 1; ``seconds (N,)`` since the start, of the machine's clock."""

    rate_hz: float
    commanded: FloatArray
    measured: FloatArray
    commanded_tools: FloatArray
    measured_tools: FloatArray
    loads: FloatArray
    seconds: FloatArray

    def save(self, path: Path) -> None:
        write_whole(path, npz(vars(self)))

    @classmethod
    def load(cls, path: Path) -> MeasuredPath:
        """Raises `DatasetError` for a file that is not a measured path."""
        arrays = load_arrays(path, ARRAYS, ADVICE)
        return cls(float(arrays["rate_hz"]), *(arrays[name] for name in ARRAYS[1:]))

    @property
    def joint_errors(self) -> FloatArray:
        """Differences ``(N, A, J)``, rad, between commanded and measured joints."""
        return np.abs(self.commanded - self.measured)[..., :-1]

    @property
    def tool_errors(self) -> FloatArray:
        """Distances ``(N, A)``, metres, between commanded and measured tools."""
        return np.linalg.norm(self.commanded_tools - self.measured_tools, axis=-1)

    def empty_grasps(self, names: Sequence[str]) -> list[str]:
        """One line for each time that a gripper closed and held nothing."""
        lines = []
        for arm, name in enumerate(names):
            closed = self.commanded[:, arm, -1] <= CLOSED_M
            starts = np.flatnonzero(np.diff(closed.astype(int), prepend=0) == 1)
            for start in starts:
                judged = start + round(CLOSING_S * self.rate_hz)
                if judged < len(closed) and closed[start : judged + 1].all():
                    travel, load = self.measured[judged, arm, -1], self.loads[judged, arm]
                    if travel < EMPTY_TRAVEL_M and load < EMPTY_LOAD:
                        seconds = start / self.rate_hz
                        lines.append(
                            f"the gripper {name} closed on nothing after {seconds:.1f} s: {2e3 * travel:.1f} mm "
                            f"between its fingers, {100 * load:.0f}% of its force"
                        )
        return lines
