"""Tasks of the UR5e cell in which demonstrations share a relation: what succeeds and what does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.level import PAPER
from robust_instant_policy.tasks.maniskill.camera import matrix
from robust_instant_policy.tasks.maniskill.sort import PICK, SPEC, TRAY_M, WALL_M
from robust_instant_policy.tasks.maniskill.task import CellTask
from robust_instant_policy.tasks.picking import set_down
from robust_instant_policy.tasks.poses import facing
from robust_instant_policy.trajectory import downsample


def test_the_block_further_away_does_not_belong_into_the_tray():
    def take_the_other(env, rng):
        tray = facing(*TRAY_M, 0.0)
        tray[2, 3] = 2 * WALL_M
        return [*PICK.strokes(matrix(env.blocks[1 - env.nearer].pose), rng), *set_down(tray, PICK)]

    task = CellTask(replace(SPEC, expert=take_the_other), "seen", "code", PAPER)
    try:
        attempt = task.demonstrate(0)
    finally:
        task.close()
    assert not attempt.success
    assert attempt.failure == "the block further away is in the tray"


def test_half_a_wipe_is_no_success():
    task = make_task("wipe")
    try:
        trajectory = downsample(task.demonstrate(0).demonstration.trajectory)
        height = trajectory.triplets[:, 0, 1:, 2].mean(axis=1)
        low = np.flatnonzero(height < height.min() + 0.01)
        task.reset(0)
        execution = task.execute(trajectory.subset(np.arange(low[len(low) // 2])))
    finally:
        task.close()
    assert not execution.success
    assert "% of the bar is wiped, 90% wanted" in execution.failure


def test_the_goal_lies_on_every_side_of_the_cube_and_bases_and_bars_differ_in_size():
    task = make_task("push-cube-anywhere")
    try:
        angles = []
        for seed in range(12):
            task.reset(seed)
            truth = task.scene_truth()
            cube, goal = (truth.poses[truth.names.index(name)][:2, 3] for name in ("cube", "goal"))
            angles.append(np.arctan2(*(goal - cube)))
    finally:
        task.close()
    assert len({int(angle // (np.pi / 2)) for angle in angles}) == 4


@pytest.mark.parametrize(("name", "part"), [("stack", "base"), ("wipe", "bar")])
def test_no_two_scenes_have_the_same_size(name, part):
    task = make_task(name)
    try:
        pixels = []
        for seed in range(4):
            task.reset(seed)
            truth = task.scene_truth()
            pixels.append((truth.parts == truth.names.index(part)).sum())
    finally:
        task.close()
    assert max(pixels) > 1.2 * min(pixels)
