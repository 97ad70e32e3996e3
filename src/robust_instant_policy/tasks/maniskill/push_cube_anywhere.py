"""Push a cube into a goal disc that lies anywhere around it."""

from dataclasses import replace

import numpy as np
from mani_skill.utils.registration import register_env

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.tasks.maniskill.push_cube import SPEC as PUSH_CUBE
from robust_instant_policy.tasks.maniskill.push_cube import PushCubeEnv
from robust_instant_policy.tasks.poses import facing

TABLE_M = np.array([[-0.14, -0.24], [0.24, 0.24]])  # corners of the area in which cube and goal lie
DISTANCE_M = (0.16, 0.24)  # from the cube to the middle of the goal


@register_env("RIP-PushCubeAnywhere-v1", max_episode_steps=600)
class PushCubeAnywhereEnv(PushCubeEnv):
    """Success: as in `PushCubeEnv`."""

    def draw_push(self, rng: np.random.Generator) -> tuple[FloatArray, float, float]:
        while True:
            cube, angle = rng.uniform(*TABLE_M), rng.uniform(-np.pi, np.pi)
            distance = float(rng.uniform(*DISTANCE_M))
            goal = cube + distance * np.array([np.cos(angle), np.sin(angle)])
            if (TABLE_M[0] <= goal).all() and (goal <= TABLE_M[1]).all():
                return facing(cube[0], cube[1], angle), distance, -angle


SPEC = replace(
    PUSH_CUBE,
    name="push-cube-anywhere",
    description="push the cube into the goal disc, wherever it lies",
    object_sets=("seen", "unseen"),
)
