"""Push the open door of a small cabinet closed."""

import numpy as np
from mani_skill.utils.registration import register_env

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.maniskill import partnet
from robust_instant_policy.tasks.maniskill.cabinet import Cabinet
from robust_instant_policy.tasks.maniskill.cell import CellEnv
from robust_instant_policy.tasks.maniskill.mechanism import Door, Mechanism
from robust_instant_policy.tasks.object_sets import draw_object
from robust_instant_policy.tasks.poses import downward, facing
from robust_instant_policy.tasks.simulated_task import TaskSpec

X_RANGE_M, Y_RANGE_M = (0.08, 0.16), (-0.12, 0.06)  # of the middle of the cabinet's front, hinge on the +y side
YAW_RANGE_RAD = np.deg2rad(20)
BODY_M = ((-0.20, -0.10), (-0.20, 0.10), (0.20, -0.11), (0.20, 0.11))  # the largest cabinet, its door open
OPEN_RANGE_RAD = np.deg2rad((50.0, 80.0))  # opening angle of the door at the start

CLOSED_RAD = np.deg2rad(5)  # opening angle below which the door is closed
STILL_M_S, STILL_RAD_S = 0.1, 1.0  # as in ManiSkill's cabinet tasks

FINGER_RADIUS_M = 0.013  # of the closed fingers
PUSH_SHARE = 0.72  # of the door's width, from the hinge: where the demonstrator pushes
APPROACH_M = 0.04  # between fingers and door while the gripper descends
FINGERS_BELOW_M = 0.035  # fingertips under the door's top edge
ABOVE_M = 0.07
PRESS_M = 0.003
ARC_POINTS = 7


@register_env("RIP-CloseCabinet-v1", max_episode_steps=600)
class CloseCabinetEnv(CellEnv):
    """Success: the door is open by less than `CLOSED_RAD` and rests."""

    door: Door
    cabinet: Mechanism

    def build_objects(self) -> None:
        rng = self.draw("shape")
        if self.assets == "maniskill":
            self.cabinet, self.door = partnet.load_cabinet(self.scene, self.objects, rng)
        else:
            shape = draw_object({"seen": Cabinet.draw_seen, "unseen": Cabinet.draw_unseen}, self.objects, rng)
            self.cabinet, self.door = shape.build(self.scene), shape.door_geometry

    def place_objects(self) -> None:
        rng = self.draw("pose")
        pose = facing(
            rng.uniform(*X_RANGE_M),
            self.door.side * rng.uniform(*Y_RANGE_M),
            rng.uniform(-YAW_RANGE_RAD, YAW_RANGE_RAD),
        )
        # The door's edge at right angles, the fingers before it, and the edge of the closed door.
        edge, hinge = self.door.width * PUSH_SHARE, self.door.side * self.door.width / 2
        before = hinge - self.door.side * -APPROACH_M
        reach = [(-edge, before), (-edge, -hinge / 2), (0.0, hinge - self.door.side * edge)]
        self.front_pose = self.layout.place(pose, reach, BODY_M)
        self.cabinet.place(self.front_pose, rng.uniform(*OPEN_RANGE_RAD))

    def failure(self) -> str:
        angle = float(self.cabinet.position)
        if angle >= CLOSED_RAD:
            return f"the door is {np.rad2deg(angle):.1f} degrees open, {np.rad2deg(CLOSED_RAD):.0f} allowed"
        return "" if self.cabinet.is_still(STILL_M_S, STILL_RAD_S) else "the door is closed but still moving"


def push_closed(env: CloseCabinetEnv, rng: np.random.Generator) -> list[Stroke]:
    """Close the gripper, descend outside the door, and push it to the frame."""
    door, height = env.door, env.door.top - FINGERS_BELOW_M
    radius = door.width * PUSH_SHARE * rng.uniform(0.95, 1.05)
    angle = float(env.cabinet.position[0])

    def at(opened: float, away: float, z: float) -> FloatArray:
        """Fingers ``away`` m from the outer face of a door ``opened`` rad, ``radius`` from the hinge."""
        along = np.array([-np.sin(opened), -door.side * np.cos(opened)])
        outward = np.array([-np.cos(opened), door.side * np.sin(opened)])
        x, y = door.hinge + radius * along + (FINGER_RADIUS_M + away) * outward
        return env.front_pose @ downward(x, y, z)

    arc = [at(opened, 0.0, height) for opened in np.linspace(angle, 0.0, ARC_POINTS)]
    return [
        Stroke(np.array([at(angle, APPROACH_M, height + ABOVE_M)]), closed=True, free=True, speed=0.35, error=0.005),
        Stroke(np.array([at(angle, APPROACH_M, height)]), closed=True, speed=0.15, error=0.003),
        Stroke(np.array([*arc[:-1], at(0.0, -PRESS_M, height)]), closed=True, speed=0.15),
        Stroke(np.array([at(0.0, 0.05, height + 0.03)]), closed=True, free=True, error=0.005),
    ]


SPEC = TaskSpec(
    name="close-cabinet",
    description="push the cabinet's door closed",
    goal="the cabinet's door is closed",
    expert=push_closed,
    object_sets=("seen", "unseen"),
    asset_sources=("code", "maniskill"),
)
