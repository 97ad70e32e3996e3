"""Demonstrators of ManiSkill's Panda tasks: strokes from the poses at the start of the scene, one function a task.

Tool frames are those of `poses.downward`: the fingers close along y, x is across them.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from robust_instant_policy.geometry import FloatArray, invert_pose, make_pose
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.maniskill.camera import matrix
from robust_instant_policy.tasks.maniskill_benchmark.cell import PandaCell
from robust_instant_policy.tasks.poses import downward, pitched

ABOVE_M = 0.10  # of the tool, over what it will grasp or has put down
PRECISE_M, PRECISE_RAD = 0.0005, 0.002  # errors of strokes that need to be precise
GRASP_ERROR_M = 0.0015
SAG_M_PER_KG = 0.0075  # of the tool under what it holds, measured before the hole of PegInsertionSide


def pick_cube(cell: PandaCell, rng: np.random.Generator) -> list[Stroke]:
    """Grasp the cube and hold it in the goal."""
    tool = over(cell, cell.env.cube, symmetry=4)
    goal = tool.copy()
    goal[:3, 3] = place(cell.env.goal_site)
    return [*grasp(tool, rng), hold(goal, pause=0.3)]


def push_cube(cell: PandaCell, rng: np.random.Generator) -> list[Stroke]:
    """Push the cube along x into the goal with closed, inclined fingers: upright ones would not reach far enough."""
    x, y, _ = place(cell.env.obj)
    inclined = pitched(0.4, 0.0)

    def at(along: float, z: float) -> FloatArray:
        return make_pose(inclined, (x + along, y, z))[None]

    end = rng.uniform(0.10, 0.13)
    return [
        Stroke(at(-0.09, 0.10), closed=True, free=True, error=0.004),
        Stroke(at(-0.09, 0.015), closed=True, speed=0.15),
        Stroke(at(end, 0.015), closed=True, speed=0.18),
        Stroke(at(end - 0.06, 0.10), closed=True, free=True, error=0.005),
    ]


def pull_cube(cell: PandaCell, rng: np.random.Generator) -> list[Stroke]:
    """Pull the cube along -x into the goal with closed fingers behind it."""
    x, y, _ = place(cell.env.obj)

    def at(along: float, z: float) -> FloatArray:
        return downward(x + along, y, z)[None]

    end = rng.uniform(-0.19, -0.15)
    return [
        Stroke(at(0.07, 0.12), closed=True, free=True, error=0.004),
        Stroke(at(0.07, 0.015), closed=True, speed=0.15),
        Stroke(at(end, 0.015), closed=True, speed=0.18),
        Stroke(at(end + 0.05, 0.10), closed=True, free=True, error=0.005),
    ]


def stack_cube(cell: PandaCell, rng: np.random.Generator) -> list[Stroke]:
    """Set the red cube down on the green one, turned like it."""
    tool, goal = over(cell, cell.env.cubeA, symmetry=4), over(cell, cell.env.cubeB, symmetry=4)
    return [*grasp(tool, rng), *release(raised(goal, 0.042))]


def place_sphere(cell: PandaCell, rng: np.random.Generator) -> list[Stroke]:
    """Put the sphere into the bin."""
    x, y, z = place(cell.env.bin)
    sphere = place(cell.env.obj)
    height = z + cell.env.block_half_size[0] + cell.env.radius + 0.003
    return [*grasp(downward(*sphere), rng), *release(downward(x, y, height))]


def lift_peg_upright(cell: PandaCell, rng: np.random.Generator) -> list[Stroke]:
    """Grasp the peg at its middle and put it upright about a place where the wrist can turn that far.

    The place varies by centimetres, as a person's would. (Paths that all end at one point look to the checks as if they
    were recorded backwards.)
    """
    backward, forward = pitched(-0.3, 0.0), pitched(1.22, 0.0)
    tool = make_pose(backward, place(cell.env.peg))
    upright = make_pose(forward, (*rng.uniform((0.23, -0.03), (0.27, 0.03)), cell.env.peg_half_length + 0.002))
    return [*grasp(tool, rng), hold(raised(upright, 0.08)), hold(upright, pause=0.3)]


def peg_insertion_side(cell: PandaCell, rng: np.random.Generator) -> list[Stroke]:
    """Grasp the peg at its tail, bring it before the hole, and insert it to the middle of the box."""
    env, peg = cell.env, matrix(cell.env.peg.pose)
    length = float(env.peg_half_sizes[0, 0])
    held = peg @ make_pose(np.eye(3), (-length / 2 - 0.01, 0.0, 0.0))
    tool = upright(cell, held[:3, 3], float(np.arctan2(held[1, 0], held[0, 0])), symmetry=2)
    goal = raised(matrix(env.goal_pose), SAG_M_PER_KG * float(env.peg.mass[0]))

    def carried(along: float) -> FloatArray:
        return goal @ make_pose(np.eye(3), (along, 0.0, 0.0)) @ invert_pose(peg) @ tool

    inserted = Stroke(carried(0.01)[None], closed=True, speed=0.06, pause=0.5)
    return [precise(stroke) for stroke in (*grasp(tool, rng), hold(carried(-length - 0.03), pause=0.5), inserted)]


def stack_pyramid(cell: PandaCell, rng: np.random.Generator) -> list[Stroke]:
    """Put the red cube beside the green one, and the blue one on both."""
    a, b = over(cell, cell.env.cubeA, symmetry=4), matrix(cell.env.cubeB.pose)
    sides = [sign * b[:3, axis] for axis in (0, 1) for sign in (1, -1)]
    beside = max(sides, key=lambda side: float(side @ (a[:3, 3] - b[:3, 3])))  # the side of b where a lies
    # The open fingers must not touch the neighbour: they close across the line between the two cubes.
    goal_a = upright(cell, b[:3, 3] + 0.046 * beside, np.arctan2(beside[1], beside[0]), symmetry=2)
    goal_c = raised(goal_a, 0.042)
    goal_c[:2, 3] -= 0.023 * beside[:2]
    c = over(cell, cell.env.cubeC, symmetry=4)
    return [*grasp(a, rng), *release(goal_a), *grasp(c, rng), *release(goal_c)]


def pull_cube_tool(cell: PandaCell, rng: np.random.Generator) -> list[Stroke]:
    """Grasp the tool near the end of its handle, put its hook behind the cube, and pull the cube near."""
    env = cell.env
    tool_x, tool_y, tool_z = place(env.l_shape_tool)
    x, y, _ = place(env.cube)
    inner = env.handle_length - env.hook_length  # from the tool's origin to the inner face of its hook
    tool = downward(tool_x + 0.03, tool_y, tool_z)
    hooked = downward(x - inner + 0.045 + 0.03, y - 0.065, tool_z + 0.002)
    near = hooked.copy()
    near[0, 3] -= x + 0.12 + rng.uniform(0.0, 0.03)
    return [*grasp(tool, rng), hold(raised(hooked, 0.19)), hold(hooked), hold(near, pause=0.3)]


def roll_ball(cell: PandaCell, rng: np.random.Generator) -> list[Stroke]:
    """Push the ball with closed fingers towards the goal, and let it roll."""
    ball, goal = place(cell.env.ball), place(cell.env.goal_region)
    along = (goal - ball)[:2] / np.linalg.norm((goal - ball)[:2])
    yaw = float(np.arctan2(along[1], along[0]))

    backward = pitched(-0.6, yaw)  # the ball lies so near that an upright hand could not get behind it

    def at(distance: float, z: float) -> FloatArray:
        return make_pose(backward, np.append(ball[:2] + distance * along, z))[None]

    strokes = [
        Stroke(at(-0.075, 0.15), closed=True, free=True),
        Stroke(at(-0.075, 0.035), closed=True, speed=0.15),
        Stroke(at(0.22, 0.035), closed=True, speed=1.0, pause=3.0),
    ]
    return [precise(stroke) for stroke in strokes]


def grasp(tool: FloatArray, rng: np.random.Generator) -> list[Stroke]:
    """Open, approach ``tool (4, 4)`` along its axis, close, and lift, by a little more or less each time."""
    before, lifted = tool @ make_pose(np.eye(3), (0.0, 0.0, -ABOVE_M)), raised(tool, ABOVE_M + rng.uniform(0.0, 0.02))
    return [
        Stroke(before[None], closed=False, free=True, speed=0.3, error=0.004),
        Stroke(tool[None], closed=True, speed=0.14, error=GRASP_ERROR_M),
        hold(lifted, error=0.004),
    ]


def release(tool: FloatArray) -> list[Stroke]:
    """Carry over ``tool (4, 4)``, lower to it, open and retreat."""
    over = raised(tool, ABOVE_M)
    return [
        hold(over, error=0.004),
        Stroke(tool[None], closed=False, speed=0.12, error=GRASP_ERROR_M, pause=0.2),
        Stroke(over[None], closed=False, free=True, error=0.004),
    ]


def hold(tool: FloatArray, pause: float = 0.08, error: float = 0.002) -> Stroke:
    """Move to ``tool (4, 4)`` with closed fingers."""
    return Stroke(tool[None], closed=True, speed=0.16, pause=pause, error=error)


def precise(stroke: Stroke) -> Stroke:
    return replace(stroke, error=PRECISE_M, aim=PRECISE_RAD)


def over(cell: PandaCell, actor: Any, symmetry: int) -> FloatArray:
    """A tool ``(4, 4)`` that points down at the middle of ``actor`` and is turned like it, see `upright`."""
    pose = matrix(actor.pose)
    return upright(cell, pose[:3, 3], float(np.arctan2(pose[1, 0], pose[0, 0])), symmetry)


def upright(cell: PandaCell, position: FloatArray, yaw: float, symmetry: int) -> FloatArray:
    """A tool ``(4, 4)`` that points down, turned by ``yaw`` rad or, whichever is nearest to the hand at the start, a
    multiple of a ``symmetry``-th of a full turn more."""
    hand = cell.tool_poses()[0]
    step = 2 * np.pi / symmetry
    turns = np.round((np.arctan2(hand[1, 0], hand[0, 0]) - yaw) / step)
    x, y, z = position
    return downward(x, y, z, yaw + turns * step)


def raised(tool: FloatArray, height: float) -> FloatArray:
    return make_pose(np.eye(3), (0.0, 0.0, height)) @ tool


def place(actor: Any) -> FloatArray:
    """Position ``(3,)`` of an actor, metres."""
    return matrix(actor.pose)[:3, 3]
