"""Timed gripper poses of a plan, and what demonstrations say about the pace of their execution."""

import numpy as np
import pytest

from robust_instant_policy import Demonstration, GripperTriangle, Plan, Trajectory
from robust_instant_policy.errors import InvalidValueError
from robust_instant_policy.geometry import lift, make_pose
from robust_instant_policy.motion.gripper_changes import Pace
from robust_instant_policy.policies import Neighbours
from robust_instant_policy.tasks.template import PlaceBlock

DOWN = np.diag([1.0, -1.0, -1.0])
GRIPPER = GripperTriangle(length=0.1, opening=0.08)
RATE_HZ = 20.0


def recorded(change: int, wait: int = 8) -> Demonstration:
    """Down in 20 steps, a wait, up in 20 steps; the state changes ``change`` steps after the hand has stopped."""
    height = np.concatenate([np.linspace(0.3, 0.05, 20), np.full(wait, 0.05), np.linspace(0.05, 0.3, 20)])
    poses = [make_pose(DOWN, [0.1, 0.2, z]) for z in height]
    closed = np.arange(len(height)) > 19 + change
    return Demonstration(PlaceBlock().reset(0), Trajectory.from_poses(poses, closed, GRIPPER), RATE_HZ)


@pytest.mark.parametrize(("change", "wait", "state"), [(0, 8, "commanded"), (8, 8, "measured"), (0, 0, "unknown")])
def test_the_wait_tells_whether_a_state_is_commanded_or_measured(change, wait, state):
    pace = Pace.of([recorded(change, wait)] * 3)
    assert pace.state == state
    assert pace.seconds == pytest.approx((39 + wait) / RATE_HZ)
    assert pace.dwell == pytest.approx(0.45, abs=0.06)  # nine steps of 0.05 s, or what is assumed


def test_poses_stop_where_the_gripper_closes():
    shown = recorded(0, wait=0)
    motion = Plan.of(shown.trajectory).poses(seconds=2.0, dwell=0.5)
    assert motion.times[0] == 0
    assert motion.times[-1] == pytest.approx(2.5)
    assert (np.diff(motion.times) > 0).all()
    (closing,) = np.flatnonzero(np.diff(motion.opening[:, 0]) < 0)
    assert motion.times[closing + 1] - motion.times[closing] == pytest.approx(0.5)
    np.testing.assert_allclose(motion.poses[closing], motion.poses[closing + 1])
    np.testing.assert_allclose(motion.poses[0, 0], make_pose(DOWN, [0.1, 0.2, 0.3]), atol=1e-9)
    assert motion.opening[0, 0] == pytest.approx(0.08)
    assert motion.opening[-1, 0] == 0
    with pytest.raises(InvalidValueError, match="give seconds and dwell"):
        Plan.of(shown.trajectory).poses()


def test_a_plan_knows_the_pace_of_its_demonstrations_and_keeps_it_in_its_file(tmp_path):
    class Middles:
        def locate(self, observation):
            found = []
            for channel in (0, 2):
                seen = observation.rgb[..., channel] > observation.rgb.mean(axis=2) + 30
                pixels, camera = np.argwhere(seen)[:, ::-1], (observation.intrinsics, observation.camera_pose)
                points = lift(pixels, observation.depth[seen], *camera)
                found += [points.min(axis=0), points.max(axis=0)]
            return np.array(found)

    task = PlaceBlock()
    shown = []
    policy = Neighbours(keypoints=Middles())
    for seed in range(4):
        shown.append(task.demonstrate(seed).demonstration)
    plan = policy.fit(shown).plan(shown[-1].observation)
    plan.save(tmp_path / "plan.json")
    again = Plan.load(tmp_path / "plan.json")
    assert again.seconds == plan.seconds == pytest.approx(shown[0].seconds)
    np.testing.assert_allclose(again.poses().times, plan.poses().times)
    assert again.poses().times[-1] == pytest.approx(plan.seconds + 2 * plan.dwell)  # it closes and opens
