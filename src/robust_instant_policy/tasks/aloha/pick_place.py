"""Put a bottle into a red bowl."""

import mujoco
import numpy as np

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.aloha.bottle import Bottle
from robust_instant_policy.tasks.aloha.bowl import Bowl
from robust_instant_policy.tasks.aloha.cell import AlohaEnv
from robust_instant_policy.tasks.demonstrator import Stroke
from robust_instant_policy.tasks.object_sets import draw_object
from robust_instant_policy.tasks.poses import downward, facing
from robust_instant_policy.tasks.simulated_task import TaskSpec

X_RANGE_M, Y_RANGE_M = (-0.21, 0.0), (-0.20, 0.20)
BODY_M = ((-0.07, 0.0), (0.07, 0.0), (0.0, -0.07), (0.0, 0.07))  # the largest bowl
APART_M = 0.17  # at least, between the middles of bottle and bowl

GRASP_SHARE = 0.55  # of the body's height: where the fingertips hold it
ABOVE_M = 0.06  # of the fingertips over the cap, before and after
CARRY_M = 0.035  # of the bottle's foot over the bowl's rim
RELEASE_M = 0.012  # of the bottle's foot over the bowl's floor


class PickPlaceEnv(AlohaEnv):
    """Success: the bottle rests in the bowl, off the table, released."""

    bottle: Bottle
    bowl: Bowl

    def build(self, spec: mujoco.MjSpec) -> None:
        families = {"seen": Bottle.draw_seen, "unseen": Bottle.draw_unseen}
        self.bottle = draw_object(families, self.objects, self.draw("shape"))
        self.bowl = Bowl.draw(self.draw("bowl"))
        rng = self.draw("pose")
        (x, y), (bowl_x, bowl_y) = apart(rng, X_RANGE_M, Y_RANGE_M, APART_M)
        bottle = self.layout.place(facing(x, y, rng.uniform(-np.pi, np.pi)), [(0.0, 0.0)], BODY_M)
        self.bowl.build(spec, "bowl", self.layout.place(facing(bowl_x, bowl_y, 0.0), [(0.0, 0.0)], BODY_M))
        self.bottle.build(spec, "bottle", bottle)

    def failure(self) -> str:
        distance = float(np.linalg.norm((self.pose_of("bottle") - self.pose_of("bowl"))[:2, 3]))
        if self.is_held("bottle"):
            return "the bottle is still in the fingers"
        if distance >= self.bowl.radius or self.touch("bottle", "bowl") == 0 or self.touch("bottle", "world") > 0:
            return f"the bottle is {1e3 * distance:.0f} mm from the bowl's middle, not in it"
        if not (self.is_still("bottle") and self.is_still("bowl")):
            return "the bottle is in the bowl but still moving"
        return ""


def apart(
    rng: np.random.Generator, x_range: tuple[float, float], y_range: tuple[float, float], distance: float
) -> FloatArray:
    """Two random positions ``(2, 2)`` in a rectangle, at least ``distance`` from each other, in metres."""
    while True:
        places = np.stack([rng.uniform(*x_range, 2), rng.uniform(*y_range, 2)], axis=1)
        if np.linalg.norm(places[0] - places[1]) >= distance:
            return places


def pick_and_place(env: PickPlaceEnv, rng: np.random.Generator) -> list[Stroke]:
    """Grasp the bottle from above, carry it over the rim, set it down in the bowl's middle, and release."""
    x, y = env.pose_of("bottle")[:2, 3].tolist()
    to_x, to_y = env.pose_of("bowl")[:2, 3].tolist()
    hold = GRASP_SHARE * env.bottle.height
    over = env.bottle.total_height + ABOVE_M
    carry = hold + env.bowl.height + CARRY_M
    return [
        Stroke(np.array([downward(x, y, over)]), closed=False, free=True, speed=0.20, error=0.004),
        Stroke(np.array([downward(x, y, hold)]), closed=True, speed=0.10, error=0.0015),
        Stroke(np.array([downward(x, y, carry)]), closed=True, speed=0.12, error=0.003),
        Stroke(np.array([downward(to_x, to_y, carry)]), closed=True, speed=0.16, error=0.004),
        Stroke(np.array([downward(to_x, to_y, hold + RELEASE_M)]), closed=False, speed=0.10, error=0.002, pause=0.2),
        Stroke(np.array([downward(to_x, to_y, over + RELEASE_M)]), closed=False, free=True, speed=0.15, error=0.005),
    ]


SPEC = TaskSpec(
    name="aloha-pick-place",
    description="put the bottle into the red bowl",
    goal="the bottle is in the red bowl",
    expert=pick_and_place,
    object_sets=("seen", "unseen"),
)
