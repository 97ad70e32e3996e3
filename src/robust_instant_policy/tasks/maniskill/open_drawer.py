"""Pull a drawer of a small chest open by its handle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.articulation import Articulation

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.maniskill.carpentry import add_box, add_cylinder, hinge
from robust_instant_policy.tasks.maniskill.cell import CellEnv
from robust_instant_policy.tasks.maniskill.demonstrator import Stroke
from robust_instant_policy.tasks.maniskill.paint import BLACK, STEEL, WHITE, Paint
from robust_instant_policy.tasks.maniskill.poses import downward, facing
from robust_instant_policy.tasks.maniskill.simulated_task import TaskSpec

X_RANGE_M, Y_RANGE_M = (0.06, 0.14), (-0.13, 0.13)  # of the middle of the chest's front
YAW_RANGE_RAD = np.deg2rad(20)

BOARD_M = 0.01
FRONT_M = 0.014  # thickness of the drawer's front
GAP_M = 0.003  # around the drawer's front
HANDLE_M = 0.045  # how far handles stick out
GRASP_REACH_M = 0.034  # from the front to where fingers take a handle
SLIDE_DAMPING, SLIDE_FRICTION = 15.0, 0.05  # N s / m and PhysX's coefficient: drawers on plain wooden runners

OPEN_SHARE = 0.9
STILL_M_S, STILL_RAD_S = 0.1, 1.0  # as in ManiSkill's OpenCabinetDrawer

ABOVE_M = 0.09
FINGERS_BELOW_M = 0.010  # fingertips under the middle of the handle
PULL_FURTHER_M = 0.004  # a person pulls until it stops

BODIES = (
    Paint((0.80, 0.66, 0.46), grain=True),
    Paint((0.36, 0.24, 0.16), grain=True),
    Paint((0.42, 0.55, 0.60)),
    Paint((0.55, 0.63, 0.50)),
    WHITE,
)
FRONTS = (WHITE, Paint((0.88, 0.80, 0.62), grain=True), Paint((0.30, 0.38, 0.47)), Paint((0.62, 0.30, 0.22)))
HANDLES = (BLACK, WHITE, STEEL)
HANDLE_KINDS = ("knob", "fin", "bar")


@dataclass(frozen=True)
class Chest:
    """A chest whose upper drawer opens; its frame lies on the table under the middle of its front, -x outwards.

    ``width`` (y), ``depth`` (x), ``height``, ``drawer_height`` and ``travel`` of the drawer in metres.
    """

    width: float
    depth: float
    height: float
    drawer_height: float
    travel: float
    handle_kind: str
    body: Paint
    front: Paint
    handle: Paint

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Chest:
        body = BODIES[rng.integers(len(BODIES))]
        fronts = [paint for paint in FRONTS if paint != body]
        return cls(
            width=rng.uniform(0.18, 0.24),
            depth=rng.uniform(0.17, 0.20),
            height=rng.uniform(0.11, 0.14),
            drawer_height=rng.uniform(0.055, 0.065),
            travel=rng.uniform(0.11, 0.13),
            handle_kind=HANDLE_KINDS[rng.integers(len(HANDLE_KINDS))],
            body=body,
            front=fronts[rng.integers(len(fronts))],
            handle=HANDLES[rng.integers(len(HANDLES))],
        )

    @property
    def handle_height(self) -> float:
        """Middle of the handle over the table."""
        return self.height - BOARD_M - self.drawer_height / 2

    def build(self, scene: Any) -> Articulation:
        builder = scene.create_articulation_builder()
        body = builder.create_link_builder()
        body.set_name("body")
        self._build_body(body)
        drawer = builder.create_link_builder(body)
        drawer.set_name("drawer")
        drawer.set_joint_name("slide")
        hinge(drawer, "prismatic", (0.0, 0.0, self.handle_height), (-1.0, 0.0, 0.0), (0.0, self.travel))
        self._build_drawer(drawer)
        builder.initial_pose = sapien.Pose([0.2, 0, 0])
        chest = builder.build(name="chest", fix_root_link=True)
        slide = chest.joints_map["slide"]
        slide.set_drive_properties(0.0, SLIDE_DAMPING)
        slide.set_friction(SLIDE_FRICTION)
        return chest

    def _build_body(self, link: Any) -> None:
        width, depth, height = self.width, self.depth, self.height
        add_box(link, (depth, width + 0.012, BOARD_M), (depth / 2 - 0.006, 0, height - BOARD_M / 2), self.body)
        for side in (-1, 1):
            at = (depth / 2, side * (width - BOARD_M) / 2, (height - BOARD_M) / 2)
            add_box(link, (depth, BOARD_M, height - BOARD_M), at, self.body)
        add_box(
            link,
            (BOARD_M, width - 2 * BOARD_M, height - BOARD_M),
            (depth - BOARD_M / 2, 0, (height - BOARD_M) / 2),
            self.body,
        )
        plinth = height - BOARD_M - self.drawer_height
        add_box(link, (FRONT_M, width - 2 * BOARD_M, plinth), (FRONT_M / 2, 0, plinth / 2), self.body)
        add_box(link, (0.001, width - 0.05, plinth * 0.7), (-0.0005, 0, plinth / 2), self.front, collide=False)

    def _build_drawer(self, link: Any) -> None:
        width = self.width - 2 * BOARD_M - 2 * GAP_M
        height = self.drawer_height - 2 * GAP_M
        inside, wall = self.travel + 0.02, 0.005
        wood = Paint((0.86, 0.75, 0.56), grain=True)
        add_box(link, (FRONT_M, width, height), (FRONT_M / 2 - 0.004, 0, 0), self.front)
        add_box(link, (inside, width - 0.01, wall), (inside / 2 + 0.01, 0, -height / 2 + 0.008), wood)
        for side in (-1, 1):
            at = (inside / 2 + 0.01, side * (width - 0.016) / 2, -0.004)
            add_box(link, (inside, wall, height * 0.75), at, wood)
        add_box(link, (wall, width - 0.016, height * 0.75), (inside + 0.01, 0, -0.004), wood)
        self._build_handle(link)

    def _build_handle(self, link: Any) -> None:
        face = -0.004
        if self.handle_kind == "knob":
            add_cylinder(link, 0.007, HANDLE_M - 0.018, (face - (HANDLE_M - 0.018) / 2, 0, 0), "x", self.handle)
            add_cylinder(link, 0.013, 0.02, (face - HANDLE_M + 0.01, 0, 0), "x", self.handle)
        elif self.handle_kind == "fin":
            add_box(link, (HANDLE_M, 0.014, 0.032), (face - HANDLE_M / 2, 0, 0), self.handle)
        else:
            add_cylinder(link, 0.008, 0.044, (face - GRASP_REACH_M, 0, 0), "z", self.handle)
            for end in (-0.016, 0.016):
                add_cylinder(link, 0.005, GRASP_REACH_M, (face - GRASP_REACH_M / 2, 0, end), "x", self.handle)


@register_env("RIP-OpenDrawer-v1", max_episode_steps=600)
class OpenDrawerEnv(CellEnv):
    """Success: the drawer is open by `OPEN_SHARE` of its travel and rests."""

    shape: Chest
    chest: Articulation

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        self.shape = Chest.draw(self.draw("shape"))
        self.chest = self.shape.build(self.scene)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        rng = self.draw("pose")
        self.front_pose = facing(
            rng.uniform(*X_RANGE_M), rng.uniform(*Y_RANGE_M), rng.uniform(-YAW_RANGE_RAD, YAW_RANGE_RAD)
        )
        self.chest.set_pose(sapien.Pose(self.front_pose))
        self.chest.set_qpos(np.zeros((1, 1), dtype=np.float32))
        self.chest.set_qvel(np.zeros((1, 1), dtype=np.float32))

    def evaluate(self) -> dict:
        drawer = self.chest.links_map["drawer"]
        still = torch.linalg.norm(drawer.linear_velocity, dim=1) <= STILL_M_S
        still &= torch.linalg.norm(drawer.angular_velocity, dim=1) <= STILL_RAD_S
        share = self.chest.get_qpos()[:, 0] / self.shape.travel
        return {"success": (share >= OPEN_SHARE) & still, "open_share": share, "still": still}


def pull(env: OpenDrawerEnv, rng: np.random.Generator) -> list[Stroke]:
    """Come down with one finger on either side of the handle, close, pull straight out."""
    shape, height = env.shape, env.shape.handle_height - FINGERS_BELOW_M
    reach = GRASP_REACH_M + rng.uniform(-0.002, 0.002)

    def at(out: float, z: float) -> FloatArray:
        return env.front_pose @ downward(-out, 0.0, z)

    return [
        Stroke(np.array([at(reach, height + ABOVE_M)]), closed=False, free=True, speed=0.35, error=0.005),
        Stroke(np.array([at(reach, height)]), closed=True, speed=0.14, error=0.0015),
        Stroke(np.array([at(reach + shape.travel + PULL_FURTHER_M, height)]), closed=True, speed=0.12),
    ]


def verdict(env: OpenDrawerEnv) -> str:
    """Why the task failed, or nothing."""
    state: dict[str, Any] = env.evaluate()
    share = float(state["open_share"])
    if share < OPEN_SHARE:
        return f"the drawer is {max(share, 0.0):.0%} open, {OPEN_SHARE:.0%} wanted"
    return "" if bool(state["still"]) else "the drawer is open but still moving"


SPEC = TaskSpec(
    name="open-drawer",
    description="pull the drawer open by its handle",
    goal="the drawer is open",
    env_id="RIP-OpenDrawer-v1",
    expert=pull,
    verdict=verdict,
)
