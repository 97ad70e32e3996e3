"""Put the nearer of two blocks into a tray."""

import numpy as np
import sapien
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.actor import Actor

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.maniskill.block import Block, apart, corners, is_still, scattered
from robust_instant_policy.tasks.maniskill.camera import matrix
from robust_instant_policy.tasks.maniskill.carpentry import add_box
from robust_instant_policy.tasks.maniskill.cell import BASE_POSITION_M, CellEnv
from robust_instant_policy.tasks.maniskill.paint import BLACK, BRASS, RED, STEEL, WHITE, Paint
from robust_instant_policy.tasks.picking import Pick, set_down
from robust_instant_policy.tasks.poses import facing
from robust_instant_policy.tasks.simulated_task import TaskSpec

TABLE_M = np.array([[-0.14, -0.05], [0.2, 0.26]])  # corners of the area in which the blocks lie
APART_M = 0.12
CLEAR_M = 0.03  # by which one block is nearer to the robot's base than the other
YAW_RANGE_RAD = np.deg2rad(30)
TRAY_M = (0.05, -0.2)  # the tray's middle
TRAY_SIZE_M, WALL_M, FLOOR_M = (0.14, 0.14, 0.02), 0.006, 0.004

SIZE_M = {"seen": (0.044, 0.034, 0.036), "unseen": (0.036, 0.036, 0.05)}
GREEN, BLUE = Paint((0.15, 0.45, 0.2)), Paint((0.1, 0.2, 0.62))
PAINTS = {"seen": (RED, BLUE, WHITE), "unseen": (GREEN, BRASS, BLACK)}  # of the two blocks and of their marks

PICK = Pick(above=0.12, grasp=0.016, lift=0.14, reach_speed=0.35, down_speed=0.14, lift_speed=0.16, error=0.005)
RELEASE_M = 0.01  # the block's foot over the tray's floor


@register_env("RIP-Sort-v1", max_episode_steps=600)
class SortEnv(CellEnv):
    """Success: the block that was nearer to the robot's base rests in the tray, released, and the other does not."""

    blocks: tuple[Actor, Actor]
    nearer: int

    def build_objects(self) -> None:
        *paints, mark = PAINTS[self.objects]
        first, second = (Block(SIZE_M[self.objects], paint, (mark,)) for paint in paints)
        self.blocks = first.build(self.scene, "first block"), second.build(self.scene, "second block")
        self.tray = _build_tray(self.scene)

    def place_objects(self) -> None:
        rng = self.draw("pose")

        def distances(places: FloatArray) -> FloatArray:
            return np.linalg.norm(places - BASE_POSITION_M[:2], axis=1)

        def fit(places: FloatArray) -> bool:
            return apart(places) >= APART_M and abs(np.diff(distances(places))[0]) >= CLEAR_M

        places = scattered(rng, TABLE_M, 2, fit)
        for number, (block, (x, y)) in enumerate(zip(self.blocks, places, strict=True)):
            pose = facing(x, y, rng.uniform(-YAW_RANGE_RAD, YAW_RANGE_RAD))
            pose = self.layout.place(pose, [(0.0, 0.0)], corners(*SIZE_M[self.objects][:2]))
            places[number] = pose[:2, 3]
            block.set_pose(sapien.Pose(pose))
        self.nearer = int(distances(places).argmin())
        tray = self.layout.place(facing(*TRAY_M, 0.0), [(0.0, 0.0)], corners(*TRAY_SIZE_M[:2]), turn=0.0)
        self.tray.set_pose(sapien.Pose(tray))

    def failure(self) -> str:
        nearer, other = self.blocks[self.nearer], self.blocks[1 - self.nearer]
        if self.agent.is_grasping(nearer) or self.agent.is_grasping(other):
            return "a block is still in the fingers"
        if _is_in_tray(other):
            return "the block further away is in the tray"
        if not _is_in_tray(nearer):
            away = np.linalg.norm(matrix(nearer.pose)[:2, 3] - TRAY_M)
            return f"the nearer block is {1e3 * away:.0f} mm from the tray's middle, not in it"
        return "" if is_still(nearer) else "the nearer block is in the tray but still moving"


def _build_tray(scene: object) -> Actor:
    builder = scene.create_actor_builder()  # type: ignore[attr-defined]
    x, y, z = TRAY_SIZE_M
    add_box(builder, [x, y, FLOOR_M], [0, 0, FLOOR_M / 2], STEEL)
    for side in (-1, 1):
        add_box(builder, [WALL_M, y, z], [side * (x - WALL_M) / 2, 0, z / 2], STEEL)
        add_box(builder, [x, WALL_M, z], [0, side * (y - WALL_M) / 2, z / 2], STEEL)
    builder.initial_pose = sapien.Pose([*TRAY_M, 0.0])
    return builder.build_kinematic("tray")


def _is_in_tray(block: Actor) -> bool:
    x, y, z = matrix(block.pose)[:3, 3] - [*TRAY_M, 0.0]
    return max(abs(x), abs(y)) < TRAY_SIZE_M[0] / 2 and z < TRAY_SIZE_M[2]


def sort(env: SortEnv, rng: np.random.Generator) -> list[Stroke]:
    """Grasp the nearer block, carry it over the tray, and let go near its floor."""
    tray = facing(*TRAY_M, 0.0)
    tray[2, 3] = FLOOR_M + RELEASE_M
    return [*PICK.strokes(matrix(env.blocks[env.nearer].pose), rng), *set_down(tray, PICK)]


SPEC = TaskSpec(
    name="sort",
    description="put the block that is nearer to the robot into the tray",
    goal="the nearer block is in the tray",
    expert=sort,
    object_sets=("seen", "unseen"),
)
