"""Importing this module registers the environments with gymnasium: ``gymnasium.make("RIP-AlohaSweep-v1")``."""

import gymnasium

MAX_EPISODE_STEPS = 3000  # a minute
ENVIRONMENTS = {
    "RIP-AlohaPickBanana-v1": "pick_banana:PickBananaEnv",
    "RIP-AlohaPickPlace-v1": "pick_place:PickPlaceEnv",
    "RIP-AlohaHang-v1": "hang:HangEnv",
    "RIP-AlohaSweep-v1": "sweep:SweepEnv",
    "RIP-AlohaCupUpright-v1": "cup_upright:CupUprightEnv",
}

for name, entry_point in ENVIRONMENTS.items():
    if name not in gymnasium.registry:
        gymnasium.register(
            name, entry_point=f"robust_instant_policy.tasks.aloha.{entry_point}", max_episode_steps=MAX_EPISODE_STEPS
        )
