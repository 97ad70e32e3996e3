"""Wipe a bar of any length from its first end to the other."""

import numpy as np
import sapien
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.actor import Actor

from robust_instant_policy.geometry import FloatArray, invert_pose
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.maniskill.block import Block, corners
from robust_instant_policy.tasks.maniskill.camera import matrix
from robust_instant_policy.tasks.maniskill.cell import CellEnv
from robust_instant_policy.tasks.maniskill.paint import BLACK, BRASS, RED, WHITE, Paint
from robust_instant_policy.tasks.poses import downward, facing
from robust_instant_policy.tasks.simulated_task import TaskSpec

X_RANGE_M, Y_RANGE_M = (-0.06, 0.16), (-0.12, 0.12)  # of the bar's middle
YAW_RANGE_RAD = np.deg2rad((40.0, 140.0))  # of the direction from the first end to the other
LENGTHS_M = (0.14, 0.34)
WIDTH_M, HEIGHT_M = {"seen": 0.05, "unseen": 0.065}, {"seen": 0.02, "unseen": 0.03}
PAINTS = {"seen": Paint((0.72, 0.55, 0.36)), "unseen": BRASS}
MARKS = {"seen": (RED, WHITE), "unseen": (BLACK, Paint((0.1, 0.2, 0.62)))}  # of the first end and of the other

CELL_M = 0.01  # length of the pieces that are wiped or not
WIPED_SHARE = 0.9  # of them, for success
SIDE_M, TOUCH_M = 0.015, 0.012  # of the fingertips from the middle of the bar, and over it: what they wipe

WIPE_M, CLEARANCE_M = 0.004, 0.08  # fingertips over the bar while wiping and before
POINTS = 5  # of the stroke


@register_env("RIP-Wipe-v1", max_episode_steps=600)
class WipeEnv(CellEnv):
    """Success: the fingertips passed over `WIPED_SHARE` of the bar, close to its surface."""

    bar: Actor
    length: float
    wiped: np.ndarray

    def build_objects(self) -> None:
        self.length = float(self.draw("shape").uniform(*LENGTHS_M))
        self.height = HEIGHT_M[self.objects]
        size = (self.length, WIDTH_M[self.objects], self.height)
        self.bar = Block(size, PAINTS[self.objects], MARKS[self.objects]).build(self.scene, "bar", fixed=True)

    def place_objects(self) -> None:
        rng = self.draw("pose")
        pose = facing(rng.uniform(*X_RANGE_M), rng.uniform(*Y_RANGE_M), rng.uniform(*YAW_RANGE_RAD) + np.pi)
        ends = [(-self.length / 2, 0.0), (self.length / 2, 0.0)]
        pose = self.layout.place(pose, ends, corners(self.length, WIDTH_M[self.objects]))
        self.bar.set_pose(sapien.Pose(pose))
        self.wiped = np.zeros(round(self.length / CELL_M), dtype=bool)

    def advance(self, command: FloatArray) -> None:
        super().advance(command)
        along, side, height = (invert_pose(matrix(self.bar.pose)) @ self.tool_poses()[0])[:3, 3]
        if abs(side) <= SIDE_M and abs(height - self.height) <= TOUCH_M:
            middles = (np.arange(len(self.wiped)) + 0.5) * self.length / len(self.wiped) - self.length / 2
            self.wiped |= np.abs(middles - along) <= CELL_M

    def failure(self) -> str:
        share = float(self.wiped.mean())
        if share >= WIPED_SHARE:
            return ""
        return f"{share:.1%} of the bar is wiped, {WIPED_SHARE:.0%} wanted"


def wipe(env: WipeEnv, rng: np.random.Generator) -> list[Stroke]:
    """Close the gripper, descend on the first end, wipe along the bar to the other end, and retreat."""
    bar, end = matrix(env.bar.pose), env.length / 2

    def at(along: float, height: float) -> FloatArray:
        return bar @ downward(along, 0.0, env.height + height, np.pi)

    way = np.array([at(along, WIPE_M) for along in np.linspace(end, -end, POINTS)])
    return [
        Stroke(at(end, CLEARANCE_M)[None], closed=True, free=True, speed=0.35, error=0.004),
        Stroke(way[:1], closed=True, speed=0.14),
        Stroke(way[1:], closed=True, speed=0.16),
        Stroke(at(-end, CLEARANCE_M)[None], closed=True, free=True, error=0.006),
    ]


SPEC = TaskSpec(
    name="wipe",
    description="wipe the bar from its first end to the other",
    goal="the bar is wiped from end to end",
    expert=wipe,
    object_sets=("seen", "unseen"),
)
