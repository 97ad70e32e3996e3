"""Turn a faucet on by its lever."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.articulation import Articulation

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.maniskill.carpentry import add_ball, add_box, add_cylinder, hinge
from robust_instant_policy.tasks.maniskill.cell import CellEnv
from robust_instant_policy.tasks.maniskill.demonstrator import Stroke
from robust_instant_policy.tasks.maniskill.object_sets import draw_object
from robust_instant_policy.tasks.maniskill.paint import BLACK, BRASS, RED, STEEL, WHITE, Paint
from robust_instant_policy.tasks.maniskill.poses import downward, facing
from robust_instant_policy.tasks.maniskill.simulated_task import TaskSpec

X_RANGE_M, Y_RANGE_M = (-0.02, 0.16), (-0.14, 0.10)
YAW_RANGE_RAD = np.deg2rad(30)

LEVER_GAP_M = 0.003
LEVER_DAMPING, LEVER_FRICTION = 0.06, 0.05  # N m s / rad and PhysX's coefficient: a cartridge valve
START_RAD = np.deg2rad(90)  # the lever starts over the faucet's +y side and turns towards +x

TARGET_SHARE = 0.9  # of the lever's range, as in ManiSkill's TurnFaucet

FINGER_RADIUS_M = 0.013  # of the closed fingers
PUSH_SHARE = 0.75  # of the lever's length, from its axis
APPROACH_M = 0.035
FINGERS_BELOW_M = 0.02  # fingertips under the lever's middle
ABOVE_M = 0.07
PUSH_FURTHER_RAD = 0.04  # a person turns until it stops
ARC_POINTS = 7


@dataclass(frozen=True)
class Faucet:
    """A faucet with one lever on top; its frame lies on the table under the lever's axis, the spout along -x.

    Lengths in metres, ``turn`` the lever's range in rad.
    """

    column: float
    height: float
    spout: float
    lever: float
    lever_half_width: float
    turn: float
    square: bool
    metal: Paint
    grip: Paint

    @classmethod
    def draw_seen(cls, number: int, rng: np.random.Generator) -> Faucet:
        """Round columns, round levers that end in a coloured ball."""
        return cls(
            column=rng.uniform(0.018, 0.023),
            height=rng.uniform(0.08, 0.11),
            spout=rng.uniform(0.10, 0.13),
            lever=rng.uniform(0.085, 0.105),
            lever_half_width=rng.uniform(0.006, 0.008),
            turn=rng.uniform(np.deg2rad(80), np.deg2rad(95)),
            square=False,
            metal=(STEEL, WHITE, BRASS)[number % 3],
            grip=(RED, Paint((0.10, 0.25, 0.70)), BLACK)[(number // 3 + number) % 3],
        )

    @classmethod
    def draw_unseen(cls, number: int, rng: np.random.Generator) -> Faucet:
        """Square columns, flat levers with a coloured end, other colours."""
        return cls(
            column=rng.uniform(0.020, 0.026),
            height=rng.uniform(0.10, 0.125),
            spout=rng.uniform(0.08, 0.11),
            lever=rng.uniform(0.075, 0.09),
            lever_half_width=rng.uniform(0.008, 0.011),
            turn=rng.uniform(np.deg2rad(80), np.deg2rad(95)),
            square=True,
            metal=(Paint((0.30, 0.31, 0.33), 0.4, 0.3), Paint((0.86, 0.83, 0.75), 0.4, 0.2))[number % 2],
            grip=(Paint((0.16, 0.55, 0.30)), WHITE)[number // 2 % 2],
        )

    @property
    def lever_height(self) -> float:
        """Middle of the lever over the table."""
        return self.height + LEVER_GAP_M + self.column * 0.5

    def build(self, scene: Any) -> Articulation:
        builder = scene.create_articulation_builder()
        body = builder.create_link_builder()
        body.set_name("body")
        self._build_body(body)
        lever = builder.create_link_builder(body)
        lever.set_name("lever")
        lever.set_joint_name("valve")
        hinge(lever, "revolute", (0, 0, self.lever_height), (0, 0, -1), (0.0, self.turn))
        self._build_lever(lever)
        builder.initial_pose = sapien.Pose([0.1, 0, 0])
        faucet = builder.build(name="faucet", fix_root_link=True)
        joint = faucet.joints_map["valve"]
        joint.set_drive_properties(0.0, LEVER_DAMPING)
        joint.set_friction(LEVER_FRICTION)
        return faucet

    def _build_body(self, link: Any) -> None:
        spout_height = 0.72 * self.height
        end = -self.spout
        if self.square:
            add_box(link, (4 * self.column, 3 * self.column, 0.01), (0, 0, 0.005), self.metal)
            add_box(link, (2 * self.column, 2 * self.column, self.height), (0, 0, self.height / 2), self.metal)
            add_box(link, (self.spout, 0.026, 0.02), (end / 2, 0, spout_height), self.metal)
            add_box(link, (0.024, 0.026, 0.03), (end + 0.012, 0, spout_height - 0.015), self.metal)
        else:
            add_cylinder(link, 2 * self.column, 0.008, (0, 0, 0.004), "z", self.metal)
            add_cylinder(link, self.column, self.height, (0, 0, self.height / 2), "z", self.metal)
            rise = 0.02
            add_cylinder(
                link, 0.011, self.spout, (end / 2, 0, spout_height + rise / 2), (-self.spout, 0, rise), self.metal
            )
            add_ball(link, 0.011, (end, 0, spout_height + rise), self.metal)
            add_cylinder(link, 0.011, 0.03, (end, 0, spout_height + rise - 0.015), "z", self.metal)

    def _build_lever(self, link: Any) -> None:
        # In the link's frame the valve is the z axis and the closed lever reaches along +y.
        length, half = self.lever, self.lever_half_width
        if self.square:
            add_box(link, (2 * self.column, 2 * self.column, self.column), (0, 0, 0), self.metal)
            add_box(link, (2 * half, length, 0.012), (0, length / 2, 0), self.metal)
            add_box(link, (2 * half, 0.022, 0.0135), (0, length - 0.011, 0), self.grip)
        else:
            add_cylinder(link, self.column * 0.95, self.column, (0, 0, 0), "z", self.metal)
            add_cylinder(link, half, length, (0, length / 2, 0), "y", self.metal)
            add_ball(link, half * 1.5, (0, length, 0), self.grip)


@register_env("RIP-TurnFaucet-v1", max_episode_steps=600)
class TurnFaucetEnv(CellEnv):
    """Success: the lever is past `TARGET_SHARE` of its range."""

    shape: Faucet
    faucet: Articulation

    def __init__(self, *args: Any, objects: str = "seen", **kwargs: Any):
        self.objects = objects
        super().__init__(*args, **kwargs)

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        self.shape = draw_object(
            {"seen": Faucet.draw_seen, "unseen": Faucet.draw_unseen}, self.objects, self.draw("shape")
        )
        self.faucet = self.shape.build(self.scene)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        rng = self.draw("pose")
        self.foot_pose = facing(
            rng.uniform(*X_RANGE_M), rng.uniform(*Y_RANGE_M), rng.uniform(-YAW_RANGE_RAD, YAW_RANGE_RAD)
        )
        self.faucet.set_pose(sapien.Pose(self.foot_pose))
        self.faucet.set_qpos(np.zeros((1, 1), dtype=np.float32))
        self.faucet.set_qvel(np.zeros((1, 1), dtype=np.float32))

    def evaluate(self) -> dict:
        share = self.faucet.get_qpos()[:, 0] / self.shape.turn
        return {"success": share > TARGET_SHARE, "turned_share": share}


def turn(env: TurnFaucetEnv, rng: np.random.Generator) -> list[Stroke]:
    """Close the hand, come down behind the lever, and push it round to its stop."""
    shape, height = env.shape, env.shape.lever_height - FINGERS_BELOW_M
    radius = shape.lever * PUSH_SHARE * rng.uniform(0.95, 1.05)

    def at(turned: float, away: float, z: float) -> FloatArray:
        """Fingers ``away`` m behind a lever ``turned`` rad, ``radius`` from its axis."""
        angle = START_RAD - turned
        along, behind = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        x, y = radius * along + (shape.lever_half_width + FINGER_RADIUS_M + away) * behind
        return env.foot_pose @ downward(x, y, z)

    end = shape.turn + PUSH_FURTHER_RAD
    return [
        Stroke(np.array([at(0.0, APPROACH_M, height + ABOVE_M)]), closed=True, free=True, speed=0.35, error=0.005),
        Stroke(np.array([at(0.0, APPROACH_M, height)]), closed=True, speed=0.15, error=0.003),
        Stroke(
            np.array([at(turned, 0.0, height) for turned in np.linspace(0.0, end, ARC_POINTS)]), closed=True, speed=0.13
        ),
        Stroke(np.array([at(end, APPROACH_M, height + 0.03)]), closed=True, free=True, error=0.005),
    ]


def verdict(env: TurnFaucetEnv) -> str:
    """Why the task failed, or nothing."""
    state: dict[str, Any] = env.evaluate()
    if bool(state["success"]):
        return ""
    return (
        f"the lever is turned by {max(float(state['turned_share']), 0.0):.0%} of its range, {TARGET_SHARE:.0%} wanted"
    )


SPEC = TaskSpec(
    name="turn-faucet",
    description="turn the faucet's lever",
    goal="the faucet is turned on",
    env_id="RIP-TurnFaucet-v1",
    expert=turn,
    verdict=verdict,
    object_sets=("seen", "unseen"),
)
