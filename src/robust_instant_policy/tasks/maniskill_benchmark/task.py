"""ManiSkill's own Panda tasks, ``maniskill/NAME``, as `tasks.task.Task`."""

from dataclasses import dataclass, field

import numpy as np

from robust_instant_policy.checks import check_name
from robust_instant_policy.tasks.level import CAMERA_LEVELS, Level, make_level
from robust_instant_policy.tasks.maniskill.renderer import require_renderer
from robust_instant_policy.tasks.maniskill.task import ManiSkillTask
from robust_instant_policy.tasks.maniskill_benchmark import demonstrators
from robust_instant_policy.tasks.maniskill_benchmark.benchmark import PREFIX
from robust_instant_policy.tasks.maniskill_benchmark.cell import PandaCell, View
from robust_instant_policy.tasks.maniskill_benchmark.robot import panda
from robust_instant_policy.tasks.simulated_task import Expert, TaskSpec, Timing

TIMING = Timing(control_hz=20.0, record_every=1, frame_every=2, execute_hz=5.0)  # control as in the environments
WORKSPACE_M = ((-0.45, -0.45, -0.005), (0.45, 0.45, 0.5))


@dataclass(frozen=True)
class PandaSpec:
    """A task of ManiSkill: what it asks for, who demonstrates it, from where the camera looks, and where the arm
    works (lower and upper corner, metres)."""

    description: str
    goal: str
    expert: Expert
    view: View = field(default_factory=View)
    workspace: tuple[tuple[float, float, float], tuple[float, float, float]] = WORKSPACE_M


SPECS = {
    "PickCube": PandaSpec("move the cube to the green ball", "the cube is at the ball", demonstrators.pick_cube),
    "PushCube": PandaSpec("push the cube into the target", "the cube is in the target", demonstrators.push_cube),
    "PullCube": PandaSpec("pull the cube into the target", "the cube is in the target", demonstrators.pull_cube),
    "StackCube": PandaSpec(
        "stack the red cube on the green one", "the red cube rests on the green one", demonstrators.stack_cube
    ),
    "PlaceSphere": PandaSpec("put the sphere into the bin", "the sphere rests in the bin", demonstrators.place_sphere),
    "LiftPegUpright": PandaSpec("put the peg upright", "the peg stands on the table", demonstrators.lift_peg_upright),
    "PegInsertionSide": PandaSpec(
        "insert the peg into the hole of the box",
        "the head of the peg is in the middle of the box",
        demonstrators.peg_insertion_side,
        View(eye=(0.2, -0.75, 0.8), target=(0.0, 0.05, 0.05), width=1.05),
        ((-0.4, -0.5, -0.005), (0.4, 0.6, 0.4)),
    ),
    "StackPyramid": PandaSpec(
        "put the red cube beside the green one and the blue one on both",
        "the blue cube rests on the other two",
        demonstrators.stack_pyramid,
    ),
    "PullCubeTool": PandaSpec(
        "pull the cube near with the tool",
        "the cube is within 0.6 m of the robot",
        demonstrators.pull_cube_tool,
        View(eye=(0.45, -0.1, 1.15), target=(0.0, -0.1, 0.0)),
    ),
    "RollBall": PandaSpec(
        "roll the ball into the target",
        "the ball is in the target",
        demonstrators.roll_ball,
        View(eye=(1.0, -0.1, 1.5), target=(-0.1, -0.1, 0.0), width=1.9),
        ((-0.6, -1.1, -0.005), (0.4, 0.9, 0.5)),
    ),
}


class PandaTask(ManiSkillTask):
    """``maniskill/NAME``: ManiSkill's environment ``NAME-v1`` with its own scenes, robot and rule of success."""

    def __init__(self, name: str, level: Level):
        require_renderer()
        own = SPECS[name]
        cell = PandaCell(f"{name}-v1", own.view)
        cell.reset(seed=0)
        spec = TaskSpec(f"{PREFIX}{name}", own.description, own.goal, own.expert)
        super().__init__(spec, cell, [panda(cell.base)], TIMING, np.array(own.workspace), level)


def make(name: str, objects: str, assets: str, level: str) -> PandaTask:
    """The task ``maniskill/NAME``."""
    check_name(f"set of objects of {name}", objects, ("seen",))
    check_name(f"source of assets of {name}", assets, ("code",))
    check_name(f"level of {name}", level, CAMERA_LEVELS)
    return PandaTask(name.removeprefix(PREFIX), make_level(level))
