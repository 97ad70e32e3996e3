"""A trajectory as gripper poses with times in seconds, for an arm or a simulator to follow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from robust_instant_policy.geometry import FloatArray, GripperTriangle
from robust_instant_policy.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class TimedPoses:
    """M moments: ``times (M,)`` in seconds from 0, tool ``poses (M, A, 4, 4)`` of A grippers in the world, and how far
    their fingers are apart then, ``opening (M, A)`` in metres.

    Between two moments the arm moves from pose to pose. Where the opening changes the pose stays: that time is for the
    fingers. The tool frame is that of `geometry`: origin midway between the fingertips, z out of the gripper, y along
    the line on which the fingers open.
    """

    times: FloatArray
    poses: FloatArray
    opening: FloatArray

    @classmethod
    def of(cls, trajectory: Trajectory, seconds: float, dwell: float) -> TimedPoses:
        """``trajectory`` in ``seconds``, and a stop of ``dwell`` seconds at each change of a gripper's state.

        Grippers start open: a first waypoint that is closed has a stop, too.
        """
        triplets, closed = trajectory.triplets, trajectory.gripper_state > 0.5
        grippers = [GripperTriangle.from_triplets(triplets[:, arm]) for arm in range(trajectory.num_arms)]
        poses = np.stack([gripper.poses(triplets[:, arm]) for arm, gripper in enumerate(grippers)], axis=1)
        before = np.concatenate([np.zeros_like(closed[:1]), closed[:-1]])
        stops = (closed != before).any(axis=1)
        at = trajectory.times * seconds + dwell * (np.cumsum(stops) - stops)
        # where it stops, a waypoint is two moments: it arrives as before, then it has opened or closed
        order = np.sort(np.concatenate([np.arange(len(closed)), np.flatnonzero(stops)]))
        second = np.append(False, order[1:] == order[:-1])
        states = np.where(second[:, None], closed[order], before[order])
        open_m = np.array([gripper.opening for gripper in grippers])
        return cls(at[order] + dwell * second, poses[order], np.where(states, 0.0, open_m))
