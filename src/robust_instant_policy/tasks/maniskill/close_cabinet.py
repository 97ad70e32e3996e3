"""Push the open door of a small cabinet shut."""

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
from robust_instant_policy.tasks.maniskill.object_sets import draw_object
from robust_instant_policy.tasks.maniskill.paint import BLACK, STEEL, WHITE, Paint
from robust_instant_policy.tasks.maniskill.poses import downward, facing
from robust_instant_policy.tasks.maniskill.simulated_task import TaskSpec

X_RANGE_M, Y_RANGE_M = (0.08, 0.16), (-0.12, 0.06)  # of the middle of the cabinet's front
YAW_RANGE_RAD = np.deg2rad(20)
OPEN_RANGE_RAD = np.deg2rad((50.0, 80.0))  # how far the door is open at the start

BOARD_M = 0.012
DOOR_M = 0.016
GAP_M = 0.002
DOOR_LIMIT_RAD = np.deg2rad(110)
HINGE_DAMPING, HINGE_FRICTION = 0.08, 0.05  # N m s / rad and PhysX's coefficient: an ordinary door

CLOSED_RAD = np.deg2rad(5)  # a door this little open counts as closed
STILL_RAD_S = 1.0  # as in ManiSkill's cabinet tasks

FINGER_RADIUS_M = 0.013  # of the closed fingers
PUSH_SHARE = 0.72  # of the door's width, from the hinge, where a person pushes
APPROACH_M = 0.04  # between fingers and door when the hand comes down beside it
FINGERS_BELOW_M = 0.035  # fingertips under the door's top edge
ABOVE_M = 0.07
PRESS_M = 0.003
ARC_POINTS = 7

HINGE_SIDE = 1.0  # the hinge is on the cabinet's +y side


@dataclass(frozen=True)
class Cabinet:
    """A cabinet with one door; its frame lies on the table under the middle of its front, -x outwards.

    ``width`` (y), ``depth`` (x), ``height`` in metres.
    """

    width: float
    depth: float
    height: float
    handle_kind: str
    body: Paint
    door: Paint
    handle: Paint
    shelf: bool

    @classmethod
    def draw_seen(cls, number: int, rng: np.random.Generator) -> Cabinet:
        """Low and wide, painted or of oak, with a bar to pull at."""
        bodies = (Paint((0.80, 0.66, 0.46), grain=True), Paint((0.42, 0.55, 0.60)), WHITE)
        doors = (Paint((0.30, 0.38, 0.47)), Paint((0.62, 0.30, 0.22)), Paint((0.25, 0.45, 0.36)))
        return cls(
            width=rng.uniform(0.18, 0.22),
            depth=rng.uniform(0.13, 0.16),
            height=rng.uniform(0.13, 0.16),
            handle_kind="bar",
            body=bodies[number % 3],
            door=doors[(number // 3 + number) % 3],
            handle=(BLACK, STEEL)[number % 2],
            shelf=True,
        )

    @classmethod
    def draw_unseen(cls, number: int, rng: np.random.Generator) -> Cabinet:
        """Narrower and deeper, of dark wood or in other colours, with a knob."""
        bodies = (Paint((0.36, 0.24, 0.16), grain=True), Paint((0.55, 0.63, 0.50)), Paint((0.70, 0.68, 0.66)))
        doors = (Paint((0.86, 0.78, 0.60), grain=True), Paint((0.85, 0.62, 0.20)), Paint((0.45, 0.25, 0.42)))
        return cls(
            width=rng.uniform(0.155, 0.18),
            depth=rng.uniform(0.16, 0.19),
            height=rng.uniform(0.15, 0.18),
            handle_kind="knob",
            body=bodies[number % 3],
            door=doors[(number // 3 + number) % 3],
            handle=STEEL,
            shelf=False,
        )

    @property
    def door_width(self) -> float:
        return self.width - 2 * GAP_M

    @property
    def door_top(self) -> float:
        """Height of the door's upper edge."""
        return self.height - GAP_M

    @property
    def hinge_at(self) -> FloatArray:
        """The hinge's foot ``(3,)`` in the cabinet's frame."""
        return np.array([0.0, HINGE_SIDE * self.door_width / 2, 0.0])

    def build(self, scene: Any) -> Articulation:
        builder = scene.create_articulation_builder()
        body = builder.create_link_builder()
        body.set_name("body")
        self._build_body(body)
        door = builder.create_link_builder(body)
        door.set_name("door")
        door.set_joint_name("hinge")
        hinge(door, "revolute", self.hinge_at, (0.0, 0.0, -HINGE_SIDE), (0.0, DOOR_LIMIT_RAD))
        self._build_door(door)
        builder.initial_pose = sapien.Pose([0.2, 0, 0])
        cabinet = builder.build(name="cabinet", fix_root_link=True)
        joint = cabinet.joints_map["hinge"]
        joint.set_drive_properties(0.0, HINGE_DAMPING)
        joint.set_friction(HINGE_FRICTION)
        return cabinet

    def _build_body(self, link: Any) -> None:
        width, depth, height = self.width, self.depth, self.height
        middle = DOOR_M + depth / 2
        add_box(link, (depth, width, BOARD_M), (middle, 0, BOARD_M / 2), self.body)
        add_box(link, (depth, width, BOARD_M), (middle, 0, height - BOARD_M / 2), self.body)
        inner = height - 2 * BOARD_M
        for side in (-1, 1):
            add_box(link, (depth, BOARD_M, inner), (middle, side * (width - BOARD_M) / 2, height / 2), self.body)
        back = (BOARD_M, width - 2 * BOARD_M, inner)
        add_box(link, back, (DOOR_M + depth - BOARD_M / 2, 0, height / 2), self.body)
        if self.shelf:
            shelf = (depth - 0.03, width - 2 * BOARD_M, 0.008)
            add_box(link, shelf, (middle + 0.012, 0, height / 2), self.body, collide=False)

    def _build_door(self, link: Any) -> None:
        # In the link's frame the hinge is the z axis; the closed door reaches to the side away from it, and its
        # outer face is at x = 0.
        width, height = self.door_width, self.door_top - GAP_M
        centre = np.array([DOOR_M / 2, -HINGE_SIDE * width / 2, GAP_M + height / 2])
        add_box(link, (DOOR_M, width, height), centre, self.door)
        rim = WHITE if self.door != WHITE else BLACK
        edge = centre + np.array([0, 0, height / 2])
        add_box(link, (DOOR_M, width, 0.002), edge, rim, collide=False)
        at = np.array([0.0, -HINGE_SIDE * (width - 0.022), 0.55 * height])
        if self.handle_kind == "bar":
            add_cylinder(link, 0.006, 0.06, at - np.array([0.022, 0, 0]), "z", self.handle)
            for end in (-0.022, 0.022):
                add_cylinder(link, 0.004, 0.022, at + np.array([-0.011, 0, end]), "x", self.handle)
        else:
            add_cylinder(link, 0.006, 0.014, at - np.array([0.007, 0, 0]), "x", self.handle)
            add_cylinder(link, 0.013, 0.014, at - np.array([0.02, 0, 0]), "x", self.handle)


@register_env("RIP-CloseCabinet-v1", max_episode_steps=600)
class CloseCabinetEnv(CellEnv):
    """Success: the door is open by less than `CLOSED_RAD` and rests."""

    shape: Cabinet
    cabinet: Articulation

    def __init__(self, *args: Any, objects: str = "seen", **kwargs: Any):
        self.objects = objects
        super().__init__(*args, **kwargs)

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        self.shape = draw_object(
            {"seen": Cabinet.draw_seen, "unseen": Cabinet.draw_unseen}, self.objects, self.draw("shape")
        )
        self.cabinet = self.shape.build(self.scene)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        rng = self.draw("pose")
        self.front_pose = facing(
            rng.uniform(*X_RANGE_M), rng.uniform(*Y_RANGE_M), rng.uniform(-YAW_RANGE_RAD, YAW_RANGE_RAD)
        )
        self.cabinet.set_pose(sapien.Pose(self.front_pose))
        self.cabinet.set_qpos(np.full((1, 1), rng.uniform(*OPEN_RANGE_RAD), dtype=np.float32))
        self.cabinet.set_qvel(np.zeros((1, 1), dtype=np.float32))

    def evaluate(self) -> dict:
        angle = self.cabinet.get_qpos()[:, 0]
        still = torch.linalg.norm(self.cabinet.links_map["door"].angular_velocity, dim=1) <= STILL_RAD_S
        return {"success": (angle < CLOSED_RAD) & still, "angle": angle, "still": still}


def shut(env: CloseCabinetEnv, rng: np.random.Generator) -> list[Stroke]:
    """Close the hand, come down outside the door, and push it round to the frame."""
    shape, height = env.shape, env.shape.door_top - FINGERS_BELOW_M
    radius = shape.door_width * PUSH_SHARE * rng.uniform(0.95, 1.05)
    angle = float(env.cabinet.get_qpos()[0, 0])

    def at(opened: float, away: float, z: float) -> FloatArray:
        """Fingers ``away`` m from the outer face of a door ``opened`` rad, ``radius`` from the hinge."""
        along = np.array([-np.sin(opened), -HINGE_SIDE * np.cos(opened)])
        outward = np.array([-np.cos(opened), HINGE_SIDE * np.sin(opened)])
        x, y = shape.hinge_at[:2] + radius * along + (FINGER_RADIUS_M + away) * outward
        return env.front_pose @ downward(x, y, z)

    arc = [at(opened, 0.0, height) for opened in np.linspace(angle, 0.0, ARC_POINTS)]
    return [
        Stroke(np.array([at(angle, APPROACH_M, height + ABOVE_M)]), closed=True, free=True, speed=0.35, error=0.005),
        Stroke(np.array([at(angle, APPROACH_M, height)]), closed=True, speed=0.15, error=0.003),
        Stroke(np.array([*arc[:-1], at(0.0, -PRESS_M, height)]), closed=True, speed=0.15),
        Stroke(np.array([at(0.0, 0.05, height + 0.03)]), closed=True, free=True, error=0.005),
    ]


def verdict(env: CloseCabinetEnv) -> str:
    """Why the task failed, or nothing."""
    state: dict[str, Any] = env.evaluate()
    angle = np.rad2deg(float(state["angle"]))
    if angle >= np.rad2deg(CLOSED_RAD):
        return f"the door is {angle:.0f} degrees open, {np.rad2deg(CLOSED_RAD):.0f} allowed"
    return "" if bool(state["still"]) else "the door is shut but still moving"


SPEC = TaskSpec(
    name="close-cabinet",
    description="push the cabinet's door shut",
    goal="the cabinet's door is shut",
    env_id="RIP-CloseCabinet-v1",
    expert=shut,
    verdict=verdict,
    object_sets=("seen", "unseen"),
)
